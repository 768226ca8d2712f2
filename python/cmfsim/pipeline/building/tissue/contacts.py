"""The surfaces on which tissue slides in a case: the sheet of each arch, or the blurred bone."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim._core import TetMesh
from cmfsim.bones import ContactSheet, SheetOptions, contact_sheet, sheet_departure
from cmfsim.meshing.node_kinds import DentalArches, KindOptions
from cmfsim.surfaces.levels import contact_surface
from cmfsim.values.anatomy import Anatomy, BoneSegment
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding
from cmfsim.values.image_data import ImageData
from cmfsim.values.node_kinds import NodeKinds
from cmfsim.values.surface_data import SurfaceData

# Least radius of curvature of a sheet, as a part of the tissue's edge length: what tets can follow.
RADIUS_IN_EDGES = 0.5


@dataclass(frozen=True, eq=False)
class CaseContacts:
    """The sheets that tissue may slide on, by segment."""

    sheets: Mapping[str, ContactSheet] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()

    @property
    def surfaces(self) -> dict[str, SurfaceData]:
        """Their surfaces."""
        return {name: sheet.surface for name, sheet in self.sheets.items()}

    def of_scene(self, segments: Sequence[BoneSegment], kinds: NodeKinds) -> dict[str, SurfaceData]:
        """The contact surface of each segment that nodes slide on."""
        return {
            segment.name: (
                self.sheets[segment.name].surface
                if segment.name in self.sheets
                else contact_surface(segment)
            )
            for segment in segments
            if len(kinds.nodes("sliding", segment.name))
        }

    def summary(
        self,
        segments: Sequence[BoneSegment],
        kinds: NodeKinds,
        nodes: Floats,
        contacts: Mapping[str, SurfaceData],
    ) -> dict[str, dict[str, Any]]:
        """What build.json states of the contact surfaces of a scene.

        "surface" is "sheet" or "bone"; "departure_mean", "departure_p95" and "departure_max", mm,
        say how far it lies from the bone under the nodes that slide.
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
    each piece carries it with its own motion.

    edge_length: mm, of the tissue's tets.
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
        if not any(_mostly(other, values) for other in theirs):
            level = np.maximum(level, values)
    return mine[0].level.with_values(level)


def _mostly(inside: NDArray[np.bool_], bone: NDArray[Any]) -> bool:
    """Whether more than half of a segment lies in a bone."""
    return 2 * int(np.count_nonzero(inside & (bone > 0.0))) > int(np.count_nonzero(inside))


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


def mean_edge(mesh: TetMesh) -> float:
    """The mean length of the edges on the boundary of a mesh, mm."""
    corners = mesh.nodes[mesh.boundary_triangles()]
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean())
