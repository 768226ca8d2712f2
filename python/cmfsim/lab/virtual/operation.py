"""The operation on the true tissue: nodes attached to bone, stripped off it, and pushed by it."""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim._core import Surface, signed_distance_image
from cmfsim.errors import third_party
from cmfsim.lab.virtual.mechanics.equilibrium import penalty
from cmfsim.values.anatomy import BoneSegment
from cmfsim.values.checks import Floats
from cmfsim.values.image_data import ImageData
from cmfsim.values.motion import carried, decompose_motion, rigid_motion
from cmfsim.values.scene import NodeKinds

# Pressure per depth of penetration, MPa/mm: under the pressures of soft tissue (a few kPa), nodes
# penetrate by less than a tenth of a mm.
STIFFNESS = 0.1
# Depth over which the stiffness grows, mm: nodes that lie on bone would otherwise be at a kink.
ONSET = 0.1
# Standard deviation of the blur that rounds gaps between teeth, mm: half an edge of the mesh.
RELIEF = 1.0
# Step of the central differences, mm: the splines are smooth over a voxel.
DIFFERENCE = 1e-2


class SmoothDistance:
    """The distance outside a bone, negative inside, twice continuously differentiable near it.

    The level is positive inside, and about a distance near the surface.
    """

    def __init__(self, level: ImageData) -> None:
        ndimage = third_party("scipy.ndimage", "contact of virtual patients is found", "study")
        spacing = level.spacing
        values = level.values.astype(np.float64)
        blurred = ndimage.gaussian_filter(values, RELIEF / spacing)
        self._spline = ndimage.spline_filter(-blurred, order=3, mode="mirror")
        self._origin, self._spacing = level.lowest, spacing
        self._sample = ndimage.map_coordinates

    def __call__(self, points: Floats) -> Floats:
        """The distances of points (k, 3), mm."""
        place = ((points - self._origin) / self._spacing).T
        found: Floats = self._sample(self._spline, place, order=3, mode="mirror", prefilter=False)
        return found

    def slope(self, points: Floats) -> Floats:
        """The gradients at points, (k, 3)."""
        steps = DIFFERENCE * np.eye(3)
        rises = [(self(points + step) - self(points - step)) / (2.0 * DIFFERENCE) for step in steps]
        return np.column_stack(rises)

    def curvature(self, points: Floats) -> Floats:
        """The second derivatives at points, (k, 3, 3), symmetric."""
        steps = DIFFERENCE * np.eye(3)
        rises = [(self.slope(points + step) - self.slope(points - step)) / 2.0 for step in steps]
        found = np.stack(rises, axis=2) / DIFFERENCE
        return 0.5 * (found + found.transpose(0, 2, 1))


@dataclass(frozen=True, eq=False)
class BoneContact:
    """Nodes that moving bones push, without friction and without pull.

    A node that starts inside the blurred bone may stay at that depth.

    points, nodes: (n, 3), mm, all at rest, and (k,), those that may touch bone.
    area: (k,), mm². Boundary area around each.
    motion: The rigid motion (4, 4) of each bone after a fraction of it, 0 to 1.
    """

    points: Floats
    nodes: NDArray[Any]
    area: Floats
    bones: Mapping[str, SmoothDistance]
    motion: Mapping[str, Callable[[float], Floats]]

    def __post_init__(self) -> None:
        rest = {name: np.minimum(b(self.points[self.nodes]), 0.0) for name, b in self.bones.items()}
        object.__setattr__(self, "_rest", rest)

    def depths(self, displacements: Floats, part: float) -> dict[str, Floats]:
        """Depth of each touching node in each bone, (k,) mm; 0 outside."""
        rest: Mapping[str, Floats] = self.__dict__["_rest"]
        return {
            name: np.maximum(rest[name] - bone(self._seen(name, displacements, part)), 0.0)
            for name, bone in self.bones.items()
        }

    def _seen(self, name: str, displacements: Floats, part: float) -> Floats:
        """The moved nodes in the frame of a bone after a fraction of its motion."""
        matrix = self.motion[name](part)
        moved = (self.points + displacements)[self.nodes]
        back: Floats = (moved - matrix[:3, 3]) @ matrix[:3, :3]
        return back

    def energy(self, displacements: Floats, part: float) -> float:
        """∫ ∫ pressure d(depth) d(area), N·mm."""
        depths = self.depths(displacements, part).values()
        return STIFFNESS * sum(float(self.area @ penalty(d, ONSET)[0]) for d in depths)

    def forces(self, displacements: Floats, part: float) -> tuple[Floats, Floats]:
        """The gradient of the energy, (n, 3) N, and the stiffness of each node, (n, 3, 3) N/mm.

        Of the bone's curvature, only that of hollows counts, which stiffens, not that of edges.
        """
        force = np.zeros_like(self.points)
        blocks = np.zeros((len(self.points), 3, 3))
        for name, depth in self.depths(displacements, part).items():
            touching = np.flatnonzero(depth > 0.0)
            if not len(touching):
                continue
            seen = self._seen(name, displacements, part)[touching]
            turn = self.motion[name](part)[:3, :3]
            normal = self.bones[name].slope(seen) @ turn.T
            bend = turn @ self.bones[name].curvature(seen) @ turn.T
            weight, at = STIFFNESS * self.area[touching], self.nodes[touching]
            _, pressing, rise = penalty(depth[touching], ONSET)
            force[at] -= (weight * pressing)[:, None] * normal
            blocks[at] += (weight * rise)[:, None, None] * normal[:, :, None] * normal[:, None, :]
            values, axes = np.linalg.eigh(-(weight * pressing)[:, None, None] * bend)
            blocks[at] += (axes * np.maximum(values, 0.0)[:, None]) @ axes.transpose(0, 2, 1)
        return force, blocks

    def coupling(self, displacements: Floats, part: float) -> None:
        """None: nodes touch only bones, not each other."""
        del displacements, part


# Tissue is stripped off both sides of a cut, as a surgeon lifts the periosteum there: over this
# length, mm, plus this multiple of the distance by which the two sides separate.
STRIPPED, STRIPPED_PER_SHIFT = 5.0, 1.5
# Shifts below this count as zero, mm.
LEAST_SHIFT = 1e-6
# There is no tissue between bones that move relative to each other, within their shift plus this,
# mm; cosine of the angle between the directions to them above which they count as one wall.
BETWEEN, SAME_SIDE = 2.0, 0.5
# Smallest ratio of volumes of a tet with all four nodes attached to bone.
LEAST_HELD_RATIO = 0.3
# Distances to bone are known within this reach, on a grid of this spacing with this margin around
# the tissue, mm: more than bones move in a step, and more than the width of a gap.
REACH, SPACING, ROOM = 12.0, 1.5, 8.0


@dataclass(frozen=True, eq=False)
class Operation:
    """The action of the bones on the tissue.

    held, points: (k,) and (k, 3), mm. Nodes attached to bone, or fixed where tissue ends, at rest.
    owner: (k,). Segment to which each is joined, as an index into `motion`; −1 if it does not move.
    motion: Rigid motion (4, 4) of each segment after a fraction of it, 0 to 1.
    stripped: Number of nodes that the operation detached from bone.
    """

    held: NDArray[np.int64]
    owner: NDArray[np.int64]
    motion: Mapping[str, Callable[[float], Floats]]
    contact: BoneContact
    stripped: int
    points: Floats

    def path(self, part: float) -> Floats:
        """Displacements of the held nodes after a fraction of the motion, (k, 3) mm."""
        moved = np.zeros_like(self.points)
        for number, motion in enumerate(self.motion.values()):
            mine = self.owner == number
            moved[mine] = carried(motion(part), self.points[mine]) - self.points[mine]
        return moved


def screw(matrix: Floats, centre: Floats) -> Callable[[float], Floats]:
    """The rigid motion (4, 4) after a fraction of it: turn about the centre and shift together."""
    whole = decompose_motion(matrix, centre)

    def after(part: float) -> Floats:
        if part == 1.0:
            return matrix
        return rigid_motion(part * whole.translation, part * whole.angle, whole.axis, centre)

    return after


def bone_distances(nodes: Floats, segments: Mapping[str, BoneSegment]) -> dict[str, ImageData]:
    """Depth inside each segment, negative outside, mm, in the box of the nodes (n, 3) plus `ROOM`.

    A segment's level is a distance only within two voxels of its surface, this one up to `REACH`.
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
    """Which tets (m, 4) are tissue, (m,): those outside the gap between the tooth rows.

    upper, lower: Depths inside the bones that bear the teeth.
    gap: mm. The distances of a tet's centroid to both add up to less than this between them.
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
    """Which tets are tissue, (m,): those not in the gap of two bones that move apart or together.

    A surgeon opens these gaps, strips the tissue in them and removes bone where segments meet. A
    tet lies between two bones if the distances of its centroid to both add up to less than their
    shift plus `BETWEEN`, and the bones are not on the same side of it.

    distances, motions: As returned by `bone_distances`, and (4, 4) mm of each of them.
    kept_between: Jaws that no cut separates, if the mouth is open: tissue between them is kept.
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
    """Unit vectors towards a bone, (k, 3)."""
    steps = np.diag(depth.spacing)
    slope = np.column_stack([depth.sample(points + s) - depth.sample(points - s) for s in steps])
    length = np.linalg.norm(slope, axis=1, keepdims=True)
    normals: Floats = slope / np.maximum(length, np.finfo(np.float64).tiny)
    return normals


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
    """The operation that carries out a plan on tissue with classified nodes.

    Joined and fixed nodes near a cut whose sides separate are stripped off the bone. Like sliding
    nodes, they are then free, and bone can only push them.

    boundary: (t, 3). Boundary triangles of the tets (m, 4).
    distances, centres, plan: By segment: depth inside, centre of its turn (3,), motion (4, 4).
    bared: Other free nodes that may touch bone, because the tissue next to them was opened.
    """
    names = list(distances)
    motion = {name: screw(plan[name], centres[name]) for name in names}
    kind = kinds.kind
    owner = np.full(len(nodes), -1, dtype=np.int64)
    joined = kinds.nodes("joined")
    of_kinds = np.array([names.index(name) for name in kinds.segments])
    owner[joined] = of_kinds[kinds.segment[joined]]
    held = np.isin(kind, (1, 2))
    targets = np.zeros_like(nodes)
    for number, name in enumerate(names):
        mine = owner == number
        targets[mine] = carried(plan[name], nodes[mine]) - nodes[mine]
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
    """Which held nodes are stripped, being close to held nodes that move differently."""
    spatial = third_party("scipy.spatial", "virtual patients are made", "study")
    ids = np.flatnonzero(held)
    tree = spatial.cKDTree(nodes[ids])
    # Twice the largest motion bounds the shift between any two nodes.
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
        # Within a rigid segment, rotation shifts neighbours by its angle times their distance.
        torn = (shift > 0.5 * apart) & (apart < STRIPPED + STRIPPED_PER_SHIFT * shift)
        if torn.any():
            found[ids[one]] = True
            found[ids[near[torn]]] = True
    return found


def _crushed(
    nodes: Floats, tets: NDArray[Any], held: NDArray[np.bool_], targets: Floats
) -> NDArray[np.bool_]:
    """Which nodes belong to tets that are attached to bone at every node and would be inverted."""
    found = np.zeros(len(nodes), dtype=bool)
    whole = tets[held[tets].all(axis=1)]
    if len(whole):
        before, after = _volumes(nodes, whole), _volumes(nodes + targets, whole)
        found[whole[after < LEAST_HELD_RATIO * before]] = True
    return found


def _volumes(nodes: Floats, tets: NDArray[Any]) -> Floats:
    edges = nodes[tets[:, 1:]] - nodes[tets[:, :1]]
    triple = np.einsum("ti,ti->t", np.cross(edges[:, 0], edges[:, 1]), edges[:, 2])
    volumes: Floats = triple / 6.0
    return volumes


def node_areas(nodes: Floats, triangles: NDArray[Any]) -> Floats:
    """A third of the area of the boundary triangles around each node, mm²."""
    corners = nodes[triangles]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1) / 6.0
    ends = triangles.T.ravel()
    return np.bincount(ends, np.tile(area, 3), len(nodes)).astype(np.float64)
