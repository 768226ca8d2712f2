"""The teeth of a case as planned: the splint between their rows, and the final bite of scans."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from cmfsim.doctor.surgery.bone_overlap import jaw_of, joint_heads
from cmfsim.errors import CaseInputError
from cmfsim.io import CaseOrPath, as_case
from cmfsim.pipeline.building.case_model import planned_head
from cmfsim.pipeline.building.stages import BuildKeywords, build_options
from cmfsim.planning.occlusion import (
    THICKNESS,
    FinalBite,
    Splint,
    final_bite,
    rigid_of,
    splint_between,
    tooth_rows,
)
from cmfsim.values.anatomy import JAWS, BoneSegment
from cmfsim.values.checks import Floats, check_one_of
from cmfsim.values.finding import Finding
from cmfsim.values.surface_data import MovedSurface, SurfaceData

if TYPE_CHECKING:
    from typing_extensions import Unpack

# The jaw that an intermediate splint holds where it is planned, while the other is not moved yet.
FIRST: Mapping[str, str] = {"maxilla": "upper", "mandible": "lower"}


def make_splint(
    case: CaseOrPath,
    *,
    intermediate: str | None = None,
    thickness: float = THICKNESS,
    opening: float = 0.0,
    label: str = "",
    **options: "Unpack[BuildKeywords]",
) -> Splint:
    """The splint between the tooth rows of a case as planned; nothing is written.

    Parameters
    ----------
    case : Case, or path of its file or folder
    intermediate : str, optional
        The jaw that is operated on first, "maxilla" or "mandible": the splint holds it as planned
        against the other jaw before the operation. Without it, both are as planned.
    thickness : float, mm
        Of every wall at least, from 1.5 to 6.
    opening : float, degrees
        By which the lower jaw is opened about its joint heads, from 0 to 15, to make room.
    label : str
        Raised letters on the front.
    **options
        Those of `BuildOptions`.

    Returns
    -------
    Splint

    Raises
    ------
    CaseError
        (also `ValueError`) No tooth rows; rows that overlap or lie too close; a jaw that is to be
        operated on first and is not moved by the plan.

    Examples
    --------
    >>> import cmfsim
    >>> splint = cmfsim.make_splint("patient", intermediate="maxilla")  # doctest: +SKIP
    >>> cmfsim.write_surface("splint.stl", splint.surface)  # doctest: +SKIP
    """
    if intermediate is not None:
        check_one_of("intermediate", intermediate, tuple(FIRST))
    case = as_case(case)
    with build_options(options, {}) as asked:
        head, bones, findings = planned_head(case, asked)
        rows = tooth_rows(head.anatomy, bones.segments, head.skull, findings)
        motions = {row.arch.jaw: rigid_of(bones.motions.get(row.segment)) for row in rows}
        held = JAWS if intermediate is None else (FIRST[intermediate],)
        if all(np.array_equal(motions[jaw], np.eye(4)) for jaw in held):
            still = " and ".join(row.segment for row in rows if row.arch.jaw in held)
            raise CaseInputError(
                f"the plan does not move {still} (splint-not-moved): the splint would hold the "
                "teeth as they are; give a plan, or name the jaw that moves first"
            )
        asked.observer.stage("making the splint")
        upper, lower = (
            row.moved(motions[row.arch.jaw]) if row.arch.jaw in held else row for row in rows
        )
        hinge = _hinge(bones.segments)
        return splint_between(
            upper, lower, hinge, thickness=thickness, opening=opening, label=label
        )


def plan_for_bite(
    case: CaseOrPath,
    upper_scan: SurfaceData,
    lower_scan: SurfaceData,
    **options: "Unpack[BuildKeywords]",
) -> tuple[FinalBite, dict[str, Floats]]:
    """The final bite of two intraoral scans, and the plan in which the lower jaw follows into it.

    The plan is that of the case but for the segment with the lower teeth.

    Parameters
    ----------
    case : Case, or path of its file or folder
    upper_scan, lower_scan : SurfaceData
        As for `final_bite`.
    **options
        Those of `BuildOptions`.

    Returns
    -------
    FinalBite
    dict of str to (4, 4) float64, mm

    Raises
    ------
    CaseError
        (also `ValueError`) As for `final_bite`; a plan that is not rigid.

    Examples
    --------
    >>> import cmfsim
    >>> scans = [cmfsim.read_surface(f"{jaw}.stl") for jaw in ("upper", "lower")]  # doctest: +SKIP
    >>> bite, plan = cmfsim.plan_for_bite("patient", *scans)  # doctest: +SKIP
    >>> cmfsim.write_plan("bite.toml", plan)  # doctest: +SKIP
    """
    case = as_case(case)
    with build_options(options, {}) as asked:
        head, bones, findings = planned_head(case, asked)
        upper, lower = tooth_rows(head.anatomy, bones.segments, head.skull, findings)
        plan = {}
        for name, motion in bones.motions.items():
            if isinstance(motion, MovedSurface) or motion.shape != (4, 4):
                raise CaseInputError(
                    f"the plan bends {name} (bite-plan-bends): a rigid motion is needed"
                )
            plan[name] = np.asarray(motion, dtype=np.float64)
        if upper.segment == lower.segment:
            raise CaseInputError(
                f"both rows are on {upper.segment} (bite-one-segment): separate the jaws"
            )
        asked.observer.stage("finding the final bite")
        bite = final_bite(upper, lower, upper_scan, lower_scan)
        if bite.mirrored:
            jaws = " and ".join(bite.mirrored)
            what = f"the mirror image of the {jaws} scan fits the teeth as well"
            asked.observer.found([Finding("bite-scan-symmetric", what)])
        plan[lower.segment] = bite.following(plan.get(upper.segment, np.eye(4)))
        return bite, plan


def _hinge(segments: Sequence[BoneSegment]) -> tuple[Floats, Floats]:
    """The joint heads of the lower jaw before the operation, left and right."""
    lower = [s.surface.vertices for s in segments if jaw_of(s.name) == "lower"]
    if not lower:
        raise CaseInputError("no segment is called mandible: the joint heads are not known")
    points = np.concatenate(lower)
    right, left = (points[index] for index in joint_heads(points))
    return left, right
