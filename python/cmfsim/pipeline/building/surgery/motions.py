"""The motions of the bone segments of a case, with findings; a torn segment is cut there."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from cmfsim.bones.cuts.cutting import part_segment
from cmfsim.bones.motion import RemovedBone, sound_motion, torn_pieces
from cmfsim.bones.pairs.paired_surfaces import REACH, StrayPatch
from cmfsim.bones.pairs.shape_fit import OPEN, OpenDirection, ShapeFit
from cmfsim.doctor.surgery.moved_bones import check_pairs
from cmfsim.errors import CaseInputError
from cmfsim.io import Case, read_surface
from cmfsim.pipeline.building.inputs import motion_source, read_motion
from cmfsim.pipeline.building.surgery.postoperative import (
    REFERENCES,
    Postoperative,
    read_postoperative,
)
from cmfsim.surfaces.repair import clean_surface
from cmfsim.values.anatomy import BoneSegment
from cmfsim.values.checks import Floats, frozen_mapping
from cmfsim.values.finding import Finding, findings_at
from cmfsim.values.surface_data import MovedSurface, SurfaceData, joined_surface

if TYPE_CHECKING:
    from cmfsim.bones.achieved import AchievedMotion, AchievedPlan

# A size that differs by less was segmented otherwise, and is not reported. From the second on it is
# a warning, as for bones that are followed vertex by vertex.
NOTED, SCALED = 0.01, 0.03
# Slip of vertices that is not reported, mm: noise of the scans does as much.
SLID = 0.5
Motions = Mapping[str, Floats | MovedSurface]


def plan_key(case: Case, name: str) -> str:
    """The key of the case file that the motion of a bone comes from."""
    return f"postoperative.bones.{name}" if case.achieved else f"plan.{name}"


def motion_findings(
    found: AchievedMotion, name: str, skull: ShapeFit | None, *, is_still: bool
) -> Iterator[Finding]:
    """Findings about a motion read off the bone after, where `skull` lies, left alone, if known."""
    severity = "note" if found.method == "icp" else "warning"
    yield from (_removed_finding(name, patch, severity) for patch in found.removed)
    fit = found.fit
    if found.method == "vertices" or fit is None:
        yield from _vertex_findings(found, name, is_still=is_still)
        return
    yield from (_stray_finding(name, patch, is_still=is_still) for patch in found.stray)
    yield from _size_findings(name, fit, None if is_still else skull)
    yield from (_open_finding(name, way, found.method) for way in fit.open)
    if found.slip > SLID:
        yield _slip_finding(name, found.slip, "median", "its shape did not change")


def _vertex_findings(found: AchievedMotion, name: str, *, is_still: bool) -> Iterator[Finding]:
    """Findings about a bone that is followed vertex by vertex."""
    if len(found.pieces) > 1:
        areas = ", ".join(f"{piece.area / 100.0:.0f}" for piece in found.pieces)
        yield Finding(
            "motion-pieces",
            f"{name} moved as {len(found.pieces)} rigid pieces within its surface, of {areas} cm²",
            why="each piece is followed along its normals; between pieces the vertices are "
            "followed as they are",
        )
    if not (is_still or found.is_rigid):
        yield _bent_finding(name, found.fit)
    if found.slip > SLID:
        why = "bending explains less motion along the surface than the vertices show"
        yield _slip_finding(name, found.slip, "rms", why)
    if found.noise > 0.0:
        yield Finding(
            "motion-slip",
            f"the vertices of {name} moved with {found.noise:.2f} mm of noise, which is averaged "
            "out",
        )


def _slip_finding(name: str, slip: float, measure: str, why: str) -> Finding:
    """Vertices of a fitted mesh that slid along the bone."""
    return Finding(
        "motion-slip",
        f"the vertices of {name} slid along its surface by {slip:.1f} mm ({measure})",
        why=f"{why}, so the slip is that of the fitted mesh, not of the bone, and is subtracted",
    )


def _size_findings(name: str, fit: ShapeFit, skull: ShapeFit | None) -> Iterator[Finding]:
    """A change of size with its interval, and what it does to the motion."""
    low, high = fit.scale_interval
    change = abs(fit.scale - 1.0)
    is_sure = not low <= 1.0 <= high
    if change < (NOTED if is_sure else SCALED):
        return
    common = ""
    if skull is not None and _is_scaled(skull):
        shift = (skull.scale - 1.0) * (fit.image - skull.image)
        common = (
            f"; the skull is {skull.scale:.3g} times as large as well; if this applies to the "
            f"whole scan, ({', '.join(f'{x:+.1f}' for x in shift)}) mm of the motion are not "
            "motion of the bone"
        )
    yield Finding(
        "moved-scaled",
        f"{name} is {fit.scale:.3g} times as large after the operation as before (95 % "
        f"interval {low:.3f} to {high:.3f}, by its shape)",
        severity="warning" if is_sure and change > SCALED else "note",
        why="bone does not grow during an operation, so the scans are calibrated or segmented "
        f"differently by {change:.1%}; the motion is that of the middle of the bone, without "
        f"the change of size{common}",
    )


def _is_scaled(fit: ShapeFit) -> bool:
    low, high = fit.scale_interval
    return abs(fit.scale - 1.0) >= NOTED and not low <= 1.0 <= high


def _open_finding(name: str, way: OpenDirection, method: str) -> Finding:
    """A motion of the bone that its shape hardly shows."""
    axis = ", ".join(f"{x:+.2f}" for x in way.axis)
    words = (
        f"a rotation about the axis ({axis})" if way.is_turn else f"a translation along ({axis})"
    )
    left = (
        "that of the vertices, including their slip along the bone"
        if method == "shape"
        else "the starting value of the search, so this part of the motion may be wrong"
    )
    return Finding(
        "motion-open",
        f"the shape of {name} hardly determines {words}: eigenvalue ratio {way.ratio:.3f}, "
        f"{OPEN:g} is needed",
        facts={"left": left},
    )


def _bent_finding(name: str, fit: ShapeFit | None) -> Finding:
    """A bone that is followed vertex by vertex, as no rigid motion lays it on the bone after."""
    left = (
        "no rigid motion fits it to the post-operative bone"
        if fit is None
        else f"its best rigid motion, at the best size, leaves {np.quantile(fit.off, 0.95):.1f} "
        "mm (95th percentile)"
    )
    return Finding("motion-bent", f"{name} has a different shape after the operation: {left}")


def _removed_finding(name: str, patch: RemovedBone, severity: str) -> Finding:
    """A patch of bone that is not there after the operation."""
    at = ", ".join(f"{x:.0f}" for x in patch.place.tolist())
    used = (
        "its vertices are not used" if severity == "warning" else "it was not used for the motion"
    )
    return Finding(
        "bone-removed",
        f"{patch.area:.0f} mm² of {name} about ({at}) mm are missing after the operation, "
        f"by up to {patch.depth:.1f} mm: this counts as removed bone, not as motion",
        severity=severity,
        facts={"used": used},
    )


def _stray_finding(name: str, patch: StrayPatch, *, is_still: bool) -> Finding:
    """The warning about a piece of a segment that is off the post-operative bone."""
    at = ", ".join(f"{x:.0f}" for x in patch.place.tolist())
    piece = f"{patch.area / 100.0:.1f} cm² of {name} about ({at}) mm"
    if patch.has_bone:
        what = (
            f"{piece} are off the post-operative bone, by {patch.distance:.1f} mm (median), but "
            "bone is nearby: this piece moved differently from the segment, or its remaining "
            "surface is deeper"
        )
        fix = (
            "if that piece was cut (genioplasty, split maxilla), make it a separate segment in "
            "[[osteotomies]]; otherwise check whether bone was removed there"
        )
    else:
        what = (
            f"{piece} have no post-operative bone within {REACH:g} mm that faces the same way "
            f"({patch.distance:.1f} mm to the nearest, median): removed, outside the scan, or "
            "moved further"
        )
        fix = (
            "check whether bone was removed there and whether the post-operative scan shows "
            "that place; if the piece was cut and moved, make it a separate segment in "
            "[[osteotomies]]"
        )
    # A smaller scan after the operation cuts off the skull nearly always, which moves nothing.
    return Finding(
        "achieved-piece-off",
        what,
        severity="note" if is_still and not patch.has_bone else "warning",
        fix=fix,
    )


@dataclass(frozen=True, eq=False)
class PlannedBones:
    """The bone segments of a case, with the motions, (4, 4) mm or MovedSurface, of some of them.

    achieved: How they were found, where the plan is the achieved one.
    fits: How the motions that a plan gives by surfaces were found.
    sources: Where each motion comes from and how it was understood, in words.
    """

    segments: tuple[BoneSegment, ...]
    motions: Motions
    findings: tuple[Finding, ...] = ()
    achieved: AchievedPlan | None = None
    fits: Mapping[str, AchievedMotion] = field(default_factory=dict)
    sources: Mapping[str, str] = field(default_factory=dict)


def planned_bones(
    case: Case, segments: tuple[BoneSegment, ...], after: Postoperative | None = None
) -> PlannedBones:
    """The segments of a case, cut already, with the motions of its plan or of the operation.

    after: What `read_postoperative` gives, where it is known already.
    Raises `CaseError`, `BoundaryError`, `RegistrationError`: For what is no segment or motion.
    """
    known = [segment.name for segment in segments]
    for name in case.plan:
        if name not in known:
            raise CaseInputError(
                f"{case.where(f'plan.{name}')}: there is no segment {name!r}; segments are: "
                f"{', '.join(known)}; an osteotomy makes others"
            )
    if case.achieved:
        return _achieved_bones(case, segments, after or read_postoperative(case))
    fits: dict[str, AchievedMotion] = {}
    motions: dict[str, Floats | MovedSurface] = {}
    for name, motion in case.plan.items():
        given = read_motion(case, motion)
        motions[name] = _laid(name, given, segments, fits) if isinstance(given, tuple) else given
    planned = _with_motions(case, segments, motions, fits)
    return replace(
        planned,
        findings=(*planned.findings, *_fit_findings(case, known, fits)),
        fits=frozen_mapping(fits),
        sources={name: motion_source(motion) for name, motion in case.plan.items()},
    )


def _laid(
    name: str,
    pair: tuple[SurfaceData, SurfaceData],
    segments: tuple[BoneSegment, ...],
    fits: dict[str, AchievedMotion],
) -> Floats | MovedSurface:
    """The rigid motion of a bone that has different triangles before and after, entered in `fits`.

    It is found on the surfaces as given: those of segments are as coarse as their voxels.
    """
    from cmfsim.bones.achieved import achieved_plan  # noqa: PLC0415

    before, after = (clean_surface(surface) for surface in pair)
    others = [segment.surface for segment in segments if segment.name != name]
    found = achieved_plan({name: before}, {name: after}, beside=others)
    fits[name] = found.motions[name]
    return found.plan[name]


def _fit_findings(
    case: Case, names: list[str], fits: Mapping[str, AchievedMotion]
) -> Iterator[Finding]:
    """Findings about the motions that were found from surfaces before and after."""
    skull = next((fits[name].fit for name in REFERENCES if name in fits), None)
    for name, found in fits.items():
        # A torn bone's pieces are numbered after it.
        bone = name if name in names else name.rsplit("_", 1)[0]
        where = case.where(plan_key(case, bone))
        own = motion_findings(found, name, skull, is_still=name in REFERENCES)
        yield from findings_at(where, own)


def _with_motions(
    case: Case,
    segments: tuple[BoneSegment, ...],
    motions: Motions,
    measured: dict[str, AchievedMotion],
) -> PlannedBones:
    """The segments with their motions, separated where these are torn.

    Motions by vertices come from surfaces before and after: what vertices slid along the bone is
    subtracted, and what was found is entered in `measured`.
    """
    findings: list[Finding] = []
    parted: list[BoneSegment] = []
    planned: dict[str, Floats | MovedSurface] = {}
    for segment in segments:
        motion = motions.get(segment.name)
        if not isinstance(motion, MovedSurface):
            parted.append(segment)
            if motion is not None:
                planned[segment.name] = motion
            continue
        motion = sound_motion(motion)
        # Vertices over resected bone are squeezed, as if torn off: the whole is asked first.
        found = _measured(motion, is_still=segment.name in REFERENCES)
        whole = found.method == "shape" or found.is_rigid
        pieces = [(segment, motion)] if whole else _parted(case, segment, motion, findings)
        for piece, its_own in pieces:
            if len(pieces) > 1:
                found = _measured(its_own, is_still=piece.name in REFERENCES)
            parted.append(piece)
            measured[piece.name] = found
            by_vertex = found.moved if found.method == "vertices" else None
            planned[piece.name] = found.plan if by_vertex is None else by_vertex
    return PlannedBones(tuple(parted), planned, tuple(findings))


def _measured(motion: MovedSurface, *, is_still: bool) -> AchievedMotion:
    """The motion of a piece without slip, noise and bone that was removed."""
    from cmfsim.bones.achieved import measure_pair  # noqa: PLC0415

    after = SurfaceData(motion.moved_vertices, motion.surface.triangles)
    return measure_pair(motion.surface, after, is_still=is_still)


def _achieved_bones(
    case: Case, segments: tuple[BoneSegment, ...], after: Postoperative
) -> PlannedBones:
    """The segments with the motions measured on the post-operative bones (paper 3, Figure 5).

    A bone with the same triangles after says where each vertex went, less what vertices slid along
    it; any other segment is laid on the bone of its name, or on all of them.
    """
    names = [segment.name for segment in segments]
    by_vertex = {
        name: moved
        for name in names
        if name in after.bones and (moved := _same_bone(case, name, after.bones[name])) is not None
    }
    pairs = {name: _paired(case, name, moved) for name, moved in by_vertex.items()}
    searched = [segment for segment in segments if segment.name not in by_vertex]
    reference = next((name for name in REFERENCES if name in names), None)
    if searched and reference is not None and reference not in by_vertex:
        if after.bones.keys() & {reference, "bone"}:
            still = [s for s in searched if s.name == reference]
        else:
            # Nothing is known of it after the operation, in which it was not touched.
            still, reference = [], None
            searched = [s for s in searched if s.name not in REFERENCES]
    else:
        still, reference = [], None
    # Bones of the case, as they are called before they are cut.
    sources = ("cranium", "mandible", "skull") if case.surfaces is None else case.surfaces.bones
    unknown = [n for n in after.bones if n not in {*names, *sources, "bone"}]
    if unknown:
        raise CaseInputError(
            f"{case.where(f'postoperative.bones.{unknown[0]}')}: there is no bone or segment "
            f"{unknown[0]!r}; use one of: {', '.join(names)}"
        )
    from cmfsim.bones.achieved import AchievedPlan, achieved_plan  # noqa: PLC0415

    motions: dict[str, Floats | MovedSurface] = dict(by_vertex)
    measured: dict[str, AchievedMotion] = {}
    achieved = AchievedPlan(measured, np.eye(4), None)
    if searched:
        bones = {name: clean_surface(surface) for name, surface in after.bones.items()}
        whole = joined_surface(list(bones.values()))
        achieved = achieved_plan(
            {s.name: s for s in (*still, *(s for s in searched if s not in still))},
            {s.name: bones.get(s.name, whole) for s in searched},
            reference=reference,
            beside=[s.surface for s in segments if s not in searched],
        )
        motions |= {name: found for name, found in achieved.plan.items() if name != reference}
    made = _with_motions(case, segments, motions, measured)
    motions_found = {**achieved.motions, **measured}
    noticed = [
        finding
        for name, found in pairs.items()
        for finding in found
        # By shape the size is known with an interval, and is no part of the motion.
        if not (finding.code == "moved-scaled" and measured[name].method == "shape")
    ]
    noticed += _fit_findings(case, names, motions_found)
    return replace(
        made,
        findings=(*made.findings, *noticed),
        achieved=replace(achieved, motions=frozen_mapping(motions_found)),
    )


def _same_bone(case: Case, name: str, there: SurfaceData) -> MovedSurface | None:
    """The motion of a bone whose surface has the same triangles before and after; else none."""
    given = case.postoperative
    before = None if case.surfaces is None else case.surfaces.bones.get(name)
    if before is None or given is None or case.surfaces is None:
        return None
    here = read_surface(before, units=case.surfaces.units, frame=case.surfaces.frame)
    return MovedSurface(here, there.vertices) if here.has_triangles_of(there) else None


def _paired(case: Case, name: str, moved: MovedSurface) -> list[Finding]:
    """Findings on a bone followed by vertices; `CaseError` if it is mirrored or shuffled."""
    found = [*findings_at(case.where(plan_key(case, name)), check_pairs(name, moved))]
    for finding in found:
        if finding.severity == "error":
            raise CaseInputError(f"{finding.where}: {finding.what}; {finding.fix}")
    return found


def _parted(
    case: Case, segment: BoneSegment, motion: MovedSurface, findings: list[Finding]
) -> list[tuple[BoneSegment, MovedSurface]]:
    """The pieces of a segment that moved apart, each with its motion."""
    pieces = torn_pieces(motion)
    if len(pieces) == 1:
        return [(segment, pieces[0])]
    named = {
        f"{segment.name}_{n + 1}" if n else segment.name: piece for n, piece in enumerate(pieces)
    }
    made = part_segment(segment, {name: piece.surface for name, piece in named.items()})
    findings.append(
        Finding(
            "motion-pieces",
            f"{segment.name} moved as {len(made)} pieces: {', '.join(p.name for p in made)}",
            where=case.where(plan_key(case, segment.name)),
            why="neighbouring vertices moved apart by millimetres between them, so the bone was "
            "cut there: no tissue is joined to the gap, and each piece has its own contact "
            "surface",
        )
    )
    return [(piece, named[piece.name]) for piece in made]
