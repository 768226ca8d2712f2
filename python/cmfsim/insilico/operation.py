"""The operation on the true tissue: what bones hold, what is stripped off them, what they push."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.case import BoneSegment, ImageData, NodeKinds
from cmfsim.checks import Floats
from cmfsim.errors import CaseInputError
from cmfsim.insilico.bone_contact import BoneContact, SmoothDistance
from cmfsim.planning import decompose_motion, rigid_motion

__all__ = ["Operation", "operate", "screw", "without_bite"]

# Tissue is stripped off both sides of a cut as a surgeon lifts the periosteum there: by this
# length, mm, and by this multiple of how far the two sides part.
STRIPPED, STRIPPED_PER_SHIFT = 5.0, 1.5
# Shifts below this are none, mm.
LEAST_SHIFT = 1e-6
# A tet that bones hold at all four nodes may not change its volume to less than this part.
LEAST_HELD_RATIO = 0.3
# Room about the nodes that may touch bone, in which its distance is known, mm.
ROOM = 16.0


@dataclass(frozen=True, eq=False)
class Operation:
    """What the bones do to the tissue.

    Attributes
    ----------
    held : (k,) int64
        Nodes that bones, or the planes that end the tissue, hold.
    owner : (k,) int64
        The segment that each is joined to, as an index into `motion`; −1: it stays.
    motion : mapping of str to callable
        The rigid motion (4, 4) of each segment after a part of its way, 0 to 1.
    contact : BoneContact
    stripped : int
        Nodes that the operation freed from bone.
    points : (k, 3) float64, mm
        The held nodes at rest.
    """

    held: NDArray[np.int64]
    owner: NDArray[np.int64]
    motion: Mapping[str, Callable[[float], Floats]]
    contact: BoneContact
    stripped: int
    points: Floats

    def path(self, part: float) -> Floats:
        """The displacements of the held nodes after a part of the motion, (k, 3) mm."""
        moved = np.zeros_like(self.points)
        for number, motion in enumerate(self.motion.values()):
            mine = self.owner == number
            matrix = motion(part)
            points = self.points[mine]
            moved[mine] = points @ matrix[:3, :3].T + matrix[:3, 3] - points
        return moved


def screw(matrix: Floats, centre: Floats) -> Callable[[float], Floats]:
    """The rigid motion (4, 4) after a part of it: the turn about a centre grows with the shift.

    Parameters
    ----------
    matrix : (4, 4) float64, mm
        The whole motion.
    centre : (3,) float64, mm
    """
    whole = decompose_motion(matrix, centre)

    def after(part: float) -> Floats:
        if part == 1.0:
            return np.asarray(matrix, dtype=np.float64)
        return rigid_motion(part * whole.translation, part * whole.angle, whole.axis, centre)

    return after


def without_bite(
    nodes: Floats, tets: NDArray[Any], upper: ImageData, lower: ImageData, gap: float
) -> NDArray[np.bool_]:
    """Which tets are tissue, (m,): not in the slit between the tooth rows, where there is none.

    Parameters
    ----------
    nodes, tets : (n, 3) mm, (m, 4)
    upper, lower : ImageData
        Levels of the bones that bear the teeth.
    gap : float, mm
        A tet whose middle has both within this, taken together, lies between them.
    """
    middles = nodes[tets].mean(axis=1)
    return np.asarray(-upper.sample(middles) - lower.sample(middles) >= gap)


def operate(
    nodes: Floats,
    tets: NDArray[Any],
    boundary: NDArray[Any],
    kinds: NodeKinds,
    segments: Mapping[str, BoneSegment],
    plan: Mapping[str, Floats],
) -> Operation:
    """The operation of a plan on tissue whose nodes have their kinds.

    Joined and fixed nodes near a cut whose sides part are stripped off the bone: like sliding
    nodes, they are then free of it and only pushed by it.

    Parameters
    ----------
    nodes : (n, 3) float64, mm
    tets : (m, 4) uint32
    boundary : (t, 3) uint32
        Boundary triangles.
    kinds : NodeKinds
    segments : mapping of str to BoneSegment
    plan : mapping of str to (4, 4) float64, mm
        Segments that it does not name stay.

    Raises
    ------
    CaseError
        (also `ValueError`) The plan moves what is no segment; scipy is not installed.
    """
    for name in plan:
        if name not in segments:
            raise CaseInputError(f"the plan moves {name!r}; segments are: {', '.join(segments)}")
    names = list(segments)
    matrices = [np.asarray(plan.get(name, np.eye(4)), dtype=np.float64) for name in names]
    motion = {
        name: screw(matrix, np.asarray(segments[name].surface.vertices).mean(axis=0))
        for name, matrix in zip(names, matrices, strict=True)
    }
    kind = np.asarray(kinds.kind)
    owner = np.full(len(nodes), -1, dtype=np.int64)
    joined = kinds.nodes("joined")
    of_kinds = np.array([names.index(name) for name in kinds.segments])
    owner[joined] = of_kinds[np.asarray(kinds.segment)[joined]]
    held = np.isin(kind, (1, 2))
    targets = np.zeros_like(nodes)
    for number, matrix in enumerate(matrices):
        mine = owner == number
        targets[mine] = nodes[mine] @ matrix[:3, :3].T + matrix[:3, 3] - nodes[mine]
    loose = _near_cuts(nodes, held, targets) | _crushed(nodes, tets, held, targets)
    held &= ~loose
    touching = np.flatnonzero(loose | (kind == 3))
    contact = BoneContact(
        nodes,
        touching,
        _node_areas(nodes, boundary)[touching],
        _distances(nodes[touching], segments),
        motion,
    )
    ids = np.flatnonzero(held)
    return Operation(ids, owner[ids], motion, contact, int(loose.sum()), nodes[ids])


def _near_cuts(nodes: Floats, held: NDArray[np.bool_], targets: Floats) -> NDArray[np.bool_]:
    """Which held nodes lie so near to held nodes of another motion that tissue is stripped."""
    spatial = _module("scipy.spatial")
    ids = np.flatnonzero(held)
    tree = spatial.cKDTree(nodes[ids])
    # Largest shift between any two parts bounds the search.
    most = float(np.linalg.norm(targets[ids], axis=1).max(initial=0.0))
    reach = STRIPPED + STRIPPED_PER_SHIFT * 2.0 * most
    found = np.zeros(len(nodes), dtype=bool)
    if most <= LEAST_SHIFT:
        return found
    moving = np.flatnonzero(np.linalg.norm(targets[ids], axis=1) > LEAST_SHIFT)
    for one in moving:
        near = np.array(tree.query_ball_point(nodes[ids[one]], reach))
        shift = np.linalg.norm(targets[ids[near]] - targets[ids[one]], axis=1)
        apart = np.linalg.norm(nodes[ids[near]] - nodes[ids[one]], axis=1)
        # Within one rigid segment a turn shifts neighbours by its angle times their distance.
        torn = (shift > 0.5 * apart) & (apart < STRIPPED + STRIPPED_PER_SHIFT * shift)
        if torn.any():
            found[ids[one]] = True
            found[ids[near[torn]]] = True
    return found


def _crushed(
    nodes: Floats, tets: NDArray[Any], held: NDArray[np.bool_], targets: Floats
) -> NDArray[np.bool_]:
    """Which nodes belong to tets that bones hold at every node and would turn inside out."""
    found = np.zeros(len(nodes), dtype=bool)
    whole = tets[held[tets].all(axis=1)]
    if len(whole):
        before, after = _volumes(nodes, whole), _volumes(nodes + targets, whole)
        found[whole[after < LEAST_HELD_RATIO * before]] = True
    return found


def _volumes(nodes: Floats, tets: NDArray[Any]) -> Floats:
    edges = nodes[tets[:, 1:]] - nodes[tets[:, :1]]
    triple = np.einsum("ti,ti->t", np.cross(edges[:, 0], edges[:, 1]), edges[:, 2])
    return np.asarray(triple / 6.0)


def _node_areas(nodes: Floats, triangles: NDArray[Any]) -> Floats:
    """A third of the area of the boundary triangles about each node, mm²."""
    corners = nodes[triangles]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1) / 6.0
    ends = triangles.T.ravel()
    return np.bincount(ends, np.tile(area, 3), len(nodes)).astype(np.float64)


def _distances(points: Floats, segments: Mapping[str, BoneSegment]) -> dict[str, SmoothDistance]:
    """The distances of the segments in the box of the points, and some room about it."""
    if not len(points):
        return {}
    found = {}
    for name, segment in segments.items():
        level = segment.level
        spacing = np.asarray(level.spacing)
        low = np.floor((points.min(axis=0) - ROOM - level.lowest) / spacing).astype(int)
        high = np.ceil((points.max(axis=0) + ROOM - level.lowest) / spacing).astype(int) + 1
        low, high = np.maximum(low, 0), np.minimum(high, level.values.shape)
        values = np.asarray(level.values)[
            tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        ]
        if values.size and (values > 0.0).any():
            found[name] = SmoothDistance(ImageData(values, spacing, level.lowest + low * spacing))
    return found


def _module(name: str) -> Any:
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        raise CaseInputError(
            "virtual patients are made with scipy: pip install 'cmfsim[study]'"
        ) from error
