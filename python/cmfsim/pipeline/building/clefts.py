"""The clefts between segments of bone, where there is no tissue to stretch: mouth and cut."""

from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray

from cmfsim._core import Surface, TetMesh
from cmfsim.values.anatomy import BoneSegment
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding
from cmfsim.values.node_kinds import NodeKinds
from cmfsim.values.renumbering import used_nodes

__all__ = ["cleft_tets", "without_clefts"]


def without_clefts(
    mesh: TetMesh,
    kinds: NodeKinds,
    segments: Sequence[BoneSegment],
    moved: Collection[str],
    width: float,
) -> tuple[TetMesh, NodeKinds, tuple[Finding, ...]]:
    """The mesh without the tets in the clefts next to moving segments, and a finding about them.

    Parameters
    ----------
    mesh : TetMesh
    kinds : NodeKinds
    segments : sequence of BoneSegment
        Those that the kinds were found with.
    moved : collection of str
        Names of the segments that may move.
    width : float, mm
        As for `cleft_tets`.
    """
    nodes, tets = mesh.nodes, mesh.tets
    inside = cleft_tets(nodes, tets, kinds, segments, moved=moved, width=width)
    if not inside.any():
        return mesh, kinds, ()
    used, kept = used_nodes(tets[~inside])
    left = TetMesh(nodes[used], kept)
    volume = float(mesh.volumes[inside].sum())
    finding = Finding.note(
        "clefts-left-out",
        f"{int(inside.sum())} tets of {volume:.0f} mm³ in total are in the clefts between "
        "segments and were removed: their distances from two segments add up to less than "
        f"{width:g} mm",
        where=f"segments {', '.join(sorted(moved))}",
        why="there is air between the tooth rows, and at a cut the tissue is lifted off the "
        "bone; tets stretched across would be inverted and hold the bones back",
        fix="set cleft in [mesh] to another width, or to 0 to keep all tissue",
    )
    return left, kinds.of_nodes(used), (finding,)


def cleft_tets(
    nodes: Floats,
    tets: NDArray[np.uint32],
    kinds: NodeKinds,
    segments: Sequence[BoneSegment],
    *,
    moved: Collection[str],
    width: float,
) -> NDArray[np.bool_]:
    """Which tets lie between two segments of which one or both move, (m,).

    Those are tets that hold nodes of both, and those whose centroid has both within `width`, taken
    together: a cut in the bone and the slit between the tooth rows look the same.

    Parameters
    ----------
    nodes : (n, 3) float64, mm
    tets : (m, 4) uint32
    kinds : NodeKinds
    segments : sequence of BoneSegment
    moved : collection of str
    width : float, mm
        0: no tet.
    """
    inside = np.zeros(len(tets), dtype=bool)
    if width <= 0.0 or not moved:
        return inside
    moves = np.array([name in moved for name in kinds.segments])
    owner = kinds.segment[tets]
    most = owner.max(axis=1)
    least = np.where(owner < 0, most[:, None], owner).min(axis=1)
    inside |= (most != least) & (moves[most] | moves[least])

    corners = nodes[tets]
    centroids = corners.mean(axis=1)
    # A point is at most so much nearer to anything than the nearest corner of its tet.
    radius = np.linalg.norm(corners - centroids[:, None], axis=2).max(axis=1)
    reach = width + float(radius.max())
    surfaces = [s.surface.searched for s in segments]
    about = [_least_at_corners(nodes, tets, surface, reach) - radius for surface in surfaces]
    names = [segment.name for segment in segments]
    for one in (i for i, name in enumerate(names) if name in moved):
        for other in range(len(surfaces)):
            if other == one or (other < one and names[other] in moved):
                continue
            ids = np.flatnonzero(
                np.maximum(about[one], 0.0) + np.maximum(about[other], 0.0) < width
            )
            both = [_distances(centroids[ids], surfaces[each]) for each in (one, other)]
            inside[ids[both[0] + both[1] < width]] = True
    return inside


def _least_at_corners(
    nodes: Floats, tets: NDArray[np.uint32], surface: Surface, reach: float
) -> Floats:
    """The distance of each tet's nearest corner from a surface; infinity beyond its box."""
    vertices = surface.vertices
    low, high = vertices.min(axis=0) - reach, vertices.max(axis=0) + reach
    near = np.flatnonzero(((nodes >= low) & (nodes <= high)).all(axis=1))
    distance = np.full(len(nodes), np.inf)
    distance[near] = _distances(nodes[near], surface)
    nearest: Floats = distance[tets].min(axis=1)
    return nearest


def _distances(points: Floats, surface: Surface) -> Floats:
    if not len(points):
        return np.zeros(0)
    closest, _, _ = surface.closest(points)
    distances: Floats = np.linalg.norm(closest - points, axis=1)
    return distances
