"""Findings about how bones moved in an operation: removed, displaced, scaled, slid, left open."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from cmfsim.bones.motion import RemovedBone
from cmfsim.bones.pairs.shape_fit import OPEN, OpenDirection, ShapeFit
from cmfsim.bones.pairs.stray_patches import REACH, StrayPatch
from cmfsim.io import Case
from cmfsim.values.finding import Finding

if TYPE_CHECKING:
    from cmfsim.bones.achieved import AchievedMotion

# A size that differs by less was segmented otherwise, and is not reported. From the second on it is
# a warning, as for bones that are followed vertex by vertex.
NOTED, SCALED = 0.01, 0.03
# Slip of vertices that is not reported, mm: noise of the scans does as much.
SLID = 0.5


def plan_key(case: Case, name: str) -> str:
    """The key of the case file that the motion of a bone comes from."""
    return f"postoperative.bones.{name}" if case.achieved else f"plan.{name}"


def motion_findings(
    found: AchievedMotion, name: str, where: str, skull: ShapeFit | None, *, is_still: bool
) -> Iterator[Finding]:
    """Findings about the motion of a segment that was read off the bone after the operation.

    `skull` is how the bone that was left alone lies on the one after, where it is known.
    """
    severity = "note" if found.method == "icp" else "warning"
    yield from (_removed_finding(name, where, patch, severity) for patch in found.removed)
    fit = found.fit
    if found.method == "vertices" or fit is None:
        yield from _vertex_findings(found, name, where, is_still=is_still)
        return
    yield from (_stray_finding(name, where, patch, is_still=is_still) for patch in found.stray)
    yield from _size_findings(name, where, fit, None if is_still else skull)
    yield from (_open_finding(name, where, way, found.method) for way in fit.open)
    if found.slip > SLID:
        yield _slip_finding(name, where, found.slip, "median", "its shape did not change")


def _vertex_findings(
    found: AchievedMotion, name: str, where: str, *, is_still: bool
) -> Iterator[Finding]:
    """Findings about a bone that is followed vertex by vertex."""
    if len(found.pieces) > 1:
        areas = ", ".join(f"{piece.area / 100.0:.0f}" for piece in found.pieces)
        yield Finding(
            "motion-pieces",
            f"{name} moved as {len(found.pieces)} rigid pieces within its surface, of {areas} cm²",
            where=where,
            why="each piece is followed along its normals; between pieces the vertices are "
            "followed as they are",
        )
    if not (is_still or found.is_rigid):
        yield _bent_finding(name, where, found.fit)
    if found.slip > SLID:
        why = "bending explains less motion along the surface than the vertices show"
        yield _slip_finding(name, where, found.slip, "rms", why)
    if found.noise > 0.0:
        yield Finding(
            "motion-slip",
            f"the vertices of {name} moved with {found.noise:.2f} mm of noise, which is averaged "
            "out",
            where=where,
        )


def _slip_finding(name: str, where: str, slip: float, measure: str, why: str) -> Finding:
    """Vertices of a fitted mesh that slid along the bone."""
    return Finding(
        "motion-slip",
        f"the vertices of {name} slid along its surface by {slip:.1f} mm ({measure})",
        where=where,
        why=f"{why}, so the slip is that of the fitted mesh, not of the bone, and is subtracted",
    )


def _size_findings(
    name: str, where: str, fit: ShapeFit, skull: ShapeFit | None
) -> Iterator[Finding]:
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
        where=where,
        why="bone does not grow during an operation, so the scans are calibrated or segmented "
        f"differently by {change:.1%}; the motion is that of the middle of the bone, without "
        f"the change of size{common}",
    )


def _is_scaled(fit: ShapeFit) -> bool:
    low, high = fit.scale_interval
    return abs(fit.scale - 1.0) >= NOTED and not low <= 1.0 <= high


def _open_finding(name: str, where: str, way: OpenDirection, method: str) -> Finding:
    """A motion of the bone that its shape hardly shows."""
    axis = ", ".join(f"{x:+.2f}" for x in way.axis)
    words = (
        f"a rotation about the axis ({axis})" if way.is_turn else (f"a translation along ({axis})")
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
        where=where,
        facts={"left": left},
    )


def _bent_finding(name: str, where: str, fit: ShapeFit | None) -> Finding:
    """A bone that is followed vertex by vertex, as no rigid motion lays it on the bone after."""
    left = (
        "no rigid motion fits it to the post-operative bone"
        if fit is None
        else f"its best rigid motion, at the best size, leaves {np.quantile(fit.off, 0.95):.1f} "
        "mm (95th percentile)"
    )
    return Finding(
        "motion-bent", f"{name} has a different shape after the operation: {left}", where=where
    )


def _removed_finding(name: str, where: str, patch: RemovedBone, severity: str) -> Finding:
    """A patch of bone that is not there after the operation."""
    at = ", ".join(f"{x:.0f}" for x in patch.place.tolist())
    used = (
        "its vertices are not used" if severity == "warning" else ("it was not used for the motion")
    )
    return Finding(
        "bone-removed",
        f"{patch.area:.0f} mm² of {name} about ({at}) mm are missing after the operation, "
        f"by up to {patch.depth:.1f} mm: this counts as removed bone, not as motion",
        severity=severity,
        where=where,
        facts={"used": used},
    )


def _stray_finding(name: str, where: str, patch: StrayPatch, *, is_still: bool) -> Finding:
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
        where=where,
        fix=fix,
    )
