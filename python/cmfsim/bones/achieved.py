"""The plan that an operation achieved, from the bones before and after (paper 3, Figure 5).

Scans are first laid on each other by the skull that was left alone (`register_volumes`). Then each
bone segment is laid on the post-operative bone; what that takes is its motion, as Table 2 of the
paper has it. Surfaces with the same triangles before and after need no search: their vertices say
the motion, rigid or not.
"""

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from cmfsim._core import IcpFit, Surface, rigid_fit
from cmfsim.bones.motion import RemovedBone, missing_patches
from cmfsim.checks import (
    Floats,
    as_floats,
    as_number,
    as_positive,
    as_text,
    check_instance,
    check_one_of,
    frozen,
)
from cmfsim.errors import RegistrationError, RegistrationInputError
from cmfsim.registration import icp
from cmfsim.values.anatomy import BoneSegment
from cmfsim.values.frozen import Frozen
from cmfsim.values.motion import RigidMotion, decompose_motion, rigid_matrix
from cmfsim.values.surface_data import MovedSurface, SurfaceData

__all__ = [
    "AchievedMotion",
    "AchievedPlan",
    "MatchOptions",
    "achieved_plan",
    "measure_motion",
]

_LOG = logging.getLogger(__name__)

# A motion counts as rigid if it takes every vertex this near to where it went, mm: a tenth of what
# a segmented bone is known to, and far above the rounding of a surface file.
RIGID_TOLERANCE = 0.1
# Points of the quick search for a start, and its steps from each.
QUICK_POINTS = 400
QUICK_STEPS = 20
# The search rests when a step moves no point by more than this share of the segment's size: 0.1 µm,
# where noise of the bone still swaps partners.
REST = 2e-6
MOST_STEPS = 300
# Trimming a fixed share leaves out sound bone too, its noisier part. The last search takes all
# within so many times the rms of the trimmed fit, 2.3 standard deviations of the noise if 0.3 are
# trimmed, but not less than this, mm.
CUT = 4.0
LEAST_CUT = 0.05
Segments: TypeAlias = Mapping[str, SurfaceData | BoneSegment]


@dataclass(frozen=True)
class MatchOptions:
    """How a bone segment is laid on the post-operative bone.

    Attributes
    ----------
    trim : float
        Share of the segment's vertices, those furthest from the bone, that have no say while the
        place is searched: cut faces, plates, bone that was ground away. 0 to below 1.
    reach : float, mm
        The search also begins this far to each side along each axis, for segments that moved on to
        a neighbour of their place; 0: only from where they were.
    max_angle : float, degrees
        Between normals of partners: keeps the inner side of a bone off its outer side.
    max_rms : float, mm
        Of the partners at the end; a worse fit is an error.
    least_share : float
        Of the vertices that must have a partner at the end.

    Raises
    ------
    RegistrationError, CaseError
        (also `ValueError`) A value out of its range; not a number.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.MatchOptions(trim=0.4).reach
    6.0
    """

    trim: float = 0.3
    reach: float = 6.0
    max_angle: float = 60.0
    max_rms: float = 1.0
    least_share: float = 0.3

    def __post_init__(self) -> None:
        for name in ("max_angle", "max_rms"):
            as_positive(name, getattr(self, name))
        if as_number("reach", self.reach) < 0.0:
            raise RegistrationInputError(f"reach is {self.reach:g} mm: must not be below 0")
        if not 0.0 <= as_number("trim", self.trim) < 1.0:
            raise RegistrationInputError(f"trim is {self.trim:g}: must be from 0 to below 1")
        if not 0.0 < as_number("least_share", self.least_share) <= 1.0:
            raise RegistrationInputError(
                f"least_share is {self.least_share:g}: must be above 0, to 1"
            )


@dataclass(frozen=True, eq=False)
class AchievedMotion(Frozen):
    """Where a bone segment went.

    Attributes
    ----------
    matrix : (4, 4) float64, mm
        The rigid motion, from before to after; the nearest one if it is not rigid.
    motion : RigidMotion
        The same in a planner's numbers.
    method : str
        "vertices" (same triangles before and after) or "icp".
    is_rigid : bool
        Whether the rigid motion is the whole motion; always for "icp".
    rms, worst : float, mm
        What the rigid motion leaves: distance of vertices from where they went ("vertices"), or of
        the kept vertices from the post-operative bone ("icp").
    share : float
        Share of the vertices that were kept.
    moved : MovedSurface or None
        The motion vertex by vertex, where the triangles are the same.
    removed : tuple of RemovedBone
        Patches of the segment that are not there after the operation, where it was searched for:
        they lie outside the bone after it. They have no say in the motion.
    """

    matrix: Floats
    motion: RigidMotion
    method: str
    is_rigid: bool
    rms: float
    worst: float
    share: float
    moved: MovedSurface | None
    removed: tuple[RemovedBone, ...] = ()

    @property
    def plan(self) -> Floats | MovedSurface:
        """What a plan takes: the matrix, or the moved surface where it is not rigid."""
        return self.matrix if self.is_rigid or self.moved is None else self.moved

    def as_dict(self) -> dict[str, Any]:
        """Plain values with units in their names, as JSON holds them."""
        return {
            "method": self.method,
            "is_rigid": self.is_rigid,
            "translation_mm": self.motion.translation.tolist(),
            "angle_degrees": self.motion.angle,
            "axis": self.motion.axis.tolist(),
            "centre_mm": self.motion.centre.tolist(),
            "matrix": self.matrix.tolist(),
            "rms_mm": self.rms,
            "worst_mm": self.worst,
            "share": self.share,
            "removed": [
                {"area_mm2": p.area, "depth_mm": p.depth, "place_mm": p.place.tolist()}
                for p in self.removed
            ],
        }


@dataclass(frozen=True, eq=False)
class AchievedPlan(Frozen):
    """What each bone segment did in an operation.

    Attributes
    ----------
    motions : mapping of str to AchievedMotion
    alignment : (4, 4) float64, mm
        Takes the post-operative frame to the pre-operative one, the correction by the reference
        segment included.
    correction : RigidMotion or None
        What the reference segment took off the given alignment; None without a reference.
    """

    motions: Mapping[str, AchievedMotion]
    alignment: Floats
    correction: RigidMotion | None

    @property
    def plan(self) -> dict[str, Floats | MovedSurface]:
        """The motion of each segment, as scenes and plans take it."""
        return {name: motion.plan for name, motion in self.motions.items()}

    def as_dict(self) -> dict[str, Any]:
        """Plain values with units in their names, as JSON holds them."""
        correction = None
        if self.correction is not None:
            correction = {
                "translation_mm": self.correction.translation.tolist(),
                "angle_degrees": self.correction.angle,
            }
        return {
            "segments": {name: motion.as_dict() for name, motion in self.motions.items()},
            "alignment": self.alignment.tolist(),
            "correction": correction,
        }

    def text(self) -> str:
        """Translation and turn of each segment, as Table 2 of Kim et al. (2010) has them."""
        lines = [["segment", "left", "back", "up", "turn", "about axis", "rms", "kept"]]
        for name, found in self.motions.items():
            shift, axis = found.motion.translation, found.motion.axis
            lines.append(
                [
                    name,
                    *(f"{c:+.2f} mm" for c in shift),
                    f"{found.motion.angle:.2f}°",
                    "(" + ", ".join(f"{c:+.2f}" for c in axis) + ")",
                    f"{found.rms:.2f} mm" + ("" if found.is_rigid else ", not rigid"),
                    f"{found.share:.0%}",
                ]
            )
        widths = [max(len(line[i]) for line in lines) for i in range(len(lines[0]))]
        return "\n".join(
            "  ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)).rstrip()
            for line in lines
        )


def measure_motion(
    before: SurfaceData,
    after: SurfaceData,
    *,
    centre: ArrayLike | None = None,
    tolerance: float = RIGID_TOLERANCE,
) -> AchievedMotion:
    """The motion between two surfaces with the same triangles, vertex by vertex.

    Parameters
    ----------
    before, after : SurfaceData
        The same vertices and triangles in the same order, in one frame.
    centre : (3,) float64, mm, optional
        About which the turn is written. Default: the middle of the vertices before.
    tolerance : float, mm
        The motion counts as rigid if the best rigid one takes each vertex this near.

    Returns
    -------
    AchievedMotion

    Raises
    ------
    RegistrationError
        (also `ValueError`) Other triangles; vertices that lie on one line.

    Examples
    --------
    >>> import cmfsim
    >>> bone = cmfsim.SurfaceData([[0, 0, 0], [9, 0, 0], [0, 9, 0]], [[0, 1, 2]])
    >>> moved = cmfsim.SurfaceData([[0, -4, 1], [9, -4, 1], [0, 5, 1]], [[0, 1, 2]])
    >>> found = cmfsim.measure_motion(bone, moved)
    >>> found.is_rigid, found.motion.translation.round(9).tolist()
    (True, [0.0, -4.0, 1.0])
    """
    for name, surface in (("before", before), ("after", after)):
        check_instance(f"the surface {name}", surface, SurfaceData)
    as_positive("tolerance", tolerance)
    if not _same_triangles(before, after):
        raise RegistrationInputError(
            f"the surfaces have other triangles: {len(np.asarray(before.triangles))} on "
            f"{len(np.asarray(before.vertices))} vertices before, "
            f"{len(np.asarray(after.triangles))} on {len(np.asarray(after.vertices))} after; a "
            "motion by vertices needs the same, in the same order; achieved_plan searches instead"
        )
    here, there = np.asarray(before.vertices), np.asarray(after.vertices)
    fit = rigid_fit(here, there)
    worst = float(fit.residuals.max())
    return AchievedMotion(
        matrix=frozen(fit.matrix),
        motion=decompose_motion(fit.matrix, _centre(centre, here)),
        method="vertices",
        is_rigid=worst <= tolerance,
        rms=float(fit.rms),
        worst=worst,
        share=1.0,
        moved=MovedSurface(before, there),
    )


def achieved_plan(
    segments: Segments,
    postoperative: SurfaceData | Mapping[str, SurfaceData],
    *,
    alignment: ArrayLike | None = None,
    reference: str | None = None,
    centres: Mapping[str, ArrayLike] | None = None,
    options: MatchOptions | None = None,
) -> AchievedPlan:
    """The motion of each bone segment, from the bone before and after the operation.

    Parameters
    ----------
    segments : mapping of str to SurfaceData or BoneSegment
        Cut as the surgeon cut them, where they were before the operation.
    postoperative : SurfaceData, or mapping of str to SurfaceData
        The whole bone after the operation, or a surface for each segment. One with the triangles of
        its segment gives the motion by vertices; else the segment is laid on it.
    alignment : (4, 4) float64, mm, optional
        Takes the post-operative frame to the pre-operative one: `register_volumes(after, before)`.
        Default: one frame.
    reference : str, optional
        A segment that the operation left alone, the cranium. What it takes to lay it on the
        post-operative bone is taken off the alignment, and so off every other motion.
    centres : mapping of str to (3,) float64, mm, optional
        About which turns are written. Default: the middle of each segment's vertices.
    options : MatchOptions, optional

    Returns
    -------
    AchievedPlan

    Raises
    ------
    RegistrationError
        A segment that does not fit, or too little of it; ICP does not come to rest; also
        `ValueError`: no segment, a name that is nowhere, an alignment that is not rigid.
    MeshError
        (also `ValueError`) A surface with degenerate triangles.

    Notes
    -----
    Trimmed iterative closest points (Besl & McKay 1992; Chetverikov et al. 2002), begun from where
    the segment was and from 6 mm to each side, on the best of which it goes on.

    Examples
    --------
    >>> import cmfsim
    >>> found = cmfsim.achieved_plan(
    ...     {"cranium": cranium, "maxilla": maxilla}, bone_after,
    ...     alignment=volumes.matrix, reference="cranium",
    ... )  # doctest: +SKIP
    >>> print(found.text())  # doctest: +SKIP
    """
    options = MatchOptions() if options is None else options
    parts = _surfaces(segments)
    into = np.eye(4) if alignment is None else rigid_matrix(alignment, "alignment")
    if reference is not None:
        check_one_of("reference", reference, tuple(parts))
    for name in centres or {}:
        check_one_of("centre", name, tuple(parts))
    targets = _targets(postoperative, parts)

    def measure(name: str, frame: Floats) -> AchievedMotion:
        after = _transformed(targets[name], frame)
        centre = (centres or {}).get(name)
        if _same_triangles(parts[name], after):
            return measure_motion(parts[name], after, centre=centre)
        return _matched(name, parts[name], after, centre, options)

    correction = None
    if reference is not None:
        still = measure(reference, into)
        into = np.linalg.inv(still.matrix) @ into
        correction = decompose_motion(np.linalg.inv(still.matrix), still.motion.centre)
        _LOG.info(
            "alignment corrected by %s: %.3f mm, %.3f°",
            reference,
            float(np.linalg.norm(correction.translation)),
            correction.angle,
        )
    motions = {name: measure(name, into) for name in parts}
    return AchievedPlan(MappingProxyType(motions), frozen(into), correction)


def _matched(
    name: str,
    segment: SurfaceData,
    bone: SurfaceData,
    centre: ArrayLike | None,
    options: MatchOptions,
) -> AchievedMotion:
    """Lays a segment on the bone."""
    core = Surface(bone.vertices, bone.triangles, crease_angle=bone.crease_angle)
    vertices = np.asarray(segment.vertices)
    try:
        fit = icp(
            segment,
            core,
            initial=_start(vertices, core, options),
            trim=options.trim,
            max_angle=options.max_angle,
            max_iterations=MOST_STEPS,
            tolerance=REST,
        )
        if fit.rms <= options.max_rms:
            fit = icp(
                segment,
                core,
                initial=fit.matrix,
                max_distance=max(CUT * fit.rms, LEAST_CUT),
                max_angle=options.max_angle,
                max_iterations=MOST_STEPS,
                tolerance=REST,
            )
    except RegistrationError as error:
        raise RegistrationError(
            f"segment {name!r} cannot be laid on the post-operative bone: {error}"
        ) from error
    worst = float(fit.distances[fit.kept].max())
    if fit.rms > options.max_rms or fit.kept_fraction < options.least_share:
        raise RegistrationError(
            f"segment {name!r} does not fit the post-operative bone: {fit.rms:.2f} mm rms over "
            f"{fit.kept_fraction:.0%} of its vertices (allowed {options.max_rms:g} mm, at least "
            f"{options.least_share:.0%}); see whether the scans are aligned, whether the segment "
            "is cut as it was in the operation, and whether the bone is all there; a larger trim "
            "leaves out plates and new bone"
        )
    _LOG.info("segment %s: %.3f mm rms, %.0f %% kept", name, fit.rms, 100 * fit.kept_fraction)
    return AchievedMotion(
        matrix=frozen(fit.matrix),
        motion=decompose_motion(fit.matrix, _centre(centre, vertices)),
        method="icp",
        is_rigid=True,
        rms=float(fit.rms),
        worst=worst,
        share=float(fit.kept_fraction),
        moved=None,
        removed=missing_patches(segment, core, fit.matrix),
    )


def _start(vertices: Floats, bone: Surface, options: MatchOptions) -> Floats:
    """The best of several short searches, from where the segment was and from either side."""
    # Any order of vertices in the file gives points from all over the segment.
    order = np.random.default_rng(0).permutation(len(vertices))[:QUICK_POINTS]
    points = vertices[order]
    shifts = [np.zeros(3)]
    if options.reach > 0.0:
        shifts += [sign * options.reach * axis for axis in np.eye(3) for sign in (-1.0, 1.0)]
    best: IcpFit | None = None
    for shift in shifts:
        initial = np.eye(4)
        initial[:3, 3] = shift
        fit = icp(
            points,
            bone,
            initial=initial,
            trim=options.trim,
            max_iterations=QUICK_STEPS,
            # Exactly as many steps as asked for: the search goes on from the best.
            tolerance=0.0,
        )
        if best is None or fit.rms < best.rms:
            best = fit
    return np.eye(4) if best is None else np.asarray(best.matrix)


def _surfaces(segments: Segments) -> dict[str, SurfaceData]:
    if not segments:
        raise RegistrationInputError("there is no segment to look for")
    found: dict[str, SurfaceData] = {}
    for name, segment in segments.items():
        surface = segment.surface if isinstance(segment, BoneSegment) else segment
        check_instance(f"segment {as_text('segment name', name)!r}", surface, SurfaceData)
        found[name] = surface
    return found


def _targets(
    postoperative: SurfaceData | Mapping[str, SurfaceData], parts: Mapping[str, SurfaceData]
) -> Mapping[str, SurfaceData]:
    """The post-operative surface that each segment is looked for on."""
    if isinstance(postoperative, SurfaceData):
        return dict.fromkeys(parts, postoperative)
    missing = [name for name in parts if name not in postoperative]
    if missing:
        raise RegistrationInputError(
            f"there is no post-operative surface of {', '.join(missing)}: give one for each of "
            f"{', '.join(parts)}, or one surface of the whole bone"
        )
    for name in parts:
        check_instance(f"post-operative surface of {name!r}", postoperative[name], SurfaceData)
    return postoperative


def _same_triangles(one: SurfaceData, other: SurfaceData) -> bool:
    return len(np.asarray(one.vertices)) == len(np.asarray(other.vertices)) and np.array_equal(
        np.asarray(one.triangles), np.asarray(other.triangles)
    )


def _transformed(surface: SurfaceData, matrix: Floats) -> SurfaceData:
    vertices = np.asarray(surface.vertices) @ matrix[:3, :3].T + matrix[:3, 3]
    return SurfaceData(vertices, surface.triangles, surface.crease_angle)


def _centre(centre: ArrayLike | None, vertices: Floats) -> Floats:
    return vertices.mean(axis=0) if centre is None else as_floats("centre", centre)
