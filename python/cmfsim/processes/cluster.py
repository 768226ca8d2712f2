"""Jobs on a Dask cluster, whose machines see the same files as this one."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from cmfsim.errors import CaseInputError, third_party

# How long a scheduler may take to answer, s.
ANSWER_TIME = 10.0


def on_cluster(
    scheduler: str, function: Callable[..., Any], jobs: Sequence[Sequence[Any]]
) -> Iterator[tuple[int, Any, Exception | None]]:
    """What a function answers to each job, with the job's index, as they end.

    A job whose machine is lost is given to another one, as Dask does it; only one that loses
    several machines in a row is given up.

    scheduler: Address of the cluster.
    function: The machines import it by its name.
    jobs: Arguments.
    Yields: Index, and either the answer or what the function raised, or the cluster for it.
    Raises `CaseError`: No Dask installed, or no cluster at the address.
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
