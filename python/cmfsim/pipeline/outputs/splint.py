"""The splint of a case: its jaws as planned, and what lies between their tooth rows."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from cmfsim.doctor.surgery.bone_overlap import jaw_of, joint_heads
from cmfsim.errors import CaseInputError
from cmfsim.io import CaseOrPath, as_case
from cmfsim.pipeline.building.case_model import planned_head
from cmfsim.pipeline.building.stages import BuildKeywords, build_options
from cmfsim.planning.occlusion import THICKNESS, Splint, rigid_of, splint_between, tooth_rows
from cmfsim.values.anatomy import BoneSegment
from cmfsim.values.checks import Floats, check_one_of
from cmfsim.values.dental_arch import JAWS

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


def _hinge(segments: Sequence[BoneSegment]) -> tuple[Floats, Floats]:
    """The joint heads of the lower jaw before the operation, left and right."""
    lower = [s.surface.vertices for s in segments if jaw_of(s.name) == "lower"]
    if not lower:
        raise CaseInputError("no segment is called mandible: the joint heads are not known")
    points = np.concatenate(lower)
    right, left = (points[index] for index in joint_heads(points))
    return left, right
