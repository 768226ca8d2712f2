"""The surfaces on which tissue slides in a case, and tissue left out in clefts between bones."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim._core import Surface, SurfaceMotion, TetMesh
from cmfsim.bones.contact_sheets import ContactSheet, SheetOptions, contact_sheet, sheet_departure
from cmfsim.meshing.node_kinds.arches import DentalArches
from cmfsim.meshing.node_kinds.options import KindOptions
from cmfsim.surfaces.depth import distances
from cmfsim.surfaces.levels import contact_surface
from cmfsim.values.anatomy import Anatomy, BoneSegment
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding
from cmfsim.values.image_data import ImageData
from cmfsim.values.motion import carried
from cmfsim.values.scene import NodeKinds
from cmfsim.values.surface_data import MovedSurface, SurfaceData, used_nodes

# Distances from two segments, taken together and relative to the width of a cleft, up to which
# tissue cannot move out of their way.
CONFINED = 3.0
# Share of its volume below which a tet between two segments counts as crushed.
CRUSHED = 0.1
# Distance from a segment, mm, below which a node moves with it alone.
ON_BONE = 1e-3
# Least radius of curvature of a sheet, as a part of the tissue's edge length: what tets can follow.
RADIUS_IN_EDGES = 0.5


def without_clefts(
    mesh: TetMesh,
    kinds: NodeKinds,
    segments: Sequence[BoneSegment],
    moved: Collection[str],
    width: float,
) -> tuple[TetMesh, NodeKinds, tuple[Finding, ...]]:
    """The mesh without the tets in the clefts next to moving segments, and a finding about them.

    moved, width: As for `cleft_tets`.
    """
    nodes, tets = mesh.nodes, mesh.tets
    inside = cleft_tets(nodes, tets, kinds, segments, moved=moved, width=width)
    if not inside.any():
        return mesh, kinds, ()
    volume = float(mesh.volumes[inside].sum())
    finding = Finding(
        "clefts-left-out",
        f"{int(inside.sum())} tets of {volume:.0f} mm³ in total are in the clefts between "
        "segments and were removed: their distances from two segments add up to less than "
        f"{width:g} mm",
        where=f"segments {', '.join(sorted(moved))}",
    )
    return *without_tets(mesh, kinds, inside), (finding,)


def without_crushed(
    mesh: TetMesh,
    kinds: NodeKinds,
    segments: Sequence[BoneSegment],
    motions: Mapping[str, Floats | MovedSurface],
    width: float,
) -> tuple[TetMesh, NodeKinds, tuple[Finding, ...]]:
    """The mesh without the tets that the plan crushes between segments, and a finding about them.

    Linear tissue turns inside out there at no harm to the rest; in large deformation no position of
    the nodes between two bones that meet leaves these tets a volume. Arguments: `crushed_tets`.
    """
    crushed = crushed_tets(mesh.nodes, mesh.tets, kinds, segments, motions=motions, width=width)
    if not crushed.any():
        return mesh, kinds, ()
    corners = mesh.nodes[mesh.tets[crushed]].reshape(-1, 3)
    low, high = (", ".join(f"{x:.0f}" for x in end) for end in (corners.min(0), corners.max(0)))
    finding = Finding(
        "crushed-left-out",
        f"{int(crushed.sum())} tets of {float(mesh.volumes[crushed].sum()):.0f} mm³ in total would "
        f"keep less than {CRUSHED:.0%} of their volume between segments that move towards each "
        "other, and were removed",
        where=f"between ({low}) and ({high}) mm",
    )
    return *without_tets(mesh, kinds, crushed), (finding,)


def without_tets(
    mesh: TetMesh, kinds: NodeKinds, removed: NDArray[np.bool_]
) -> tuple[TetMesh, NodeKinds]:
    """A mesh without some tets (m,), and the kinds of the nodes that are left."""
    used, tets = used_nodes(mesh.tets[~removed])
    return TetMesh(mesh.nodes[used], tets), kinds.of_nodes(used)


def crushed_tets(
    nodes: Floats,
    tets: NDArray[np.uint32],
    kinds: NodeKinds,
    segments: Sequence[BoneSegment],
    *,
    motions: Mapping[str, Floats | MovedSurface],
    width: float,
) -> NDArray[np.bool_]:
    """Which tets a plan crushes between two segments, (m,).

    Nodes on a segment move with it. Those between segments follow all of them with weights 1/d² of
    the distance d (Shepard 1968). A tet is crushed if this leaves it less than a tenth of its
    volume. Only tets are judged of which every node has two segments within three times `width`,
    mm, of a cleft, taken together: other tissue moves out of the way.
    """
    crushed = np.zeros(len(tets), dtype=bool)
    if width <= 0.0 or not motions:
        return crushed
    reach = CONFINED * width
    distance = np.full((len(segments), len(nodes)), np.inf)
    for own, segment in zip(distance, segments, strict=True):
        surface = segment.surface.searched
        near = _in_box(nodes, surface, reach)
        own[near] = distances(nodes[near], surface)
        if segment.name in kinds.segments:
            own[kinds.segment == kinds.segments.index(segment.name)] = 0.0
    if len(segments) < 2:
        return crushed
    confined = np.partition(distance, 1, axis=0)[:2].sum(axis=0) < reach
    ids = np.flatnonzero(confined[tets].all(axis=1))
    used, cells = used_nodes(tets[ids])
    moved = nodes[used] + _blended(nodes[used], distance[:, used], segments, motions)

    def volumes(places: Floats) -> Floats:
        corners = places[cells]
        found: Floats = np.linalg.det(corners[:, 1:] - corners[:, :1])
        return found

    crushed[ids] = volumes(moved) < CRUSHED * volumes(nodes[used])
    return crushed


def _blended(
    nodes: Floats,
    distance: Floats,
    segments: Sequence[BoneSegment],
    motions: Mapping[str, Floats | MovedSurface],
) -> Floats:
    """The displacement of nodes by the segments around them, (n, 3)."""
    # On a segment its weight outdoes all others.
    weights = 1.0 / np.maximum(distance, ON_BONE) ** 2
    total = np.zeros_like(nodes)
    for own, segment in zip(weights, segments, strict=True):
        motion = motions.get(segment.name)
        if motion is None:
            continue
        if isinstance(motion, MovedSurface):
            field = SurfaceMotion(motion.surface.searched, motion.moved_vertices)
            total += own[:, None] * field.displacement(nodes)
        else:
            total += own[:, None] * (carried(motion, nodes) - nodes)
    blended: Floats = total / weights.sum(axis=0)[:, None]
    return blended


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

    Those are tets that hold nodes of both, and those whose centroid has both within `width`, mm,
    taken together: a cut in the bone and the slit between the tooth rows look the same.
    """
    inside = np.zeros(len(tets), dtype=bool)
    if width <= 0.0 or not moved:
        return inside
    moves = np.array([name in moved for name in kinds.segments])
    owner = kinds.segment[tets]
    most = owner.max(axis=1)
    least = np.where(owner < 0, most[:, None], owner).min(axis=1)
    inside |= (most != least) & (moves[most] | moves[least])

    # Coordinate by coordinate, (3, 4, m): sums over three or four neighbours in memory are slow.
    corners = nodes.T[:, tets.T]
    middles = corners.mean(axis=1)
    # A point is at most so much nearer to anything than the nearest corner of its tet.
    radius = np.sqrt(((corners - middles[:, None]) ** 2).sum(axis=0).max(axis=0))
    centroids = middles.T
    reach = width + float(radius.max())
    surfaces = [s.surface.searched for s in segments]
    is_moved = np.array([segment.name in moved for segment in segments])
    away = np.full((len(surfaces), len(nodes)), np.inf)
    boxes = np.array([_in_box(nodes, surface, reach) for surface in surfaces])
    # All corners of a tet between two segments are within reach of both, of which one moves.
    close = np.zeros(len(nodes), dtype=bool)
    for one in np.argsort(~is_moved, kind="stable").tolist():
        near = boxes[one] & (np.delete(boxes, one, axis=0).any(axis=0) if is_moved[one] else close)
        away[one, near] = distances(nodes[near], surfaces[one])
        if is_moved[one]:
            close |= away[one] < reach
    some = np.flatnonzero(close[tets].all(axis=1))
    about = np.maximum(away[:, tets[some]].min(axis=2) - radius[some], 0.0)
    for one in np.flatnonzero(is_moved).tolist():
        for other in range(len(surfaces)):
            if other == one or (other < one and is_moved[other]):
                continue
            ids = some[about[one] + about[other] < width]
            both = [distances(centroids[ids], surfaces[each]) for each in (one, other)]
            inside[ids[both[0] + both[1] < width]] = True
    return inside


def _in_box(nodes: Floats, surface: Surface, reach: float) -> NDArray[np.bool_]:
    """Which nodes are within a surface's box, enlarged by `reach`."""
    vertices = surface.vertices
    low, high = vertices.min(axis=0) - reach, vertices.max(axis=0) + reach
    inside: NDArray[np.bool_] = ((nodes >= low) & (nodes <= high)).all(axis=1)
    return inside


@dataclass(frozen=True, eq=False)
class CaseContacts:
    """The sheets that tissue may slide on, by segment."""

    sheets: Mapping[str, ContactSheet] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()

    def of(self, segment: BoneSegment) -> SurfaceData:
        """The contact surface of a segment: its sheet, else the blurred bone."""
        sheet = self.sheets.get(segment.name)
        return contact_surface(segment) if sheet is None else sheet.surface

    def of_scene(self, segments: Sequence[BoneSegment], kinds: NodeKinds) -> dict[str, SurfaceData]:
        """The contact surface of each segment that nodes slide on."""
        slid = [s for s in segments if len(kinds.nodes("sliding", s.name))]
        return {segment.name: self.of(segment) for segment in slid}

    def summary(
        self,
        segments: Sequence[BoneSegment],
        kinds: NodeKinds,
        nodes: Floats,
        contacts: Mapping[str, SurfaceData],
    ) -> dict[str, dict[str, Any]]:
        """What build.json states of the contact surfaces of a scene.

        Departures, mm, say how far each lies from the bone under the nodes that slide.
        """
        stated = {}
        for segment in segments:
            if segment.name not in contacts:
                continue
            sliding = kinds.nodes("sliding", segment.name)
            mean, p95, largest = sheet_departure(
                contacts[segment.name], segment.surface, nodes[sliding]
            )
            sheet = self.sheets.get(segment.name)
            stated[segment.name] = {
                "surface": "bone" if sheet is None else "sheet",
                "departure_mean": round(mean, 3),
                "departure_p95": round(p95, 3),
                "departure_max": round(largest, 3),
                **({} if sheet is None else {"relief": sheet.relief, "radius": sheet.radius}),
            }
        return stated


def arch_sheets(
    anatomy: Anatomy,
    segments: Sequence[BoneSegment],
    arches: DentalArches,
    options: KindOptions,
    edge_length: float,
) -> CaseContacts:
    """The contact sheets of the arches of a head, for the segments that bear them.

    A sheet is that of the whole bone before it is cut, so that it goes on smoothly past the cuts;
    each piece carries it with its own motion. `edge_length`: mm, of the tets.
    Raises `CaseError`: No bone at an arch.
    """
    if not options.sliding or options.contact_surface == "bone" or not arches.by_jaw:
        return CaseContacts()
    given = {region.segment for region in options.regions}
    both = arches.bearers["upper"] & arches.bearers["lower"]
    findings = [_bears_both(segments[number].name) for number in sorted(both)]
    sheets: dict[str, ContactSheet] = {}
    for jaw, arch in arches.by_jaw.items():
        mine = [segments[i] for i in sorted(arches.bearers[jaw] - both)]
        mine = [segment for segment in mine if segment.name not in given]
        if not mine:
            continue
        upper = jaw == "upper"
        sheet = contact_sheet(
            mine[0].name,
            _whole_bone(anatomy, mine, arches.bearers["lower" if upper else "upper"], segments),
            arch,
            SheetOptions(
                radius=RADIUS_IN_EDGES * edge_length,
                above=max(
                    options.upper_front if upper else options.lower_front,
                    options.upper_molars if upper else options.lower_molars,
                    0.0,
                ),
                behind=max(options.behind, 0.0),
                beside=max(options.beside, 0.0),
            ),
        )
        if sheet.radius < RADIUS_IN_EDGES * edge_length:
            findings.append(_sharp(jaw, mine[0].name, sheet, edge_length))
        sheets |= {segment.name: sheet for segment in mine}
    return CaseContacts(sheets, tuple(findings))


def _whole_bone(
    anatomy: Anatomy,
    mine: Sequence[BoneSegment],
    others: frozenset[int],
    segments: Sequence[BoneSegment],
) -> ImageData:
    """The level of all that bears an arch: its segments, and the bones that they were cut from.

    But for a bone that the other arch, too, was cut from.
    """
    level = mine[0].level.values
    for segment in mine[1:]:
        # Not `maximum.reduce`, which copies all levels into one array first.
        level = np.maximum(level, segment.level.values)
    inside = level > 0.0
    theirs = [segments[number].level.values > 0.0 for number in sorted(others)]
    for bone in anatomy.bones.values():
        values = bone.values
        if values.shape != level.shape or not (inside & (values > 0.0)).any():
            continue
        # Unless more than half of a segment of the other arch lies in this bone.
        mostly = (2 * np.count_nonzero(o & (values > 0.0)) > np.count_nonzero(o) for o in theirs)
        if not any(mostly):
            level = np.maximum(level, values)
    return mine[0].level.with_values(level)


def _bears_both(name: str) -> Finding:
    return Finding(
        "contact-sheet",
        f"{name!r} carries the upper and the lower teeth: tissue slides on the smoothed bone, "
        "because a single contact sheet cannot extend past the edges of both",
        severity="note",
        where=f"segment {name}",
        why="lips and cheeks move with both jaws, which move together",
        fix="separate the jaws in the image or surfaces if only one of them moves",
    )


def _sharp(jaw: str, name: str, sheet: ContactSheet, edge_length: float) -> Finding:
    return Finding(
        "contact-sheet",
        f"the contact sheet of the {jaw} arch has a radius of curvature of {sheet.radius:.1f} mm "
        f"where tissue slides; {RADIUS_IN_EDGES * edge_length:g} mm, half an edge of the tets, "
        "are needed so that the tets can follow it",
        severity="warning",
        where=f"segment {name}",
        why="sliding may need many iterations there, or not converge",
        fix="check the bone at this arch, or use a smaller edge_length in [mesh]",
    )
