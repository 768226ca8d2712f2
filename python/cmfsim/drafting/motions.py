"""The motions of segments: the plan of a case, from transforms, from files, or as it was typed."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from cmfsim.drafting.choices import Anatomy, quoted
from cmfsim.drafting.finds import LooseMotion, SurfaceFind, Taken, TransformFind, unused
from cmfsim.drafting.roles import MOVING, safe_key
from cmfsim.errors import CaseInputError, CmfsimError
from cmfsim.io.slicer.transforms import is_itk_file, motion_in_lps, read_transform_file
from cmfsim.values.case_parts import CUT_UP, PROCEDURES
from cmfsim.values.checks import Floats, as_number, check_one_of
from cmfsim.values.clinical_motion import clinical_motion, planned_motion
from cmfsim.values.proposed_landmarks import ProposedSite

# A landmark that was found automatically is the centre of a turn up to this expected error, mm:
# a turn by 5° is then 0.4 mm off at most as a translation.
SURE = 5.0
# A motion below this, mm and as entries of a rotation, is none.
NOTHING = 1e-9
# What each word does: which number of a motion it is, and its sign.
SHIFTS = {
    "forwards": (0, 1.0), "backwards": (0, -1.0), "up": (1, 1.0), "down": (1, -1.0),
    "left": (2, 1.0), "right": (2, -1.0),
}  # fmt: skip
TURNS = {"pitch": 0, "yaw": 1, "roll": 2}
WORDS = (*SHIFTS, *TURNS)


@dataclass(frozen=True, eq=False)
class DraftMotion:
    """The motion of a segment as the case will have it.

    words: What it does, such as "moves the maxilla 4.0 mm forwards at the upper incisors".
    matrix: (4, 4), mm, LPS, or None.
    transform, typed: TOML instead of a matrix: a value, or keys of the table with theirs.
    question: Why a person has to decide; empty if not.
    shown: (4, 4), mm, LPS, or None. The motion that `words` describes.
    """

    words: str
    source: tuple[str, ...]
    matrix: Floats | None = None
    transform: str = ""
    question: str = ""
    choices: tuple[str, ...] = ()
    shown: Floats | None = None
    typed: Mapping[str, str] = field(default_factory=dict)


@dataclass
class Plan:
    """The motions of a case by segment, and what was noticed.

    landmarks: mapping of str to (3,), mm, LPS, of the skull, before the operation.
    links: The names of the transforms of the scene that are motions of segments.
    sites: Landmarks that were found automatically, where no file has any.
    """

    anatomy: Anatomy
    landmarks: Mapping[str, Floats]
    motions: dict[str, DraftMotion] = field(default_factory=dict)
    taken: list[Taken] = field(default_factory=list)
    others: list[Taken] = field(default_factory=list)
    links: set[str] = field(default_factory=set)
    sites: Mapping[str, ProposedSite] = field(default_factory=dict)

    def words(
        self, segment: str, matrix: Floats, landmarks: Mapping[str, Floats] | None = None
    ) -> str:
        """A motion in words, at landmarks of files or at others."""
        find = self.anatomy.bones.get(segment)
        vertices = None if find is None else self.anatomy.placed(find)
        places = self.landmarks if landmarks is None else landmarks
        stated = clinical_motion(segment, matrix, landmarks=places, vertices=vertices)
        return f"moves the {segment.replace('_', ' ')} {stated.text}"


def scene_motions(
    plan: Plan,
    moved: Mapping[str, SurfaceFind],
    loose: Sequence[LooseMotion],
    reference: Floats,
    *,
    in_image: bool,
) -> None:
    """Adds the motions that a scene applies to segments, relative to the rest of the head.

    loose: Transforms that are applied to nothing.
    reference: (4, 4), mm, LPS. What the scene applies to what does not move.
    in_image: Whether the case is in the coordinates of its image, not in those of the world.
    """
    back = np.linalg.inv(reference)

    def relative(find: SurfaceFind) -> Floats:
        return back @ find.to_world if in_image else find.to_world @ back

    # Surfaces about which there are questions, by the bone's name.
    asked: dict[str, list[SurfaceFind]] = {}
    for question in plan.anatomy.questions:
        part, _, name = question.key.partition(".")
        finds = [find for find, _ in question.choices if find is not None]
        if part == "bones" and finds:
            asked[name] = finds
    # What the skin lies under as well moves no segment.
    skin = plan.anatomy.skin
    shared = set() if skin is None else {*skin.chain}
    # A piece that has a segment's name moves by it, wherever its surface comes from.
    known = {n: finds[0] for n, finds in asked.items() if n in MOVING and len(finds) == 1}
    for name, find in {**moved, **known}.items():
        matrix = relative(find)
        if np.abs(matrix - np.eye(4)).max() <= NOTHING:
            continue
        words = plan.words(name, matrix)
        chain = " → ".join(find.chain) or "no transform, and the rest of the head under one"
        source = (
            f"{find.label} lies under: {chain}; the matrix is what that does to it relative to",
            "the rest of the head, in LPS mm: from where it is to where it goes.",
        )
        asks, choices = _unusual(name, find, words)
        plan.motions[name] = DraftMotion(words, source, matrix, "", asks, choices, matrix)
        plan.links |= {*find.chain} - shared
        why = f"transform to parent of {find.label} in the scene: {words}"
        label = ", ".join(find.chain) or find.label
        plan.taken.append(Taken(label, f"motion of {name}", why, "mm", "LPS"))
    for name, finds in asked.items():
        if name not in known:
            _ask_whose(plan, name, [(find, relative(find)) for find in finds])
    for motion in loose:
        _add_loose(plan, motion)


def _ask_whose(plan: Plan, name: str, finds: Sequence[tuple[SurfaceFind, Floats]]) -> None:
    """Asks about the motion of a bone of which it is not clear which surface, or bone, it is."""
    moved = [found for found in finds if np.abs(found[1] - np.eye(4)).max() > NOTHING]
    if not moved:
        return
    choices = [f"{find.label} {plan.words(name, matrix)}" for find, matrix in moved]
    if len(moved) == 1:
        choices.append("if it is: write the matrix below, under the name of the bone")
    question = f"is this the motion of {name}? See [surfaces.bones]"
    plan.motions[name] = DraftMotion(
        "", (), moved[0][1] if len(moved) == 1 else None, "", question, tuple(choices)
    )
    label = ", ".join(dict.fromkeys(link for find, _ in moved for link in find.chain))
    plan.links |= {link for find, _ in moved for link in find.chain}
    plan.taken.append(Taken(label, f"motion of {name}", question, "mm", "LPS", question=True))


def _unusual(name: str, find: SurfaceFind, words: str) -> tuple[str, tuple[str, ...]]:
    """Why a motion that a scene has may be none of the plan."""
    if name == "cranium":
        return "the scene moves the cranium relative to the skin: is that planned?", (
            f"it {words}",
            "remove this table if the cranium stays, or rename it and write the matrix below",
        )
    words_of = [link for link in find.chain if any(w in link.lower() for w in ("regist", "align"))]
    if words_of:
        return (
            f"{words_of[0]!r} looks like the name of a registration, not of a plan: which is it?"
        ), (
            f"as a plan it {words}",
            "remove this table if the segment does not move, or write the matrix below instead",
        )
    return "", ()


def _add_loose(plan: Plan, motion: LooseMotion) -> None:
    name = motion.role.part
    if name not in MOVING or name in plan.motions or motion.role.registers:
        why = "the scene does not apply this transform to any model"
        plan.others.append(unused(motion.label, why))
        return
    words = plan.words(name, motion.matrix)
    question = f"{motion.label} is not applied to any model: was it hardened, or is it the plan?"
    choices = (
        f"as the plan it {words}: write the matrix below instead of this line;",
        "if it was hardened, the surface has moved already: undo that in Slicer, and init again",
    )
    plan.motions[name] = DraftMotion(words, (), motion.matrix, "", question, choices)
    what = f"motion of {name}"
    plan.taken.append(Taken(motion.label, what, question, "mm", "LPS", question=True))


def file_motions(plan: Plan, found: Sequence[TransformFind], *, by_slicer: bool) -> None:
    """Adds the motions in transform files, perhaps 3D Slicer's, by the segment in each name."""
    by_part: dict[str, list[TransformFind]] = {}
    for find in found:
        part = find.role.part
        if part in MOVING and not find.role.registers:
            by_part.setdefault(part, []).append(find)
        elif find.role.registers:
            why = "its name suggests a registration, not a plan"
            plan.taken.append(unused(find.label, why))
        else:
            _ask_segment(plan, find)
    for name, finds in by_part.items():
        if len(finds) > 1:
            text = f"{' or '.join(f.label for f in finds)}: which one moves the {name}?"
            choices = tuple(quoted(find.label) for find in finds)
            plan.motions[name] = DraftMotion("", (), None, '"?"', text, choices)
            what = f"motion of {name}"
            plan.taken += [Taken(find.label, what, text, question=True) for find in finds]
            continue
        find = finds[0]
        try:
            motion = _of_file(plan, name, find, by_slicer=by_slicer)
        except (CmfsimError, OSError) as error:
            plan.others.append(unused(find.label, f"is not a rigid motion of {name}: {error}"))
            text = f"{find.label} cannot be used: {error}"
            plan.motions[name] = DraftMotion("", (), None, '"?"', text, ("or remove this table",))
            continue
        plan.motions[name] = motion
        asked = bool(motion.question)
        why = motion.question or f"{motion.source[0]}: {motion.words}"
        plan.taken.append(Taken(find.label, f"motion of {name}", why, "mm", "", question=asked))


def _ask_segment(plan: Plan, find: TransformFind) -> None:
    """Asks what a transform moves whose name does not say it."""
    text = f"{find.label}: its name does not identify a segment. Which one does it move?"
    choices = (
        f"{quoted(find.label)}, and rename this table to [plan.NAME] of one of",
        f"{', '.join(MOVING)}; or remove the table",
    )
    name = safe_key(find.label.rpartition("/")[2].partition(".")[0])
    plan.motions[name] = DraftMotion("", (), None, '"?"', text, choices)
    plan.taken.append(Taken(find.label, "", text, question=True))


def _of_file(plan: Plan, name: str, find: TransformFind, *, by_slicer: bool) -> DraftMotion:
    """The motion in a file, in its direction and frame; raises as `read_transform_file`."""
    file = f"file = {quoted(find.label)}"

    def read_as(direction: str) -> Floats:
        return read_transform_file(find.path, direction=direction).matrix

    if not is_itk_file(find.path):
        with find.path.open("rb") as begin:
            if not begin.read(30).startswith(b"#Insight Transform File"):
                return _of_text(plan, name, find)
    try:
        stated = read_transform_file(find.path)
    except CmfsimError:
        slicer, other = (plan.words(name, read_as(way)) for way in ("from-parent", "to-parent"))
        if by_slicer:
            source: tuple[str, ...] = (
                f"{find.label} is taken as 3D Slicer saves it, from-parent: other files are its.",
                f'If ITK registered the bone before to the one after: "to-parent", which {other}.',
            )
            toml = f'{{{file}, direction = "from-parent"}}'
            return DraftMotion(slicer, source, None, toml, shown=read_as("from-parent"))
        text = f"{find.label} does not record its direction: which of these is the plan?"
        choices = (
            f'"from-parent" (as 3D Slicer saves it): {slicer}',
            f'"to-parent" (as ITK registers it): {other}',
        )
        return DraftMotion("", (), None, f'{{{file}, direction = "?"}}', text, choices)
    words = plan.words(name, stated.matrix)
    source = (f"{find.label} states its direction: {stated.direction}",)
    toml = f'{{{file}, direction = "{stated.direction}"}}'
    return DraftMotion(words, source, None, toml, shown=stated.matrix)


def _of_text(plan: Plan, name: str, find: TransformFind) -> DraftMotion:
    """The motion in a text of 4 × 4 numbers."""
    read = read_transform_file(find.path)
    here = plan.words(name, read.matrix)
    file = f"file = {quoted(find.label)}"
    other = plan.words(name, motion_in_lps(read.matrix, "RAS"))
    is_stated = "frame" not in read.assumed
    if is_stated or here == other:
        how = read.text if is_stated else "LPS or RAS, which give the same motion"
        toml = f'{{{file}, frame = "{read.frame if is_stated else "LPS"}"}}'
        return DraftMotion(here, (f"{find.label}: {how}",), None, toml, shown=read.matrix)
    text = f"{find.label} does not state its frame: which of these is the plan?"
    choices = (
        f'"RAS" (the matrix that 3D Slicer shows): {other}',
        f'"LPS" (typed, or made by ITK): {here}',
    )
    return DraftMotion("", (), None, f'{{{file}, frame = "?"}}', text, choices)


@dataclass(frozen=True)
class TypedPlan:
    """What a person wants cut, by procedures, and moved: numbers by word for each segment.

    Forwards, backwards, up, down, left, right in mm; in degrees pitch (front up), yaw (front to
    the left), roll (left side up).
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

    @property
    def turns(self) -> bool:
        """Whether anything is turned."""
        return any(numbers.get(word) for numbers in self.moves.values() for word in TURNS)


def read_moves(given: Iterable[Iterable[str]]) -> dict[str, dict[str, float]]:
    """The numbers of `--move SEGMENT WORD=NUMBER …`, by segment; `CaseError` for anything else."""
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
    Raises `CaseError`: A segment that does not exist, that a cut divides, or that a file moves; a
        cut whose pieces are there; a turn about a point that is not known.
    """
    bones = set(bones)
    for cut in typed.cuts:
        there = sorted(bones.intersection(PROCEDURES[cut]))
        if there:
            raise CaseInputError(f"--cut {cut} makes {there[0]}, which is there as a surface")
    whole = {
        CUT_UP[cut]: cut
        for cut in CUT_UP
        if cut in typed.cuts or not typed.moves.keys().isdisjoint(PROCEDURES[cut])
    }
    known = sorted((bones - {"cranium"}) | {name for made in PROCEDURES.values() for name in made})
    for segment, numbers in typed.moves.items():
        check_one_of("segment of --move", segment, known)
        if segment in whole:
            pieces = PROCEDURES[whole[segment]]
            raise CaseInputError(
                f"--move {segment}: {whole[segment]} cuts it into {', '.join(pieces)}; write "
                f"--move {pieces[0]} for the piece with the teeth"
            )
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
    places = plan.landmarks
    if turn.any() and not places:
        places = {name: site.point for name, site in plan.sites.items() if site.error <= SURE}
    still = clinical_motion(segment, np.eye(4), landmarks=places, vertices=vertices)
    if turn.any() and (still.point is None or is_turned):
        why = "a scene turns the head" if is_turned else "no file of landmarks names it"
        why += "" if is_turned or plan.landmarks else ", and it was not found in the head"
        raise CaseInputError(
            f"--move {segment}: pitch, yaw and roll turn it about its teeth or chin, whose place "
            f"is not known yet, because {why}; give mm alone, and turn it on the page of cmfsim "
            "desk or plan, or run cmfsim landmarks and name its file first"
        )
    at = np.zeros(3) if still.point is None else still.point
    matrix = planned_motion(at, shift=shift, turn=turn)
    typed = " ".join(f"{word}={value:g}" for word, value in numbers.items())
    source = f"As typed: --move {segment} {typed}"
    # The middle of a surface, about which a piece without landmarks turns, is no such site.
    errors = [s.error for s in plan.sites.values() if np.array_equal(s.point, at)]
    if turn.any() and errors:
        source += f"; {still.place} found automatically, to within {errors[0]:.1f} mm"
    lines = {"translation": _row([shift[2], -shift[0], shift[1]])}
    if turn.any():
        vector = np.array([-turn[0], -turn[2], turn[1]])
        angle = float(np.linalg.norm(vector))
        lines |= {"angle": repr(angle), "axis": _row(vector / angle), "centre": _row(at)}
    words = plan.words(segment, matrix, places)
    return DraftMotion(words, (source,), matrix, shown=matrix, typed=lines)


def _row(values: Iterable[float] | Floats) -> str:
    return f"[{', '.join(repr(float(value) + 0.0) for value in values)}]"
