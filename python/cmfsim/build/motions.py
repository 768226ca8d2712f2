"""How the bone segments of a case move: as its plan says, and parted where a motion is torn."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from cmfsim.bone_motion import smooth_motion, sound_motion, torn_pieces
from cmfsim.build.inputs import read_motion
from cmfsim.case import BoneSegment, Finding
from cmfsim.checks import Floats
from cmfsim.errors import CaseInputError
from cmfsim.io import Case
from cmfsim.osteotomy import part_segment
from cmfsim.scene import MovedSurface

__all__ = ["PlannedBones", "planned_bones"]

Motions = Mapping[str, Floats | MovedSurface]


@dataclass(frozen=True, eq=False)
class PlannedBones:
    """The bone segments of a case with their motions.

    Attributes
    ----------
    segments : tuple of BoneSegment
    motions : mapping of str to (4, 4) float64, mm, or MovedSurface
        Of the segments that the plan moves.
    findings : tuple of Finding
    """

    segments: tuple[BoneSegment, ...]
    motions: Motions
    findings: tuple[Finding, ...] = field(default=())


def planned_bones(case: Case, segments: tuple[BoneSegment, ...]) -> PlannedBones:
    """The segments of a case with the motions that its plan gives them.

    Raises
    ------
    CaseError, BoundaryError, RegistrationError
        (also `ValueError`) A segment that there is not; a motion that cannot be read or meant.
    """
    known = [segment.name for segment in segments]
    for name in case.plan:
        if name not in known:
            raise CaseInputError(
                f"{case.where(f'plan.{name}')}: there is no segment {name!r}; segments are: "
                f"{', '.join(known)}; an osteotomy makes others"
            )
    motions = {name: read_motion(case, motion) for name, motion in case.plan.items()}
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
        pieces = _parted(case, segment, motion, findings)
        for piece, its_own in pieces:
            parted.append(piece)
            planned[piece.name] = _quiet(case, segment.name, piece.name, its_own, findings)
    return PlannedBones(tuple(parted), planned, tuple(findings))


def _parted(
    case: Case, segment: BoneSegment, motion: MovedSurface, findings: list[Finding]
) -> list[tuple[BoneSegment, MovedSurface]]:
    """The pieces of a segment that moved apart, each with its motion."""
    motion = sound_motion(motion)
    pieces = torn_pieces(motion)
    if len(pieces) == 1:
        return [(segment, pieces[0])]
    named = {_numbered(segment.name, n): piece for n, piece in enumerate(pieces)}
    made = part_segment(segment, {name: piece.surface for name, piece in named.items()})
    findings.append(
        Finding(
            "note",
            "motion-torn",
            f"{segment.name} moved as {len(made)} pieces: {', '.join(p.name for p in made)}",
            case.where(f"plan.{segment.name}"),
            "between them neighbouring vertices moved apart by millimetres, so that the bone was "
            "cut there: no tissue is joined to the gap, and each piece has its contact surface",
            "look at the picture of the plan; nothing to do",
        )
    )
    return [(piece, named[piece.name]) for piece in made]


def _numbered(name: str, number: int) -> str:
    return name if number == 0 else f"{name}_{number + 1}"


def _quiet(
    case: Case, bone: str, name: str, motion: MovedSurface, findings: list[Finding]
) -> MovedSurface:
    """The motion without the noise of a measurement, which is said."""
    smooth, noise = smooth_motion(motion)
    if smooth is not motion:
        findings.append(
            Finding(
                "note",
                "motion-noisy",
                f"the vertices of {name} moved with {noise:.2f} mm of noise, which is averaged out",
                case.where(f"plan.{bone}"),
                "bone does not bend from one vertex to the next; tissue would be crumpled on it",
                "nothing to do",
            )
        )
    return smooth
