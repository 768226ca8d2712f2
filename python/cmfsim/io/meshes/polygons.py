"""Triangles from the faces of a file: indices checked, polygons cut where only one way is right."""

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError
from cmfsim.values.checks import Floats

Integers = NDArray[np.int64]
# A corner may turn inwards by this share of a polygon's area and count as rounding.
FLAT_SHARE = 1e-9


def checked_indices(
    indices: Integers, count: int, *, of: str = "triangle", first: int = 0
) -> Integers:
    """The indices (m, k), if each names one of `count` vertices.

    indices: (m, k) int64, from 0 on.
    count: Number of vertices.
    of: What a row is, for the error.
    first: Number of the first vertex in the file's own count: 1 in OBJ, 0 elsewhere.
    Raises `CaseError`: An index below 0 or beyond the last.
    """
    if indices.size and (int(indices.min()) < 0 or int(indices.max()) >= count):
        row, column = np.argwhere((indices < 0) | (indices >= count))[0]
        value = int(indices[row, column]) + first
        allowed = f"{first} to {count - 1 + first}" if count else "none"
        hint = "" if first else "; is the file numbered from 1?" if value == count else ""
        raise CaseInputError(
            f"{of} {row} names vertex {value}, but there are {count} vertices (allowed {allowed})"
            f"{hint}"
        )
    return indices


def triangles_of(
    points: Floats, counts: Integers, corners: Integers, *, first: int = 0
) -> Integers:
    """The triangles (t, 3) of faces, in the order of the faces.

    A polygon becomes a fan of triangles about its first corner from which all of them face the same
    way; one that no fan fills, such as a star or a bow, is refused.

    points: (n, 3).
    counts: (f,) int64. Number of corners of each face.
    corners: (sum of counts,) int64, from 0 on.
    first: Number of the first vertex in the file's own count.
    Raises `CaseError`: A face of fewer than three corners, an index that is not there, a polygon
        that no fan fills.
    """
    few = np.flatnonzero(counts < 3)
    if len(few):
        raise CaseInputError(
            f"face {few[0]} has {counts[few[0]]} corners: three or more are needed"
        )
    if not (counts > 3).any():
        return checked_indices(corners.reshape(-1, 3), len(points), of="face", first=first)
    starts = np.cumsum(counts) - counts
    face = np.repeat(np.arange(len(counts)), counts)
    bad = np.flatnonzero((corners < 0) | (corners >= len(points)))
    if len(bad):
        value = int(corners[bad[0]]) + first
        raise CaseInputError(
            f"face {face[bad[0]]} names vertex {value}, but there are {len(points)} vertices"
        )
    corners = corners.copy()
    for size in np.unique(counts[counts > 3]):
        mine = np.flatnonzero(counts == size)
        rows = starts[mine][:, None] + np.arange(size)
        corners[rows] = _turned(points, corners[rows], mine)
    n_fan = counts - 2
    owner = np.repeat(np.arange(len(counts)), n_fan)
    step = np.arange(len(owner)) - np.repeat(np.cumsum(n_fan) - n_fan, n_fan) + 1
    at = starts[owner]
    return np.stack([corners[at], corners[at + step], corners[at + step + 1]], axis=1)


def triangles_of_strips(points: Floats, counts: Integers, corners: Integers) -> Integers:
    """The triangles (t, 3) of strips, each of which shares an edge with the one before.

    Every other triangle of a strip runs the other way round, so that all face the same way. One
    that names a corner twice joins two parts of a strip and is none.

    points: (n, 3).
    counts: (s,) int64. Number of corners of each strip.
    corners: (sum of counts,) int64, from 0 on.
    Raises `CaseError`: A strip of fewer than three corners, an index that is not there.
    """
    few = np.flatnonzero(counts < 3)
    if len(few):
        raise CaseInputError(
            f"strip {few[0]} has {counts[few[0]]} corners: three or more are needed"
        )
    begins = np.cumsum(counts) - counts
    within = np.arange(int(counts.sum())) - np.repeat(begins, counts)
    # A triangle begins at each corner of a strip but its last two.
    at = np.flatnonzero(within < np.repeat(counts, counts) - 2)
    odd = within[at] % 2
    triangles = np.stack([corners[at + odd], corners[at + 1 - odd], corners[at + 2]], axis=1)
    checked_indices(triangles, len(points), of="triangle")
    a, b, c = triangles.T
    whole: Integers = triangles[(a != b) & (b != c) & (c != a)]
    return whole


def _turned(points: Floats, polygons: Integers, faces: Integers) -> Integers:
    """Polygons (m, k) that each begin at a corner whose fan fills them."""
    polygons = polygons.copy()
    todo = np.arange(len(polygons))
    for _ in range(polygons.shape[1]):
        places = points[polygons[todo]]
        spokes = places[:, 1:] - places[:, :1]
        normals = np.cross(spokes[:, :-1], spokes[:, 1:])
        whole = normals.sum(axis=1)
        along = (normals * whole[:, None]).sum(axis=2)
        least = -FLAT_SHARE * (whole * whole).sum(axis=1)
        todo = todo[~(along >= least[:, None]).all(axis=1)]
        if not len(todo):
            return polygons
        polygons[todo] = np.roll(polygons[todo], -1, axis=1)
    raise CaseInputError(
        f"face {faces[todo[0]]} has {polygons.shape[1]} corners that no fan of triangles fills: "
        "triangulate the surface before it is exported"
    )
