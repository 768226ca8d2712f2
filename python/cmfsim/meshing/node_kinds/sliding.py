"""The sliding regions: on teeth and mucosa of the two dental arches, or as given."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import third_party
from cmfsim.meshing.node_kinds.arches import DentalArches
from cmfsim.meshing.node_kinds.options import KindOptions
from cmfsim.values.anatomy import Anatomy, BoneSegment
from cmfsim.values.checks import Floats
from cmfsim.values.dental_arch import SHEET_DEPTH, DentalArch
from cmfsim.values.finding import Finding
from cmfsim.values.surface_data import SurfaceData

# Share of the nodes at an arch that lie on its sheet at least: half or more on three heads, and the
# others on lingual faces and the palate. Fewer nodes than this on a segment are not conclusive.
LEAST_SHARE, MANY = 0.25, 50
# How far past half-way to the other arch tissue slides behind the teeth, mm: on the ramus above it
# temporalis ends.
PAST_BITE = 4.0


def sliding_nodes(
    points: Floats,
    nearest: NDArray[np.intp],
    anatomy: Anatomy,
    segments: Sequence[BoneSegment],
    *,
    arches: DentalArches,
    contacts: Mapping[str, SurfaceData],
    options: KindOptions,
) -> tuple[NDArray[np.bool_], list[Finding]]:
    """Which points lie on a bone (its number in `nearest`, or −1) within its sliding region.

    Where a segment has a contact sheet in `contacts`, those that lie on the sheet; with a finding
    where few do, for then the sheet is not that of the bone.
    """
    findings: list[Finding] = []
    slides = np.zeros(len(points), dtype=bool)
    given = {region.segment for region in options.regions}
    for region in options.regions:
        number = next(i for i, s in enumerate(segments) if s.name == region.segment)
        slides |= (nearest == number) & region.holds(points)
    if not arches.by_jaw:
        return slides, findings
    near_teeth = _near_teeth(points, anatomy, options)
    for number, segment in enumerate(segments):
        jaws = [jaw for jaw, bearers in arches.bearers.items() if number in bearers]
        if segment.name in given or not jaws:
            continue
        alone = len(jaws) == 1
        inside = [_in_arch(points, arches.by_jaw[jaw], options, alone=alone) for jaw in jaws]
        mine = np.flatnonzero(np.logical_and.reduce([nearest == number, near_teeth, *inside]))
        if segment.name in contacts and len(mine):
            there = mine[_on_sheet(points[mine], contacts[segment.name])]
            if len(mine) >= MANY and len(there) < LEAST_SHARE * len(mine):
                findings.append(_far_sheet(segment.name, len(there), len(mine)))
            mine = there
        slides[mine] = True
    return slides, findings


def _far_sheet(name: str, on_sheet: int, within: int) -> Finding:
    return Finding(
        "contact-sheet",
        f"of {within} nodes on {name!r} at the arch only {on_sheet} lie within {SHEET_DEPTH:g} mm "
        "of its contact sheet; the others are joined",
        severity="warning",
        where=f"segment {name}",
        why="lips and cheeks would be attached to the teeth there",
    )


def _in_arch(
    points: Floats, arch: DentalArch, options: KindOptions, *, alone: bool
) -> NDArray[np.bool_]:
    """Which points lie between the vestibule of an arch and the bite, and not behind or beside it.

    alone: The bone bears this arch and not the other: behind the teeth it ends at the bite.
    """
    upper = arch.jaw == "upper"
    front_depth = options.upper_front if upper else options.lower_front
    molar_depth = options.upper_molars if upper else options.lower_molars
    across, forwards, out = arch.axes()
    tip, left, right = arch.tip, arch.left, arch.right
    a = tip + front_depth * out
    b, c = left + molar_depth * out, right + molar_depth * out
    normal = np.cross(b - a, c - a)
    normal = normal * np.sign(normal @ out)
    offset = points - arch.middle
    ahead = offset @ forwards
    region: NDArray[np.bool_] = (
        ((points - a) @ normal <= 0.0)
        & (ahead >= -options.behind)
        & (np.abs(offset @ across) <= arch.half_width + options.beside)
    )
    if alone:
        bite = 0.5 * arch.depth_molars + PAST_BITE
        region &= (ahead >= 0.0) | (-(offset @ out) <= bite)
    return region


def _on_sheet(points: Floats, sheet: SurfaceData) -> NDArray[np.bool_]:
    closest, _, _ = sheet.searched.closest(points)
    near: NDArray[np.bool_] = np.linalg.norm(closest - points, axis=1) <= SHEET_DEPTH
    return near


def _near_teeth(points: Floats, anatomy: Anatomy, options: KindOptions) -> NDArray[np.bool_]:
    """Which points lie near the teeth; all, where the teeth are not known apart from bone."""
    if anatomy.teeth is None or not (anatomy.teeth.values > 0.0).any():
        return np.ones(len(points), dtype=bool)
    ndimage = third_party("scipy.ndimage", "distances from the teeth are found", "imaging")
    distance = ndimage.distance_transform_edt(
        ~(anatomy.teeth.values > 0.0), sampling=anatomy.teeth.spacing.tolist()
    )
    return anatomy.teeth.with_values(distance).sample(points) <= options.teeth_distance
