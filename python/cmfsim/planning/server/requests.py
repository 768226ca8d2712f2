"""Checks that every request must pass, and the plan that it contains.

The server listens on the local address only, but any web site open in the same browser can send
requests to it. Every request must therefore have the random token of this launch in its path and
the exact host and port as Host (against DNS rebinding). If it sends data, its Origin must be the
page's own.
"""

import hmac
import json
from collections.abc import Mapping

import numpy as np

from cmfsim.errors import BoundaryError, CaseInputError
from cmfsim.planning.replanning import PlanningModel
from cmfsim.values.checks import Floats

# A plan of fifty segments takes about 16 kB.
MOST_BYTES = 65_536
# Longest motion of a plan, mm: anything longer is a wrong unit.
MOST_SHIFT = 1000.0


class RefusedError(Exception):
    """A request that is answered with an error."""

    def __init__(self, status: int, text: str) -> None:
        super().__init__(text)
        self.status = status


def check_token(given: str, token: str) -> None:
    """Refuses any token but that of this launch, in constant time.

    Raises
    ------
    RefusedError
    """
    if not hmac.compare_digest(given.encode(), token.encode()):
        raise RefusedError(404, "not found")


def check_headers(headers: Mapping[str, str], address: str, *, sends: bool) -> None:
    """Refuses requests that the page at this address did not send.

    Parameters
    ----------
    headers : mapping of str to str
        With names in lower case.
    address : str
        Host and port, such as "127.0.0.1:8765".
    sends : bool
        Whether the request sends a plan.

    Raises
    ------
    RefusedError
    """
    if headers.get("host") != address:
        raise RefusedError(403, "wrong host")
    origin = headers.get("origin")
    if origin is not None and origin != f"http://{address}":
        raise RefusedError(403, "wrong origin")
    if not sends:
        return
    if origin is None:
        raise RefusedError(403, "no origin")
    if headers.get("content-type") != "application/json":
        raise RefusedError(415, "application/json is needed")
    length = headers.get("content-length", "")
    if not length.isdecimal():
        raise RefusedError(411, "the length of the plan is needed")
    if int(length) > MOST_BYTES:
        raise RefusedError(413, f"a plan has at most {MOST_BYTES} bytes")


def plan_of_body(planning: PlanningModel, body: bytes) -> dict[str, Floats]:
    """The plan in a request: JSON with `motions`, 16 numbers for each segment in the page's order.

    Raises
    ------
    RefusedError
        Anything else; a motion that is not rigid, or longer than a metre.
    """
    try:
        given = json.loads(body)["motions"]
        if not _are_numbers(given):
            raise RefusedError(400, "motions are needed as lists of numbers")
        rows = np.array(given, dtype=np.float64)
    except (ValueError, TypeError, KeyError, RecursionError, OverflowError) as error:
        raise RefusedError(400, "motions are needed as JSON") from error
    if rows.shape != (len(planning.segments), 16) or not np.isfinite(rows).all():
        count = len(planning.segments)
        raise RefusedError(400, f"16 finite numbers are needed for each of {count} segments")
    plan = {name: row.reshape(4, 4) for name, row in zip(planning.segments, rows, strict=True)}
    for name, segment in _centres(planning).items():
        way = plan[name][:3, :3] @ segment + plan[name][:3, 3] - segment
        if float(np.linalg.norm(way)) > MOST_SHIFT:
            raise RefusedError(400, f"{name} would move by more than {MOST_SHIFT:g} mm")
    try:
        return planning.whole(plan)
    except (BoundaryError, CaseInputError) as error:
        raise RefusedError(400, str(error)) from error


def _are_numbers(given: object) -> bool:
    """Whether a value is lists of numbers: numpy takes texts, true and null for some as well."""
    return isinstance(given, list) and all(
        isinstance(row, list)
        and all(isinstance(v, int | float) and not isinstance(v, bool) for v in row)
        for row in given
    )


def _centres(planning: PlanningModel) -> dict[str, Floats]:
    return dict(zip(planning.segments, planning.columns.centres, strict=True))
