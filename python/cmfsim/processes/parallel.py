"""Jobs in processes of their own, with one thread each, which end with what started them.

A process of this package's own making needs no `if __name__ == "__main__"` in the user's script, as
those of `multiprocessing` do, and a killed command leaves none behind that goes on writing.
"""

import json
import os
import queue
import subprocess
import sys
import threading
import traceback
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from importlib import import_module
from pathlib import Path
from typing import IO, Any

from cmfsim import errors
from cmfsim.errors import CaseError
from cmfsim.processes.cluster import on_cluster

# The child's program: it finds the same modules as its parent, and nothing else is run.
PROGRAM = (
    "import json, sys; sys.path[:] = json.loads(sys.stdin.buffer.readline());"
    "from cmfsim.processes.parallel import serve; serve()"
)
# Read when numpy and the extension are loaded; with one thread sums have one order everywhere.
THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "RAYON_NUM_THREADS")


def answers(
    function: str, jobs: Sequence[Mapping[str, Any]], workers: int, scheduler: str | None = None
) -> Iterator[tuple[int, Any]]:
    """What a function answers to each job, with the job's index, as they end.

    Parameters
    ----------
    function : str
        "module:name" of this package; it takes a job's values by name and returns plain values.
    jobs : sequence of mapping
        Plain values, as JSON has them.
    workers : int
        Processes.
    scheduler : str, optional
        Address of a Dask cluster that sees the same files; it then decides how many run at a time.

    Raises
    ------
    CmfsimError
        What the function raises, with its class.
    CaseError
        A process died, or met an error of another kind, which its text has; no cluster answers.
    """
    if scheduler is not None:
        yield from _on_cluster(function, jobs, scheduler)
        return
    idle: queue.SimpleQueue[Worker] = queue.SimpleQueue()
    started: list[Worker] = []

    def ask(job: Mapping[str, Any]) -> Any:
        worker = idle.get()
        try:
            return worker.answer(function, job)
        finally:
            idle.put(worker)

    pool = ThreadPoolExecutor(workers)
    try:
        for _ in range(min(workers, len(jobs))):
            started.append(Worker())
            idle.put(started[-1])
        running = {pool.submit(ask, job): index for index, job in enumerate(jobs)}
        for future in as_completed(running):
            yield running[future], future.result()
    finally:
        for worker in started:
            worker.end()
        pool.shutdown(cancel_futures=True)


def _on_cluster(
    function: str, jobs: Sequence[Mapping[str, Any]], scheduler: str
) -> Iterator[tuple[int, Any]]:
    asked = [(function, dict(job)) for job in jobs]
    for index, answer, error in on_cluster(scheduler, answer_alone, asked):
        if isinstance(error, errors.CmfsimError):
            raise error
        if error is not None:
            raise CaseError(
                f"the cluster abandoned a job ({error}): run the command again; what is complete "
                "is kept"
            )
        yield index, answer


def answer_alone(function: str, job: Mapping[str, Any]) -> Any:
    """The answer to one job from a process of its own, which has one thread wherever it runs."""
    worker = Worker()
    try:
        return worker.answer(function, job)
    finally:
        worker.end()


class Worker:
    """A process that takes jobs one after the other, a line of JSON each."""

    def __init__(self) -> None:
        environment = {**os.environ, **dict.fromkeys(THREADS, "1")}
        self._process = subprocess.Popen(  # noqa: S603 (this very Python, and no shell)
            [sys.executable, "-I", "-c", PROGRAM],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=environment,
        )
        self._send([str(Path(path).absolute()) for path in sys.path])

    def _send(self, value: object) -> None:
        stream = _open(self._process.stdin)
        stream.write(json.dumps(value).encode() + b"\n")
        stream.flush()

    @property
    def has_ended(self) -> bool:
        """Whether the process is gone, as after a crash of a library."""
        return self._process.poll() is not None

    def answer(self, function: str, job: Mapping[str, Any]) -> Any:
        """What the function answers to a job; see `answers`."""
        line = b""
        try:
            self._send({"function": function, "job": dict(job)})
            line = _open(self._process.stdout).readline()
        except OSError:
            pass
        if not line:
            raise CaseError(
                f"a worker process died (exit code {self._process.wait()}), perhaps out of memory: "
                "run the command again, with fewer workers; what is complete is kept"
            )
        found = json.loads(line)
        if "error" in found:
            kind = getattr(errors, found["error"], None)
            if isinstance(kind, type) and issubclass(kind, errors.CmfsimError):
                raise kind(found["text"])
            raise CaseError(f"{found['error']} in a worker process:\n{found['text']}")
        return found["answer"]

    def end(self) -> None:
        """Ends the process, whatever it is doing."""
        self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout):
            _open(stream).close()


def _open(stream: IO[bytes] | None) -> IO[bytes]:
    assert stream is not None  # noqa: S101 (both were asked for)
    return stream


def serve() -> None:
    """Works on jobs until standard input ends; then the process ends, whatever it is doing."""
    # What a library prints must not become an answer.
    results = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    lines: queue.SimpleQueue[bytes] = queue.SimpleQueue()

    def read() -> None:
        for line in sys.stdin.buffer:
            lines.put(line)
        os._exit(0)

    threading.Thread(target=read, daemon=True).start()
    while True:
        results.write(json.dumps(_done(json.loads(lines.get()))).encode() + b"\n")
        results.flush()


def _done(request: Mapping[str, Any]) -> dict[str, Any]:
    """The answer to one job, or its error."""
    module, name = request["function"].split(":")
    try:
        return {"answer": getattr(import_module(module), name)(**request["job"])}
    except errors.CmfsimError as error:
        return {"error": type(error).__name__, "text": str(error)}
    except Exception as error:  # noqa: BLE001 (told to the one who asked)
        return {"error": type(error).__name__, "text": traceback.format_exc()}
