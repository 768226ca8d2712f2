"""Closest points of surfaces: depth of the soft tissue, distances, values between vertices."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike

from cmfsim._core import Surface
from cmfsim.errors import MeshInputError
from cmfsim.values.checks import Floats, as_rows
from cmfsim.values.surface_data import SurfaceData

# Beyond this the closest bone is not below the skin but beside what was segmented, mm: the thickest
# soft tissue of the face, in front of the masseter, is about 25 mm (De Greef et al. 2006).
MOST_DEPTH = 30.0


def tissue_depth(points: ArrayLike, bones: Iterable[SurfaceData]) -> Floats:
    """The distance of each point of the skin from the closest bone, (k,) mm, 30 mm at most.

    Raises `MeshError`: No bone is given.
    """
    places = as_rows("points", points, 3)
    depth = np.full(len(places), np.inf)
    for bone in bones:
        depth = np.minimum(depth, distances(places, bone.searched))
    if len(depth) and not np.isfinite(depth).all():
        raise MeshInputError(
            "the depth of the soft tissue needs at least one bone, but there is none"
        )
    capped: Floats = np.minimum(depth, MOST_DEPTH)
    return capped


def moved_outward(skin: Surface, vertices: Floats, outward: Floats) -> Floats:
    """The vertices of a moved skin of the triangles of `skin`, shifted along their normals, mm."""
    normals = skin.moved(vertices).vertex_normals
    shifted: Floats = vertices + outward[:, None] * normals
    return shifted


def distances(points: Floats, surface: Surface) -> Floats:
    """The distance of each of (k, 3) points from a surface, (k,) mm."""
    if not len(points):
        return np.zeros(0)
    away: Floats = np.linalg.norm(surface.closest(points)[0] - points, axis=1)
    return away


def barycentric(corners: Floats, points: Floats) -> Floats:
    """The weights (k, 3) of the corners (k, 3, 3) of triangles at a point in the plane of each."""
    a, b, c = (corners[:, i] for i in range(3))
    normal = np.cross(b - a, c - a)
    square = (normal * normal).sum(axis=1)
    of_a = (np.cross(c - b, points - b) * normal).sum(axis=1) / square
    of_b = (np.cross(a - c, points - c) * normal).sum(axis=1) / square
    return np.stack([of_a, of_b, 1.0 - of_a - of_b], axis=1)


def at_closest(surface: Surface, values: ArrayLike, points: ArrayLike) -> Floats:
    """A field of a surface's vertices at its points that are closest to others, (k,)."""
    closest, _, triangles = surface.closest(points)
    vertices, corners = surface.vertices, surface.triangles[triangles]
    # Rounding puts points of an edge a little beyond it.
    weights = np.clip(barycentric(vertices[corners], closest), 0.0, 1.0)
    field = np.asarray(values, dtype=np.float64)[corners]
    found: Floats = (weights * field).sum(axis=1) / weights.sum(axis=1)
    return found
