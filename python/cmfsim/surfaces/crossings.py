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
    """The pairs of triangles that cut through each other, or None if too many lie in one place.

    vertices: (v, 3).
    triangles: (t, 3) int64. None without area.
    Returns: (k, 2) int64 or None. The lower number first, in order.
    """
    if len(triangles) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    corners = vertices[triangles]
    low, high = corners.min(axis=1), corners.max(axis=1)
    grid = _Grid(low, high)
    if grid.n_candidates > MAX_CANDIDATES:
        return None
    found = [pairs[_cross(corners, triangles, pairs)] for pairs in grid.candidates(low, high)]
    pairs = np.concatenate([np.zeros((0, 2), dtype=np.int64), *found])
    pairs = np.sort(pairs, axis=1)
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]


class _Grid:
    """The triangles in each cell, sorted by cell."""

    def __init__(self, low: Floats, high: Floats) -> None:
        origin, end = low.min(axis=0), high.max(axis=0)
        extents = high - low
        # About the mean size: smaller cells have fewer candidates, but more cells a triangle.
        cell = CELL * float(extents.max(axis=1).mean())
        cell = max(cell, float((end - origin).max()) / (MAX_CELLS - 1), np.finfo(float).tiny)
        while True:
            first = ((low - origin) / cell).astype(np.int64)
            last = ((high - origin) / cell).astype(np.int64)
            spans = last - first + 1
            counts = spans.prod(axis=1)
            if counts.sum() <= CELLS_PER_TRIANGLE * len(low):
                break
            cell *= 2.0
        self._first = first
        owner = np.repeat(np.arange(len(low)), counts)
        step = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
        span = spans[owner]
        offset = np.stack(
            [step % span[:, 0], step // span[:, 0] % span[:, 1], step // (span[:, 0] * span[:, 1])],
            axis=1,
        )
        place = first[owner] + offset
        key = (place[:, 0] * MAX_CELLS + place[:, 1]) * MAX_CELLS + place[:, 2]
        order = np.argsort(key, kind="stable")
        self._owner, self._place, key = owner[order], place[order], key[order]
        starts = np.flatnonzero(np.concatenate([[True], key[1:] != key[:-1]]))
        sizes = np.diff(np.concatenate([starts, [len(key)]]))
        ends = np.repeat(starts + sizes, sizes)
        # Each entry is paired with those after it in its cell.
        self._partners = ends - np.arange(len(key)) - 1
        self.n_candidates = int(self._partners.sum())

    def candidates(self, low: Floats, high: Floats) -> Iterator[Integers]:
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
            place = self._place[one]
            a, b = self._owner[one], self._owner[other]
            # A pair that shares several cells counts in the first of them only.
            mine = (place == np.maximum(self._first[a], self._first[b])).all(axis=1)
            a, b = a[mine], b[mine]
            overlap = ((low[a] <= high[b]) & (low[b] <= high[a])).all(axis=1)
            yield np.stack([a[overlap], b[overlap]], axis=1)
            begin = end


def _cross(corners: Floats, triangles: Integers, pairs: Integers) -> NDArray[np.bool_]:
    """Whether each pair cuts through: an edge of one passes through the inside of the other."""
    crosses = np.zeros(len(pairs), dtype=bool)
    shared = (triangles[pairs[:, 0]][:, :, None] == triangles[pairs[:, 1]][:, None, :]).any(axis=2)
    # Two neighbours by an edge cannot cut through each other; they can only lie on each other.
    rest = np.flatnonzero(shared.sum(axis=1) < 2)
    for one, other in ((0, 1), (1, 0)):
        a, b = pairs[rest, one], pairs[rest, other]
        heights = _heights(corners[b], corners[a])
        spread = (heights.max(axis=1) > 0.0) & (heights.min(axis=1) < 0.0)
        rest, a, b, heights = rest[spread], a[spread], b[spread], heights[spread]
        hit = np.zeros(len(rest), dtype=bool)
        for i in range(3):
            j = (i + 1) % 3
            p, q = corners[a, i], corners[a, j]
            common = (
                (triangles[a, i][:, None] == triangles[b])
                | (triangles[a, j][:, None] == triangles[b])
            ).any(axis=1)
            between = (heights[:, i] * heights[:, j] < 0.0) & ~common
            hit |= between & _passes(p, q, corners[b])
        crosses[rest[hit]] = True
    return crosses


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
