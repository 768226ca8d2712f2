"""Arrays as text: one block of bytes, compressed, in base64, with a table of what lies where."""

import base64
import gzip
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError

TYPES = ("float32", "float16", "uint32")
# Arrays begin at multiples of this, bytes, as typed arrays of JavaScript need it.
ALIGNED = 8


def packed_arrays(arrays: Mapping[str, NDArray[Any]]) -> tuple[str, list[dict[str, Any]]]:
    """The text of arrays, and where each of them starts: `name`, `type`, `shape`, `start`.

    Raises
    ------
    CaseError
        (also `ValueError`) A number that is not finite, or too large for its precision.
    """
    table: list[dict[str, Any]] = []
    block = bytearray()
    for name, array in arrays.items():
        kind = array.dtype.name
        if kind not in TYPES:
            raise CaseInputError(f"array {name!r} has type {kind}: one of {', '.join(TYPES)}")
        if not np.isfinite(array).all():
            raise CaseInputError(
                f"array {name!r} of the page holds numbers that are not finite in {kind}"
            )
        block.extend(b"\0" * (-len(block) % ALIGNED))
        table.append({"name": name, "type": kind, "shape": list(array.shape), "start": len(block)})
        block.extend(np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<")).tobytes())
    # Without the time, so that equal pages have equal bytes.
    return base64.b64encode(gzip.compress(bytes(block), 9, mtime=0)).decode(), table
