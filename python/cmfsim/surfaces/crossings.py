"""Triangles of one surface that cut through each other.

A grid of cells about as large as a triangle gives the candidates; signed volumes decide. Exact up
to rounding: triangles that only touch, or that overlap in one plane, are not crossings.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from cmfsim.values.checks import Floats

Integers = NDArray[np.int64]

# Width of a cell, in mean sizes of a triangle.
CELL = 1.2
# Cells that a triangle may lie in on average; larger ones make the grid coarser.
CELLS_PER_TRIANGLE = 16
# Candidates that are tested at once: arrays that fit the cache.
CHUNK = 100_000
# Candidates above which the search is given up: hostile or broken files, not anatomy.
MAX_CANDIDATES = 400_000_000
# Largest number of cells along an axis: three fit one 63-bit key.
MAX_CELLS = 2**20


def crossing_pairs(vertices: Floats, triangles: Integers) -> Integers | None:
    """The pairs of triangles that cut through each other, (k, 2), or None if too many lie there.

    triangles: (t, 3) int64. None without area. The lower number of a pair stands first.
    """
    if len(triangles) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    # Axis by axis, as NumPy reduces an axis of three many times slower than it compares rows.
    a, b, c = (np.ascontiguousarray(vertices.T)[:, corner] for corner in triangles.T)
    grid = _Grid(np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c))
    if grid.n_candidates > MAX_CANDIDATES:
        return None
    corners = vertices[triangles]
    found = [pairs[_cross(corners, triangles, pairs)] for pairs in grid.candidates()]
    pairs = np.concatenate([np.zeros((0, 2), dtype=np.int64), *found])
    pairs = np.sort(pairs, axis=1)
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]


class _Grid:
    """The triangles in each cell, sorted by cell; low, high: (3, t), the ends of their boxes."""

    def __init__(self, low: Floats, high: Floats) -> None:
        origin, extents = low.min(axis=1)[:, None], high - low
        # About the mean size: smaller cells have fewer candidates, but more cells a triangle.
        cell = CELL * float(extents.max(axis=0).mean())
        cell = max(cell, float((high - origin).max()) / (MAX_CELLS - 1), np.finfo(float).tiny)
        while True:
            first = ((low - origin) / cell).astype(np.int64)
            spans = ((high - origin) / cell).astype(np.int64) - first + 1
            counts = spans.prod(axis=0)
            if counts.sum() <= CELLS_PER_TRIANGLE * low.shape[1]:
                break
            cell *= 2.0
        owner = np.repeat(np.arange(low.shape[1]), counts)
        step = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
        wide, high_up, _ = spans[:, owner]
        offset = (step % wide, step // wide % high_up, step // (wide * high_up))
        x, y, z = (own[owner] + more for own, more in zip(first, offset, strict=True))
        key = (x * MAX_CELLS + y) * MAX_CELLS + z
        order = np.argsort(key, kind="stable")
        key, self._low, self._high, self._owner = key[order], low, high, owner[order]
        # A bit for each axis along which the cell is not the first of its triangle.
        later = [(more > 0).astype(np.uint8) << axis for axis, more in enumerate(offset)]
        self._later = (later[0] | later[1] | later[2])[order]
        begins = np.flatnonzero(np.concatenate([[True], key[1:] != key[:-1]]))
        sizes = np.diff(np.concatenate([begins, [len(key)]]))
        ends = np.repeat(begins + sizes, sizes)
        # Each entry is paired with those after it in its cell.
        self._partners = ends - np.arange(len(key)) - 1
        self.n_candidates = int(self._partners.sum())

    def candidates(self) -> Iterator[Integers]:
        """Pairs whose boxes overlap, each once, in chunks."""
        bounds = np.cumsum(self._partners)
        begin = 0
        while begin < len(bounds):
            before = bounds[begin - 1] if begin else 0
            end = max(int(np.searchsorted(bounds, before + CHUNK, side="right")), begin + 1)
            counts = self._partners[begin:end]
            one = np.repeat(np.arange(begin, end), counts)
            shift = np.arange(len(one)) - np.repeat(np.cumsum(counts) - counts, counts)
            other = one + shift + 1
            # A pair that shares several cells counts in the first of them only: along each axis,
            # the first of one triangle or of the other.
            mine = (self._later[one] & self._later[other]) == 0
            a, b = self._owner[one[mine]], self._owner[other[mine]]
            for low, high in zip(self._low, self._high, strict=True):
                overlap = (low[a] <= high[b]) & (low[b] <= high[a])
                a, b = a[overlap], b[overlap]
            yield np.stack([a, b], axis=1)
            begin = end


def _cross(corners: Floats, triangles: Integers, pairs: Integers) -> NDArray[np.bool_]:
    """Whether each pair cuts through: an edge of one passes through the inside of the other."""
    crosses = np.zeros(len(pairs), dtype=bool)
    mine, others = triangles[pairs[:, 0]].T, triangles[pairs[:, 1]].T
    one, two, three = (_is_one_of(corner, others) for corner in mine)
    # Two neighbours by an edge cannot cut through each other; they can only lie on each other.
    rest = np.flatnonzero(~(one & two | two & three | three & one))
    for sides in ((0, 1), (1, 0)):
        a, b = pairs[rest][:, sides].T
        heights = _heights(corners[b], corners[a])
        above, below = (heights > 0.0).T, (heights < 0.0).T
        spread = (above[0] | above[1] | above[2]) & (below[0] | below[1] | below[2])
        rest, a, b, heights = rest[spread], a[spread], b[spread], heights[spread]
        hit = np.zeros(len(rest), dtype=bool)
        for i in range(3):
            j = (i + 1) % 3
            p, q = corners[a, i], corners[a, j]
            corners_b = triangles[b].T
            common = _is_one_of(triangles[a, i], corners_b) | _is_one_of(triangles[a, j], corners_b)
            between = (heights[:, i] * heights[:, j] < 0.0) & ~common
            hit |= between & _passes(p, q, corners[b])
        crosses[rest[hit]] = True
    return crosses


def _is_one_of(corner: Integers, corners: Integers) -> NDArray[np.bool_]:
    """Whether vertices (k,) are among the corners of triangles, (3, k)."""
    a, b, c = corners
    return np.asarray((corner == a) | (corner == b) | (corner == c), dtype=np.bool_)


def _heights(triangle: Floats, points: Floats) -> Floats:
    """Six times the signed volumes of a triangle with each of three points, (k, 3)."""
    a = triangle[:, 0]
    normal = np.cross(triangle[:, 1] - a, triangle[:, 2] - a)
    heights: Floats = np.einsum("kij,kj->ki", points - a[:, None], normal)
    return heights


def _passes(p: Floats, q: Floats, triangle: Floats) -> NDArray[np.bool_]:
    """Whether the line through p and q passes through the inside of each triangle."""
    along = q - p
    a, b, c = (triangle[:, i] - p for i in range(3))
    u = (np.cross(a, b) * along).sum(axis=1)
    v = (np.cross(b, c) * along).sum(axis=1)
    w = (np.cross(c, a) * along).sum(axis=1)
    same: NDArray[np.bool_] = ((u > 0.0) & (v > 0.0) & (w > 0.0)) | (
        (u < 0.0) & (v < 0.0) & (w < 0.0)
    )
    return same
