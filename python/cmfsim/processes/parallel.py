"""Jobs in processes of their own, with one thread each, or on a cluster."""

import contextlib
import queue
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor, as_completed
from typing import Any, TypeVar

from cmfsim import errors
from cmfsim.errors import CaseError, CaseInputError, third_party
from cmfsim.processes.worker import Worker

# How long a scheduler may take to answer, s.
ANSWER_TIME = 10.0


def on_cluster(
    scheduler: str, function: Callable[..., Any], jobs: Sequence[Sequence[Any]]
) -> Iterator[tuple[int, Any, Exception | None]]:
    """The index of each job, and either what a function answers to it or raised, as they end.

    A job whose machine is lost is given to another one, as Dask does it; only one that loses
    several machines in a row is given up. The machines import the function by its name.
    """
    distributed = third_party("distributed", "work is distributed over a cluster", "study")
    try:
        client = distributed.Client(scheduler, timeout=ANSWER_TIME)
    except (OSError, ValueError) as error:
        raise CaseInputError(f"no Dask scheduler answers at {scheduler!r}: {error}") from error
    with client, contextlib.ExitStack() as stack:
        futures = [client.submit(function, *job, pure=False) for job in jobs]
        # Whoever stops listening wants no more of it.
        stack.callback(client.cancel, futures)
        index = {future.key: at for at, future in enumerate(futures)}
        for future in distributed.as_completed(futures):
            failure = future.exception()
            answer = None if failure is not None else future.result()
            yield index[future.key], answer, failure


Job = TypeVar("Job")
Made = TypeVar("Made")


def answers(
    function: str, jobs: Sequence[Mapping[str, Any]], workers: int, scheduler: str | None = None
) -> Iterator[tuple[int, Any]]:
    """What a function answers to each job, with the job's index, as they end.

    function: "module:name" of this package; it takes a job's plain values by name and returns some.
    workers: Processes; on a Dask cluster, which must see the same files, its scheduler decides.
    Raises `CmfsimError`: What the function raises, with its class.
    Raises `CaseError`: A process died, or met an error of another kind, which its text has.
    """
    if scheduler is not None:
        asked = [(function, dict(job)) for job in jobs]
        for index, answer, error in on_cluster(scheduler, answer_alone, asked):
            if isinstance(error, errors.CmfsimError):
                raise error
            if error is not None:
                raise CaseError(
                    f"the cluster abandoned a job ({error}): run the command again; what is "
                    "complete is kept"
                )
            yield index, answer
        return
    idle: queue.SimpleQueue[Worker] = queue.SimpleQueue()

    def ask(job: Mapping[str, Any], start: Callable[..., Worker]) -> Any:
        try:
            worker = idle.get_nowait()
        except queue.Empty:
            worker = start(threads=1)
        try:
            return worker.ask(function, job).values
        finally:
            idle.put(worker)

    yield from as_they_end(ask, jobs, workers)


def as_they_end(
    run: Callable[[Job, Callable[..., Worker]], Made], jobs: Sequence[Job], workers: int
) -> Iterator[tuple[int, Made]]:
    """What a function here makes of each job, in threads, with the job's index, as they end.

    run: Takes a job, and what starts a `Worker`. All workers end when the caller stops listening.
    """
    lock, ended = threading.Lock(), threading.Event()
    started: list[Worker] = []

    def start(**options: Any) -> Worker:
        with lock:
            if ended.is_set():
                raise CancelledError
            started.append(Worker(**options))
            return started[-1]

    with ThreadPoolExecutor(workers) as pool:
        running = {pool.submit(run, job, start): index for index, job in enumerate(jobs)}
        try:
            for future in as_completed(running):
                yield running[future], future.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            with lock:
                ended.set()
            for worker in started:
                worker.end()


def answer_alone(function: str, job: Mapping[str, Any]) -> Any:
    """The answer to one job from a process of its own, which has one thread wherever it runs."""
    with Worker(threads=1) as worker:
        return worker.ask(function, job).values
