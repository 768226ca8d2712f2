"""Plain binary PLY: points and triangles alone, read as two blocks of memory."""

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["read_plain_ply"]

# Length of a PLY header with any number of properties and comments, bytes.
MAX_HEADER = 2**16
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
TYPES = {
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
}
HEADER = re.compile(
    r"ply\nformat (binary_(?:little|big)_endian) 1\.0\n"
    r"element vertex (\d+)\n"
    r"property (float|float32|double|float64) x\n"
    r"property \3 y\nproperty \3 z\n"
    r"element face (\d+)\n"
    r"property list (uchar|uint8) (int|int32|uint|uint32) vertex_(?:index|indices)\n"
    r"end_header\n"
)


def read_plain_ply(path: Path) -> tuple[NDArray[Any], NDArray[Any]] | None:
    """The points (n, 3) and triangles (m, 3) of a file that holds just these.

    None for every other PLY: text, colours, polygons, a file cut short, a triangle at a point that
    is not there. What is wrong with such a file, a reader of all of PLY knows better.
    """
    data = path.read_bytes()
    end = data.find(b"end_header\n", 0, MAX_HEADER) + len(b"end_header\n")
    lines = data[:end].decode("ascii", "replace").splitlines(keepends=True)
    found = HEADER.fullmatch("".join(s for s in lines if not s.startswith("comment")))
    if found is None:
        return None
    order, n, real, m, count, whole = found.groups()
    sign = ORDERS[order]
    row = np.dtype([("count", TYPES[count]), ("corners", sign + TYPES[whole], 3)])
    place = np.dtype((sign + TYPES[real], 3))
    if len(data) != end + int(n) * place.itemsize + int(m) * row.itemsize:
        return None
    rows = np.frombuffer(data, row, int(m), end + int(n) * place.itemsize)
    triangles = rows["corners"]
    if (rows["count"] != 3).any() or (triangles.size and not _within(triangles, int(n))):
        return None
    points = np.frombuffer(data, sign + TYPES[real], 3 * int(n), end).reshape(-1, 3)
    return points.astype(points.dtype.newbyteorder("=")), triangles.astype(
        triangles.dtype.newbyteorder("=")
    )


def _within(triangles: NDArray[Any], n: int) -> bool:
    return bool(triangles.min() >= 0 and triangles.max() < n)
