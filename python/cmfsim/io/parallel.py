"""Worker processes with one thread each, which end with the process that started them."""

import os
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context, parent_process

from cmfsim.errors import CaseError

__all__ = ["one_thread_each", "worker_pool"]

# Read when numpy and the extension are loaded; with one thread sums have one order everywhere.
THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "RAYON_NUM_THREADS")


@contextmanager
def worker_pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Processes that work on jobs; what is not begun is cancelled where an error ends the block.

    Raises
    ------
    CaseError
        A process died.
    """
    # Spawned, since a forked process would share the threads of this one.
    spawn = get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=spawn, initializer=_end_with_parent) as pool:
        try:
            yield pool
        except BrokenProcessPool as error:
            raise CaseError(
                "a worker process died, perhaps for want of memory: run the command again, with "
                "fewer workers; what is complete is kept"
            ) from error
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Has processes that are started in the block use one thread each."""
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _end_with_parent() -> None:
    """Has this process end when the one that started it does, however that ends.

    A worker that outlives a command that was killed would write into the folder of the next one.
    """
    parent = parent_process()
    if parent is not None:

        def watch() -> None:
            parent.join()
            os._exit(1)

        threading.Thread(target=watch, daemon=True).start()
