"""Weights of a triangle's corners at points, and values of vertices between them."""

import numpy as np
from numpy.typing import ArrayLike

from cmfsim._core import Surface
from cmfsim.values.checks import Floats


def barycentric(corners: Floats, points: Floats) -> Floats:
    """The weights of each triangle's corners at a point in its plane, (k, 3).

    corners: (k, 3, 3). Triangle, corner, coordinate.
    points: (k, 3).
    """
    a, b, c = (corners[:, i] for i in range(3))
    normal = np.cross(b - a, c - a)
    square = (normal * normal).sum(axis=1)
    of_a = (np.cross(c - b, points - b) * normal).sum(axis=1) / square
    of_b = (np.cross(a - c, points - c) * normal).sum(axis=1) / square
    return np.stack([of_a, of_b, 1.0 - of_a - of_b], axis=1)


def at_closest(surface: Surface, values: ArrayLike, points: ArrayLike) -> Floats:
    """A field of a surface's vertices at the points of it that are closest to others, (k,).

    values: (v,), of its vertices.
    points: (k, 3), mm.
    """
    closest, _, triangles = surface.closest(points)
    vertices, corners = surface.vertices, surface.triangles[triangles]
    # Rounding puts points of an edge a little beyond it.
    weights = np.clip(barycentric(vertices[corners], closest), 0.0, 1.0)
    field = np.asarray(values, dtype=np.float64)[corners]
    found: Floats = (weights * field).sum(axis=1) / weights.sum(axis=1)
    return found
