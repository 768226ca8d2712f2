"""Jobs in processes of their own, with one thread each, or on a cluster."""

import queue
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import Any

from cmfsim import errors
from cmfsim.errors import CaseError
from cmfsim.processes.cluster import on_cluster
from cmfsim.processes.worker import Worker


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
            return worker.ask(function, job).values
        finally:
            idle.put(worker)

    pool = ThreadPoolExecutor(workers)
    try:
        for _ in range(min(workers, len(jobs))):
            started.append(Worker(threads=1))
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
    with Worker(threads=1) as worker:
        return worker.ask(function, job).values
