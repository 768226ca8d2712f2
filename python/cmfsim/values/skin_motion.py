"""How skin moves with the tissue that was simulated: at the tissue's ends, and next to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim._core import Surface, SurfaceMotion
from cmfsim.values.checks import Floats, Frozen, as_rows
from cmfsim.values.surface_data import SurfaceData, used_nodes

# A point up to so many edges from the mesh's skin follows it fully.
FOLLOWS = 2.0
# Beyond, its movement fades over this distance, mm: over so much the skin of cheek and neck
# stretches visibly when a jaw is moved and the neck is not.
FADE = 25.0
# Skin this close to the plane on which the tissue ends is drawn along, mm, and in edges at least:
# that plane holds it, but the patient's tissue goes on behind.
NEAR_END, NEAR_END_EDGES = 4.0, 1.0
# Rounds of averaging over neighbours along the end.
ROUNDS = 100


@dataclass(frozen=True, eq=False)
class SkinEnd(Frozen):
    """The skin next to a plane on which the tissue ends, which moves as the skin before it does.

    The tissue is fixed there because the model ends, not the patient: the row of nodes on the plane
    would stay, and the row before it move by almost as much as the bone below. So nodes of the end
    take the mean of their neighbours, those farther off keep their solution, and the skin behind
    the plane, which has no tets, fades out (`attachment`).

    vertices: (z,) int64, of the skin.
    edges: (e, 2) int64. Pairs of a place in `vertices` and a neighbour among the skin's vertices.
    """

    vertices: NDArray[np.int64]
    edges: NDArray[np.int64]

    def continued(self, field: Floats) -> Floats:
        """The displacements (k, …) of the skin, those of the end replaced: a linear map."""
        if not len(self.vertices):
            return field
        found = np.array(field)
        here, there = self.edges.T
        starts = np.flatnonzero(np.diff(here, prepend=-1))
        shape = (-1, *([1] * (found.ndim - 1)))
        count = np.diff(np.append(starts, len(here))).reshape(shape)
        for _ in range(ROUNDS):
            found[self.vertices] = np.add.reduceat(found[there], starts, axis=0) / count
        return found


def skin_end(skin: SurfaceData, held: ArrayLike) -> SkinEnd:
    """The part of a mesh's skin that ends on planes which hold its vertices `held`, (k,) bool."""
    on_plane = np.asarray(held, dtype=bool)
    triangles = skin.triangles.astype(np.int64)
    rim = triangles[on_plane[triangles].any(axis=1)]
    if not len(rim):
        return SkinEnd(np.zeros(0, dtype=np.int64), np.zeros((0, 2), dtype=np.int64))
    nodes, corners = used_nodes(rim)
    closest, _, _ = Surface(skin.vertices[nodes], corners).closest(skin.vertices)
    reach = max(NEAR_END, NEAR_END_EDGES * mean_edge(skin.vertices[triangles]))
    near = np.linalg.norm(closest - skin.vertices, axis=1) < reach
    pairs = np.concatenate([triangles[:, [k, (k + d) % 3]] for k in range(3) for d in (1, 2)])
    pairs = np.unique(pairs[near[pairs[:, 0]]], axis=0)
    vertices = np.unique(pairs[:, 0])
    number = np.zeros(len(near), dtype=np.int64)
    number[vertices] = np.arange(len(vertices))
    return SkinEnd(vertices, np.column_stack([number[pairs[:, 0]], pairs[:, 1]]))


@dataclass(frozen=True, eq=False)
class Attachment(Frozen):
    """Where k points on or near a mesh's skin are attached to it: triangles and closest points.

    places: (k, 3), mm. The points themselves, those farther away than an edge drawn nearer to the
        skin: rotations of a triangle are followed no farther out.
    share: (k,), of the movement of their places that the points follow: 1 up to two edges from the
        skin, 0 from 25 mm beyond that.
    """

    triangles: NDArray[np.uint32]
    closest: Floats
    places: Floats
    share: Floats


def attachment(skin: Surface, points: ArrayLike) -> Attachment:
    """Where points (k, 3), mm, are attached to a mesh's skin."""
    places = as_rows("points", points, 3)
    closest, _, triangles = skin.closest(places)
    edge = mean_edge(skin.vertices[skin.triangles])
    offset = places - closest
    away = np.linalg.norm(offset, axis=1)
    inwards = np.minimum(1.0, edge / np.maximum(away, edge))
    part = np.clip((away - FOLLOWS * edge) / FADE, 0.0, 1.0)
    # Without a kink where it begins and ends.
    share = 1.0 - part * part * (3.0 - 2.0 * part)
    return Attachment(triangles, closest, closest + inwards[:, None] * offset, share)


def carried_points(before: SurfaceData, displacements: Floats, points: ArrayLike) -> Floats:
    """How points (k, 3), mm, on or near a mesh's skin move, as its closest point: (k, 3) mm.

    What lies away from the tissue that was simulated, as the back of the head, stays: from two
    edges off its movement fades, over 25 mm. `displacements`: (v, 3), mm, of the skin's vertices.
    """
    skin = before.searched
    found = attachment(skin, points)
    motion = SurfaceMotion(skin, before.vertices + displacements)
    carried: Floats = found.share[:, None] * motion.displacement(found.places)
    return carried


def mean_edge(corners: Floats) -> float:
    """The mean edge of triangles given by their corners, (t, 3, 3), mm."""
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean())
