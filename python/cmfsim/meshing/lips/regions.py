"""Finds the two lips on the boundary of a mesh that was separated at their seam."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim._core import Surface
from cmfsim.errors import CaseInputError
from cmfsim.surfaces.topology import connected_labels, edges_of
from cmfsim.values.case_parts import LIP_HEIGHT
from cmfsim.values.checks import Floats, Indices, as_index_rows, as_positive, as_rows
from cmfsim.values.node_kinds import NODE_KINDS, NodeKinds
from cmfsim.values.surface_data import SurfaceData
from cmfsim.values.touching import LIPS, LipRegion

# A triangle lies above or below the seam, and not past a corner of the mouth or behind the teeth,
# where the way to it leads off the normal of the seam by this share of its length, or so many mm.
ASLANT, ASLANT_MM = 0.5, 1.0
# The side of a triangle is judged from a point this far inside the tissue, relative to its size.
INSIDE = 0.25
# Patches smaller than this share of the largest are dropped. The side facing the teeth may be a
# separate patch where the cut ends at an edge shared by many triangles.
LEAST_PATCH = 0.1


def lip_regions(
    nodes: ArrayLike,
    boundary_triangles: ArrayLike,
    kinds: NodeKinds,
    seam: SurfaceData,
    *,
    height: float = LIP_HEIGHT,
) -> dict[str, LipRegion]:
    """The upper and the lower lip of a mesh that was separated at a seam.

    Parameters
    ----------
    nodes : (n, 3) float64, mm
    boundary_triangles : (t, 3) uint32
        Boundary of the separated mesh, outward.
    kinds : NodeKinds
        Before nodes of the lips are released. Joined and fixed nodes may be corners of a lip's
        triangles, as at the edges of teeth, which would otherwise cut it in two, but are not nodes
        of it.
    seam : SurfaceData
        Open, with normals towards the upper lip; from in front of the skin to behind the teeth.
    height : float, mm
        How far the lips extend from the seam.

    Returns
    -------
    dict of str to LipRegion
        "upper" and "lower".

    Raises
    ------
    CaseError
        (also `ValueError`) No triangle above or below the seam; misshapen arrays.

    Examples
    --------
    >>> import cmfsim
    >>> lips = cmfsim.lip_regions(nodes, triangles, kinds, seam.surface)  # doctest: +SKIP
    >>> lips["upper"].nodes  # doctest: +SKIP
    """
    points = as_rows("nodes", nodes, 3)
    triangles = as_index_rows("boundary triangles", boundary_triangles, 3, len(points), "nodes")
    side = _sides(points, triangles, seam, as_positive("height of the lips", height))
    held = np.isin(kinds.kind, [NODE_KINDS.index("fixed"), NODE_KINDS.index("joined")])
    patches = {}
    for name, sign in zip(LIPS, (1, -1), strict=True):
        mine = triangles[side == sign]
        if not len(mine):
            raise CaseInputError(
                f"no boundary of the tissue lies within {height:g} mm "
                f"{'above' if sign > 0 else 'below'} the seam between the lips: it must run "
                "through the mouth, with its normals up"
            )
        patches[name] = _without_scraps(mine)
    return {
        name: _region(patches[name], patches[LIPS[name == "upper"]], kinds, held) for name in LIPS
    }


def _sides(
    points: Floats, triangles: Indices, seam: SurfaceData, height: float
) -> NDArray[np.int8]:
    """+1 for triangles above the seam, −1 for those below it, 0 for all others."""
    corners = points[triangles]
    centroids = corners.mean(axis=1)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    inwards = normal / np.maximum(area, np.finfo(float).tiny)[:, None]
    # Faces on the seam itself lie on neither side of it: a point inside their tissue decides.
    places = centroids - INSIDE * np.sqrt(area)[:, None] * inwards
    side = np.zeros(len(triangles), dtype=np.int8)
    vertices = seam.vertices
    low, high = vertices.min(axis=0) - height, vertices.max(axis=0) + height
    near = np.flatnonzero(((places >= low) & (places <= high)).all(axis=1))
    if not len(near):
        return side
    closest, normals, _ = Surface(seam.vertices, seam.triangles).closest(places[near])
    way = places[near] - closest
    length = np.linalg.norm(way, axis=1)
    upwards = np.einsum("na,na->n", way, normals)
    aslant = np.linalg.norm(way - upwards[:, None] * normals, axis=1)
    over = aslant <= np.maximum(ASLANT * length, ASLANT_MM)
    side[near] = np.where(over & (length <= height), np.sign(upwards).astype(np.int8), 0)
    return side


def _without_scraps(triangles: Indices) -> Indices:
    """The triangles without small patches that no edge connects to the rest."""
    edges = edges_of(triangles.astype(np.int64))
    label = connected_labels(edges.pairs, len(triangles))
    size = np.bincount(label)
    large: Indices = triangles[size[label] >= LEAST_PATCH * size.max()]
    return large


def _region(mine: Indices, other: Indices, kinds: NodeKinds, held: NDArray[np.bool_]) -> LipRegion:
    nodes = np.setdiff1d(mine, other)
    nodes = nodes[~held[nodes]].astype(np.uint32)
    slides = kinds.kind[nodes] == NODE_KINDS.index("sliding")
    released = {
        name: nodes[slides & (kinds.segment[nodes] == number)]
        for number, name in enumerate(kinds.segments)
    }
    return LipRegion(mine, nodes, {n: ids for n, ids in released.items() if len(ids)})


def seam_faces(nodes: ArrayLike, triangles: ArrayLike) -> NDArray[np.bool_]:
    """Which boundary triangles lie on a seam, (t,): those that face another at the same place.

    nodes: (n, 3), mm, at rest.
    triangles: (t, 3) uint32. Boundary of a mesh.
    """
    points = as_rows("nodes", nodes, 3)
    corners = as_index_rows("boundary triangles", triangles, 3, len(points), "nodes")
    _, place = np.unique(points, axis=0, return_inverse=True)
    places = np.sort(place.reshape(-1)[corners], axis=1)
    _, which, count = np.unique(places, axis=0, return_inverse=True, return_counts=True)
    return count[which.reshape(-1)] > 1
