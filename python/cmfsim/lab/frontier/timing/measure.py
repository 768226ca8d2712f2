"""Runs one job in a fresh process, within a time limit, and keeps its answer."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cmfsim.io import replacing
from cmfsim.processes.worker import SILENT, Worker, WorkerEndedError, WorkerFailedError

Answer = dict[str, Any]
# Begins the error of a job that took too long.
STOPPED = "stopped after the time limit"
# Characters of a failure that are kept, from its end.
LAST_WORDS = 400


def kept(path: Path) -> Answer | None:
    """The answer of a finished job; None where there is none, or none that can be read."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None


def run_job(job: Mapping[str, Any], *, threads: int | None, time_limit: float) -> Answer:
    """The answer of a job, now in the file that it names: figures, or why there are none.

    A process that is killed or takes longer than the limit has an error for an answer too.

    Parameters
    ----------
    job : mapping
        What `cmfsim.lab.frontier.timing.worker.measured` takes; `answer` is the file's path.
    threads : int or None
        All cores if None.
    time_limit : float, s
    """
    path = Path(job["answer"])
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    task = "cmfsim.lab.frontier.timing.worker:measured"
    with Worker(threads=threads, log=SILENT) as worker:
        try:
            answer: Answer = worker.ask(task, {"job": dict(job)}, seconds=time_limit).values
        except WorkerFailedError as failed:
            answer = {"error": failed.trace[-LAST_WORDS:].strip()}
        except WorkerEndedError as ended:
            answer = {"error": f"exit code {ended.code}"}
            if ended.code < 0:
                signal = f"killed by signal {-ended.code}"
                answer = {"error": f"{signal}; 9 is most often lack of memory"}
            if ended.late:
                answer = {"error": f"{STOPPED} of {time_limit:g} s"}
    with replacing(path) as file:
        file.write(json.dumps(answer).encode())
    return answer
