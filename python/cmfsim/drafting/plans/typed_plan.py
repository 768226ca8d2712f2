"""Cuts and motions that a person names when a case is drafted: `cmfsim init --cut … --move …`."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from cmfsim.drafting.plans.motions import DraftMotion, Plan
from cmfsim.errors import CaseInputError
from cmfsim.values.case_parts import PROCEDURES
from cmfsim.values.checks import Floats, as_number, check_one_of
from cmfsim.values.clinical_motion import clinical_motion, planned_motion

# What each word does: which number of a motion it is, and its sign.
SHIFTS = {
    "forwards": (0, 1.0), "backwards": (0, -1.0), "up": (1, 1.0), "down": (1, -1.0),
    "left": (2, 1.0), "right": (2, -1.0),
}  # fmt: skip
TURNS = {"pitch": 0, "yaw": 1, "roll": 2}
WORDS = (*SHIFTS, *TURNS)


@dataclass(frozen=True)
class TypedPlan:
    """What a person wants cut and moved.

    cuts: Procedures.
    moves: Numbers by word for each segment: forwards, backwards, up, down, left, right in mm, and
        pitch (front up), yaw (front to the left), roll (left side up) in degrees.
    """

    cuts: tuple[str, ...] = ()
    moves: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for cut in self.cuts:
            check_one_of("cut", cut, tuple(PROCEDURES))
        for segment, numbers in self.moves.items():
            if not numbers:
                raise CaseInputError(f"move of {segment}: no number; such as forwards=4")
            for word, value in numbers.items():
                check_one_of(f"word in the move of {segment}", word, WORDS)
                as_number(f"{word} of {segment}", value)
            for one, other in (("forwards", "backwards"), ("up", "down"), ("left", "right")):
                if one in numbers and other in numbers:
                    raise CaseInputError(f"move of {segment} has {one} and {other}: give one")


def read_moves(given: Iterable[Iterable[str]]) -> dict[str, dict[str, float]]:
    """The numbers of `--move SEGMENT WORD=NUMBER …`, by segment.

    Raises `CaseError`: No segment or no number, a text that is no number, a segment or a word given
        twice.
    """
    moves: dict[str, dict[str, float]] = {}
    for segment, *texts in given:
        if "=" in segment:
            raise CaseInputError(f"--move {segment}: the segment comes first, such as maxilla")
        if segment in moves:
            raise CaseInputError(f"--move {segment} is given twice: give all its numbers at once")
        numbers: dict[str, float] = {}
        for text in texts:
            word, separator, number = text.partition("=")
            try:
                value = float(number)
            except ValueError:
                value = np.nan
            if not separator or not np.isfinite(value):
                raise CaseInputError(
                    f"--move {segment} {text}: WORD=NUMBER is needed, such as forwards=4; words "
                    f"are {', '.join(WORDS)}"
                )
            if word in numbers:
                raise CaseInputError(f"--move {segment} has {word} twice")
            numbers[word] = value
        moves[segment] = numbers
    return moves


def add_typed(plan: Plan, typed: TypedPlan, bones: Iterable[str], *, is_turned: bool) -> None:
    """Adds the motions that a person typed to those of files.

    bones: That the case has before it is cut.
    is_turned: Whether a scene turns the case, so that its landmarks lie elsewhere.
    Raises `CaseError`: A segment that no bone is and no procedure makes, or that a file moves
        already; a cut whose pieces are there already; a turn about a point that is not known.
    """
    bones = set(bones)
    for cut in typed.cuts:
        there = sorted(bones.intersection(PROCEDURES[cut]))
        if there:
            raise CaseInputError(f"--cut {cut} makes {there[0]}, which is there as a surface")
    known = sorted((bones - {"cranium"}) | {name for made in PROCEDURES.values() for name in made})
    for segment, numbers in typed.moves.items():
        check_one_of("segment of --move", segment, known)
        if segment in plan.motions:
            raise CaseInputError(
                f"--move {segment}: a file or the scene moves it already; remove one of them"
            )
        plan.motions[segment] = _motion(plan, segment, numbers, is_turned=is_turned)


def _motion(
    plan: Plan, segment: str, numbers: Mapping[str, float], *, is_turned: bool
) -> DraftMotion:
    shift, turn = np.zeros(3), np.zeros(3)
    for word, value in numbers.items():
        if word in TURNS:
            turn[TURNS[word]] = value
        else:
            index, sign = SHIFTS[word]
            shift[index] = sign * value
    find = plan.anatomy.bones.get(segment)
    vertices = None if find is None else plan.anatomy.placed(find)
    still = clinical_motion(segment, np.eye(4), landmarks=plan.landmarks, vertices=vertices)
    if turn.any() and (still.point is None or is_turned):
        why = "a scene turns the head" if is_turned else "no file of landmarks names it"
        raise CaseInputError(
            f"--move {segment}: pitch, yaw and roll turn it about its teeth or chin, whose place "
            f"is not known yet, because {why}; give mm alone, and add the turn to the case file "
            "once cmfsim landmarks has found it"
        )
    at = np.zeros(3) if still.point is None else still.point
    matrix = planned_motion(at, shift=shift, turn=turn)
    typed = " ".join(f"{word}={value:g}" for word, value in numbers.items())
    source = (f"As typed: --move {segment} {typed}",)
    lines = {"translation": _row([shift[2], -shift[0], shift[1]])}
    if turn.any():
        vector = np.array([-turn[0], -turn[2], turn[1]])
        angle = float(np.linalg.norm(vector))
        lines |= {"angle": repr(angle), "axis": _row(vector / angle), "centre": _row(at)}
    return DraftMotion(plan.words(segment, matrix), source, matrix, shown=matrix, typed=lines)


def _row(values: Iterable[float] | Floats) -> str:
    return f"[{', '.join(repr(float(value) + 0.0) for value in values)}]"
