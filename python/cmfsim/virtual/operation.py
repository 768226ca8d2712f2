"""The operation on the true tissue: what bones hold, what is stripped off them, what they push."""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim._core import Surface, signed_distance_image
from cmfsim.checks import Floats
from cmfsim.errors import CaseInputError
from cmfsim.extras import third_party
from cmfsim.values.anatomy import BoneSegment
from cmfsim.values.image_data import ImageData
from cmfsim.values.motion import decompose_motion, rigid_motion
from cmfsim.values.node_kinds import NodeKinds
from cmfsim.virtual.bone_contact import BoneContact, SmoothDistance

__all__ = [
    "Operation",
    "bone_distances",
    "node_areas",
    "operate",
    "screw",
    "without_bite",
    "without_gaps",
]

# Tissue is stripped off both sides of a cut as a surgeon lifts the periosteum there: by this
# length, mm, and by this multiple of how far the two sides part.
STRIPPED, STRIPPED_PER_SHIFT = 5.0, 1.5
# Shifts below this are none, mm.
LEAST_SHIFT = 1e-6
# Between bones that move against each other is no tissue within their shift and this, mm; cosine of
# the angle between the ways to them from which on they count as one wall.
BETWEEN, SAME_SIDE = 2.0, 0.5
# A tet that bones hold at all four nodes may not change its volume to less than this part.
LEAST_HELD_RATIO = 0.3
# Up to this far from a bone its distance is known, on a grid of this spacing with this much room
# about the tissue, mm: more than bones move in a step, or a gap is wide.
REACH, SPACING, ROOM = 12.0, 1.5, 8.0


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
            return matrix
        return rigid_motion(part * whole.translation, part * whole.angle, whole.axis, centre)

    return after


def bone_distances(nodes: Floats, segments: Mapping[str, BoneSegment]) -> dict[str, ImageData]:
    """The depth in each segment, negative outside, mm, in the box of nodes and some room about it.

    Unlike a segment's level, which knows two voxels about its surface, it is a distance up to
    `REACH`.

    Parameters
    ----------
    nodes : (n, 3) float64, mm
    segments : mapping of str to BoneSegment
    """
    lowest = nodes.min(axis=0) - ROOM
    shape = np.ceil((np.ptp(nodes, axis=0) + 2.0 * ROOM) / SPACING).astype(int) + 1
    spacing = (SPACING, SPACING, SPACING)
    found = {}
    for name, segment in segments.items():
        surface = Surface(segment.surface.vertices, segment.surface.triangles)
        x, y, z = lowest.tolist()
        depth = signed_distance_image(
            surface, tuple(shape.tolist()), spacing, (x, y, z), band=REACH
        )
        found[name] = ImageData(depth, spacing, lowest)
    return found


def without_bite(
    nodes: Floats, tets: NDArray[Any], upper: ImageData, lower: ImageData, gap: float
) -> NDArray[np.bool_]:
    """Which tets are tissue, (m,): not in the slit between the tooth rows, where there is none.

    Parameters
    ----------
    nodes, tets : (n, 3) mm, (m, 4)
    upper, lower : ImageData
        Depths in the bones that bear the teeth.
    gap : float, mm
        A tet whose middle has both within this, taken together, lies between them.
    """
    middles = nodes[tets].mean(axis=1)
    return -upper.sample(middles) - lower.sample(middles) >= gap


def without_gaps(
    nodes: Floats,
    tets: NDArray[Any],
    distances: Mapping[str, ImageData],
    motions: Mapping[str, Floats],
    kept_between: Collection[str] = (),
) -> NDArray[np.bool_]:
    """Which tets are tissue, (m,): not between bones that part or close, where none is left.

    A surgeon opens these gaps, strips what is in them and takes bone away where segments meet. A
    tet lies between two bones if its middle has both within their shift and `BETWEEN`, taken
    together, and does not see both on the same side.

    Parameters
    ----------
    nodes, tets : (n, 3) mm, (m, 4)
    distances : mapping of str to ImageData
        As `bone_distances` gives them.
    motions : mapping of str to (4, 4) float64, mm
        Of each of them.
    kept_between : collection of str
        Bones between which tissue stays: jaws that no cut separates, and whose mouth is open.
    """
    middles = nodes[tets].mean(axis=1)
    kept = np.ones(len(middles), dtype=bool)
    outside = {name: -depth.sample(middles) for name, depth in distances.items()}
    for one, other in combinations(distances, 2):
        if one in kept_between and other in kept_between:
            continue
        apart = motions[one] - motions[other]
        shift = np.linalg.norm(middles @ apart[:3, :3].T + apart[:3, 3], axis=1)
        near = outside[one] + outside[other] < shift + BETWEEN
        ids = np.flatnonzero(near & (shift > LEAST_SHIFT))
        facing = [_towards(distances[name], middles[ids]) for name in (one, other)]
        kept[ids[(facing[0] * facing[1]).sum(axis=1) < SAME_SIDE]] = False
    return kept


def _towards(depth: ImageData, points: Floats) -> Floats:
    """Unit vectors to a bone, (k, 3)."""
    steps = np.diag(depth.spacing)
    slope = np.column_stack([depth.sample(points + s) - depth.sample(points - s) for s in steps])
    length = np.linalg.norm(slope, axis=1, keepdims=True)
    return np.asarray(slope / np.maximum(length, np.finfo(np.float64).tiny))


def operate(
    nodes: Floats,
    tets: NDArray[Any],
    boundary: NDArray[Any],
    kinds: NodeKinds,
    *,
    distances: Mapping[str, ImageData],
    centres: Mapping[str, Floats],
    plan: Mapping[str, Floats],
    bared: NDArray[Any] | None = None,
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
    distances : mapping of str to ImageData
        The depth in each segment.
    centres : mapping of str to (3,) float64, mm
        About which each turns on its way.
    plan : mapping of str to (4, 4) float64, mm
        Segments that it does not name stay.
    bared : (k,) whole numbers, optional
        Free nodes that may touch bone as well: of tissue that was opened.

    Raises
    ------
    CaseError
        (also `ValueError`) The plan moves what is no segment; scipy is not installed.
    """
    for name in plan:
        if name not in distances:
            raise CaseInputError(f"the plan moves {name!r}; segments are: {', '.join(distances)}")
    names = list(distances)
    matrices = [np.asarray(plan.get(name, np.eye(4)), dtype=np.float64) for name in names]
    motion = {
        name: screw(matrix, centres[name]) for name, matrix in zip(names, matrices, strict=True)
    }
    kind = kinds.kind
    owner = np.full(len(nodes), -1, dtype=np.int64)
    joined = kinds.nodes("joined")
    of_kinds = np.array([names.index(name) for name in kinds.segments])
    owner[joined] = of_kinds[kinds.segment[joined]]
    held = np.isin(kind, (1, 2))
    targets = np.zeros_like(nodes)
    for number, matrix in enumerate(matrices):
        mine = owner == number
        targets[mine] = nodes[mine] @ matrix[:3, :3].T + matrix[:3, 3] - nodes[mine]
    loose = _near_cuts(nodes, held, targets) | _crushed(nodes, tets, held, targets)
    held &= ~loose
    opened = np.zeros(len(nodes), dtype=bool)
    opened[bared if bared is not None else []] = True
    touching = np.flatnonzero(loose | (kind == 3) | (opened & ~held))
    contact = BoneContact(
        nodes,
        touching,
        node_areas(nodes, boundary)[touching],
        {name: SmoothDistance(depth) for name, depth in distances.items()},
        motion,
    )
    ids = np.flatnonzero(held)
    return Operation(ids, owner[ids], motion, contact, int(loose.sum()), nodes[ids])


def _near_cuts(nodes: Floats, held: NDArray[np.bool_], targets: Floats) -> NDArray[np.bool_]:
    """Which held nodes lie so near to held nodes of another motion that tissue is stripped."""
    spatial = third_party("scipy.spatial", "virtual patients are made", "study")
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


def node_areas(nodes: Floats, triangles: NDArray[Any]) -> Floats:
    """A third of the area of the boundary triangles about each node, mm²."""
    corners = nodes[triangles]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1) / 6.0
    ends = triangles.T.ravel()
    return np.bincount(ends, np.tile(area, 3), len(nodes)).astype(np.float64)
