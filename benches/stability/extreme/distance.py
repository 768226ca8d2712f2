"""True distances to a triangle surface by testing every triangle: no tree, no code of cmfsim."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Indices = NDArray[np.uint32]

# Triangles whose distances differ by less, over the size of the surface, are equally close.
TIE = 1e-9


@dataclass(frozen=True, eq=False)
class Closest:
    """Where points are nearest to a surface.

    Attributes
    ----------
    points : (k, 3) float64, mm
    distances : (k,) float64, mm
        Negative behind the surface.
    normals : list of (j, 3) float64
        Unit normals of the triangles that are equally close to each point, the nearest first.
    """

    points: Floats
    distances: Floats
    normals: list[Floats]


def facet_normals(vertices: Floats, triangles: Indices) -> Floats:
    """Unit normal of each triangle."""
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    unit: Floats = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return unit


def closest(points: Floats, vertices: Floats, triangles: Indices) -> Closest:
    """The closest points of a surface, the side by the triangle seen least edge-on."""
    corners = vertices[triangles]
    normals = facet_normals(vertices, triangles)
    size = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    found, distances, equal = [], [], []
    for p in points:
        feet = _feet(p, corners, normals)
        away = np.linalg.norm(p - feet, axis=1)
        near = np.flatnonzero(away <= away.min() + TIE * size)
        heights = np.einsum("ij,ij->i", p - feet[near], normals[near])
        best = np.argmax(np.abs(heights))
        found.append(feet[away.argmin()])
        distances.append(np.copysign(away.min(), heights[best]))
        order = np.argsort(away[near], kind="stable")
        equal.append(normals[near][order])
    return Closest(np.array(found), np.array(distances), equal)


def _feet(p: Floats, corners: Floats, normals: Floats) -> Floats:
    """The point of each triangle that is nearest to `p`: inside it, or on its nearest side."""
    best = p - np.einsum("ij,ij->i", p - corners[:, 0], normals)[:, None] * normals
    inside = np.ones(len(corners), dtype=bool)
    shortest = np.full(len(corners), np.inf)
    side_feet = np.empty_like(best)
    for i in range(3):
        a, b = corners[:, i], corners[:, (i + 1) % 3]
        e = b - a
        inside &= np.einsum("ij,ij->i", np.cross(e, best - a), normals) >= 0.0
        t = np.clip(np.einsum("ij,ij->i", p - a, e) / np.einsum("ij,ij->i", e, e), 0.0, 1.0)
        foot = a + t[:, None] * e
        length = np.linalg.norm(p - foot, axis=1)
        nearer = length < shortest
        side_feet[nearer], shortest[nearer] = foot[nearer], length[nearer]
    feet: Floats = np.where(inside[:, None], best, side_feet)
    return feet
