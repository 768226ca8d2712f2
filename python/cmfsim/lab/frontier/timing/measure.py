"""Runs one job in a fresh process, within a time limit, and keeps its answer."""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

Answer = dict[str, Any]
# Begins the error of a job that took too long.
STOPPED = "stopped after the time limit"
# Characters of a failed process's last words that are kept.
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
        What `cmfsim.lab.frontier.timing.worker` takes; `answer` is the file's path.
    threads : int or None
        All cores if None.
    time_limit : float, s
    """
    path = Path(job["answer"])
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    environment = dict(os.environ)
    if threads is not None:
        environment["RAYON_NUM_THREADS"] = environment["OPENBLAS_NUM_THREADS"] = str(threads)
    with tempfile.TemporaryDirectory(prefix=".job-", dir=path.parent) as folder:
        file = Path(folder) / "job.json"
        file.write_text(json.dumps(job), encoding="utf-8")
        try:
            done = subprocess.run(  # noqa: S603 (this interpreter and our own words)
                [sys.executable, "-m", "cmfsim.lab.frontier.timing.worker", str(file)],
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                timeout=time_limit,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return _failed(path, f"{STOPPED} of {time_limit:g} s")
    answer = kept(path)
    if answer is not None:
        return answer
    if done.returncode < 0:
        return _failed(path, f"killed by signal {-done.returncode}; 9 is most often lack of memory")
    words = done.stderr.decode("utf-8", errors="replace").strip()[-LAST_WORDS:]
    return _failed(path, f"exit code {done.returncode}: {words}")


def _failed(path: Path, why: str) -> Answer:
    answer: Answer = {"error": why}
    path.write_text(json.dumps(answer), encoding="utf-8")
    return answer
