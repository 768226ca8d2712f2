"""Depth of the soft tissue below each point of the skin, and a skin moved outward."""

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

    points: (k, 3), mm.
    Raises `MeshError`: No bone is given.
    """
    places = as_rows("points", points, 3)
    depth = np.full(len(places), np.inf)
    for bone in bones:
        closest, _, _ = bone.searched.closest(places)
        depth = np.minimum(depth, np.linalg.norm(closest - places, axis=1))
    if len(depth) and not np.isfinite(depth).all():
        raise MeshInputError(
            "the depth of the soft tissue needs at least one bone, but there is none"
        )
    capped: Floats = np.minimum(depth, MOST_DEPTH)
    return capped


def moved_outward(skin: Surface, vertices: Floats, outward: Floats) -> Floats:
    """The vertices of a moved skin, each shifted outward along its normal.

    skin: Gives the triangles.
    vertices: (v, 3), mm.
    outward: (v,), mm.
    """
    normals = skin.moved(vertices).vertex_normals
    shifted: Floats = vertices + outward[:, None] * normals
    return shifted


def distances(points: Floats, surface: Surface) -> Floats:
    """The distance of each of (k, 3) points from a surface, (k,) mm."""
    if not len(points):
        return np.zeros(0)
    away: Floats = np.linalg.norm(surface.closest(points)[0] - points, axis=1)
    return away
