"""What is chosen for a case: CT, landmarks and surfaces, with the lines about them in its file."""

import os
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from cmfsim.drafting.finds import HU_AIR, ImageFind, LandmarkFind, SurfaceFind, Taken, unused
from cmfsim.values.case_parts import UNITS
from cmfsim.values.checks import Floats
from cmfsim.values.landmark_sites import SKIN_LANDMARKS, SKULL_LANDMARKS

# Characters of a line before its comment goes to lines of its own.
WIDTH = 100


def clean(text: str) -> str:
    """A text from a file on one line, without what ends a comment or commands a terminal."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)


def legible(name: str) -> str:
    """The name of a file as text: bytes that are not UTF-8 are read as Latin-1."""
    try:
        name.encode()
    except UnicodeEncodeError:
        return os.fsencode(name).decode("latin-1")
    return name


def quoted(text: str) -> str:
    """A TOML string; `UnicodeEncodeError` where a name is not UTF-8: no case can hold it."""
    text.encode()
    kept = (c if c.isprintable() and c not in '"\\' else f"\\U{ord(c):08x}" for c in text)
    return f'"{"".join(kept)}"'


@dataclass
class Text:
    """A case file as it is written, line by line, and the key and text of each question in it."""

    lines: list[str] = field(default_factory=list)
    questions: list[str] = field(default_factory=list)
    _table: str = ""

    def comment(self, text: str = "", hang: int = 0) -> None:
        """A comment, wrapped; lines after the first begin farther right by `hang`."""
        lines = textwrap.wrap(
            clean(text),
            WIDTH - 2,
            subsequent_indent=" " * hang,
            break_long_words=False,
            break_on_hyphens=False,
        )
        self.lines += [f"# {line}".rstrip() for line in lines or [""]]

    def table(self, name: str, why: str = "") -> None:
        """The head of a table."""
        self._table = name.strip("[]")
        head = f"[{name}]"
        self.lines += ["", f"{head}  # {clean(why)}" if why else head]

    def value(self, key: str, value: str, why: str = "") -> None:
        """A key with its value in TOML, and the reason for it."""
        line = f"{key} = {value}"
        reason = clean(why)
        if reason and len(line) + len(reason) + 4 > WIDTH:
            self.comment(reason)
            reason = ""
        self.lines.append(f"{line}  # {reason}" if reason else line)

    def ask(self, key: str, question: str, choices: Sequence[str], value: str = '"?"') -> None:
        """A key that a person decides: `doctor` refuses the file and repeats question and choices.

        value: TOML that holds "?".
        """
        place = f"{self._table}.{key}".lstrip(".")
        self.questions.append(f"{place}: {question}")
        self.lines.append(f"{key} = {value}  # {clean(question)}")
        self.lines += [f"#   {clean(choice)}" for choice in choices]

    def __str__(self) -> str:
        """The text of the file."""
        return "\n".join(self.lines) + "\n"


# LPS to RAS, and back.
TURN = np.array([-1.0, -1.0, 1.0])
# What stored values are when an offset of 1024 was added to HU.
OFFSET_RANGE = (1500.0, 5000.0)


@dataclass
class Images:
    """The CT of a case, the one after the operation, and what was noticed.

    question: Which of several images is the CT; `rescale`: what takes the values to HU; both with
        the choices. `scale` is what does, where that is clear.
    """

    ct: ImageFind | None = None
    after: ImageFind | None = None
    question: tuple[str, tuple[str, ...]] | None = None
    rescale: tuple[str, tuple[str, ...]] | None = None
    scale: str = ""
    taken: list[Taken] = field(default_factory=list)

    @property
    def is_there(self) -> bool:
        """Whether there is a CT, or a question about it."""
        return self.ct is not None or self.question is not None


def choose_images(found: Sequence[ImageFind]) -> Images:
    """The CT before the operation, and that after it, among images."""
    images = Images()
    before: list[ImageFind] = []
    for find in found:
        why = f"cannot be read: {find.error}" if find.error else ""
        if not why and find.modality not in {"", "CT"}:
            why = f"its header says {find.modality}, which is not a CT"
        if why:
            images.taken.append(unused(find.label, why))
        elif not find.role.is_after:
            before.append(find)
        elif images.after is None:
            images.after = find
            why = f"by its name; {_said(find)}"
            images.taken.append(Taken(find.label, "CT after the operation", why))
        else:
            images.taken.append(unused(find.label, "a second CT after the operation"))
    if len(before) == 1:
        images.ct = before[0]
        _check_values(images, before[0])
    elif before:
        names = " or ".join(find.label for find in before)
        question = f"{names}: which one is before the operation?"
        images.question = (question, tuple(_choice(find) for find in before))
        images.taken += [Taken(find.label, "", question, question=True) for find in before]
    return images


def _choice(find: ImageFind) -> str:
    """What may be written for an image, and what it is."""
    path = find.label.removesuffix(f" (series {find.series})")
    series = "" if find.series is None else f' with series = "{find.series}" on a line of its own'
    return f'"{path}"{series}: {_said(find)}'


def _check_values(images: Images, find: ImageFind) -> None:
    low, high = find.values
    why = _said(find)
    if find.to_hu is not None:
        slope, offset, error = find.to_hu
        images.scale = (
            f"The values are {low:g} to {high:g}, which are not HU. By the peaks of air and tissue "
            f"they become HU as {slope:.4g}·value {offset:+.4g}, to within {error:.0f} HU at bone; "
            f"to state another scale: rescale = [slope, intercept]"
        )
    asked = low > HU_AIR and find.to_hu is None
    if asked:
        shifted = OFFSET_RANGE[0] <= high <= OFFSET_RANGE[1]
        hint = ", as this range suggests" if shifted else ""
        images.rescale = (
            f"values are {low:g} to {high:g}: a CT in HU has air at -1000. How do they become HU?",
            (
                f"[1, -1024], if 1024 was added to HU{hint}",
                "[slope, intercept] of the program that wrote it; or remove the line: they are HU",
            ),
        )
        why += f"; {images.rescale[0]}"
    images.taken.append(Taken(find.label, "CT", why, "HU", "LPS", question=asked))


def _said(find: ImageFind) -> str:
    low, high = find.values
    modality = f"{find.modality}, " if find.modality else ""
    noticed = "".join(f"; {f.severity}: {f.what}" for f in find.findings if f.severity != "note")
    return f"{modality}{find.words}, values {low:g} to {high:g}{noticed}"


@dataclass
class Marks:
    """The landmarks of a case, their frame in files that state none, and questions by key."""

    skull: LandmarkFind | None = None
    skin: LandmarkFind | None = None
    after: LandmarkFind | None = None
    frame: str | None = None
    questions: dict[str, tuple[str, tuple[str, ...]]] = field(default_factory=dict)
    taken: list[Taken] = field(default_factory=list)

    @property
    def points(self) -> Mapping[str, Floats]:
        """The skull landmarks, LPS mm, as they are placed in their file."""
        return {} if self.skull is None else self.placed(self.skull)

    def placed(self, find: LandmarkFind) -> Mapping[str, Floats]:
        """The landmarks of a file in LPS mm, in the frame that was found for it."""
        if find.read.stated or self.frame in {None, find.read.frame}:
            return find.read.points
        return {label: point * TURN for label, point in find.read.points.items()}


def choose_landmarks(found: Sequence[LandmarkFind], box: Floats | None) -> Marks:
    """Skull and skin landmarks among files of points.

    box: (2, 3), mm, LPS, or None, where the head is, for files that do not state their frame.
    """
    marks = Marks()
    kinds: dict[str, list[LandmarkFind]] = {}
    for find in found:
        kind, why = _kind(find)
        if not kind:
            marks.taken.append(unused(find.label, why))
        else:
            kinds.setdefault(kind, []).append(find)
    for kind, finds in kinds.items():
        if len(finds) == 1 or kind == "after":
            setattr(marks, kind, finds[0])
            marks.taken += [_taken(find, kind) for find in finds[:1]]
            marks.taken += [
                unused(find.label, f"a second set of landmarks ({kind})") for find in finds[1:]
            ]
            continue
        names = " or ".join(find.label for find in finds)
        choices = tuple(f'"{find.label}": {len(find.read.points)} points' for find in finds)
        question = f"{names}: which are the {kind} landmarks?"
        marks.questions[kind] = (question, choices)
        marks.taken += [Taken(find.label, "", question, question=True) for find in finds]
    _choose_frame(marks, box)
    return marks


def _kind(find: LandmarkFind) -> tuple[str, str]:
    """What its labels say, "skull", "skin" or "after", or why it is none of them."""
    labels = set(find.read.points)
    skull = len(labels & (set(SKULL_LANDMARKS) - set(SKIN_LANDMARKS)))
    skin = len(labels & (set(SKIN_LANDMARKS) - set(SKULL_LANDMARKS)))
    if not skull and not skin:
        shown = ", ".join(sorted(labels)[:4])
        return "", f"none of its labels ({shown}, …) is that of a skull or skin landmark"
    if skull >= skin:
        if find.role.is_after:
            return "", "skull landmarks after the operation, which no case uses"
        return "skull", ""
    return ("after" if find.role.is_after else "skin"), ""


def _taken(find: LandmarkFind, kind: str) -> Taken:
    known = SKULL_LANDMARKS if kind == "skull" else SKIN_LANDMARKS
    count = len(set(find.read.points) & set(known))
    why = f"{count} of its {len(find.read.points)} labels are those of {kind} landmarks"
    if kind == "after":
        why = f"skin landmarks, and its name says it is from after the operation ({count} labels)"
    others = [label for label in find.read.points if label not in known]
    if others:
        why += f"; not used: {', '.join(others)}"
    if find.read.unset:
        why += f"; never placed: {', '.join(find.read.unset)}"
    frame = find.read.frame if find.read.stated else ""
    name = "skin landmarks after the operation" if kind == "after" else f"{kind} landmarks"
    why += f"; frame {'stated' if frame else 'not stated'}"
    return Taken(find.label, name, why, "mm", frame)


def _choose_frame(marks: Marks, box: Floats | None) -> None:
    """The frame of landmarks whose file states none, by where they lie."""
    found = (marks.skull, marks.skin, marks.after)
    silent = [find for find in found if find is not None and not find.read.stated]
    if not silent:
        return
    names = ", ".join(find.label for find in silent)
    fits: dict[str, bool] = {}
    for frame in ("LPS", "RAS"):
        # Formats differ in what they mean where they state nothing.
        points = [
            np.array(list(find.read.points.values())) * (1.0 if frame == find.read.frame else TURN)
            for find in silent
        ]
        middle = np.concatenate(points).mean(axis=0)
        fits[frame] = box is not None and bool(((middle >= box[0]) & (middle <= box[1])).all())
    if fits["LPS"] != fits["RAS"]:
        marks.frame = "LPS" if fits["LPS"] else "RAS"
        return
    marks.questions["frame"] = (
        f"{names}: states no frame, and is inside the head's box either way: which frame is it?",
        ('"LPS": x to the patient\'s left, y to the back', '"RAS": x to the right, y to the front'),
    )


# Vertices at which it is asked whether one surface holds another.
SAMPLES = 300


@dataclass(frozen=True)
class Question:
    """A person's decision about a key below [surfaces]; choices: a file or none, with words."""

    key: str
    text: str
    choices: tuple[tuple[SurfaceFind | None, str], ...]


@dataclass
class Anatomy:
    """The surfaces of a case.

    Attributes
    ----------
    skin : SurfaceFind or None
    bones : dict of str to SurfaceFind
        By the name that the case gives them.
    units : str
    frame : str or None
        What the case states; None where every file states its own, or nothing needs to be stated.
    frame_why, units_why : str
    questions : list of Question
        Keys "skin", "units", "frame" of [surfaces], or "bones.NAME".
    after_skin, after_bones
        The same after the operation.
    taken : list of Taken
    """

    skin: SurfaceFind | None = None
    bones: dict[str, SurfaceFind] = field(default_factory=dict)
    units: str = "mm"
    units_why: str = ""
    frame: str | None = None
    frame_why: str = ""
    questions: list[Question] = field(default_factory=list)
    after_skin: SurfaceFind | None = None
    after_bones: dict[str, SurfaceFind] = field(default_factory=dict)
    taken: list[Taken] = field(default_factory=list)

    @property
    def is_complete(self) -> bool:
        """Whether there is a skin, or a question about it, and a bone."""
        asked = {question.key.partition(".")[0] for question in self.questions}
        return (self.skin is not None or "skin" in asked) and (bool(self.bones) or "bones" in asked)

    @property
    def chosen(self) -> list[SurfaceFind]:
        """Skin and bones before the operation."""
        return [*([self.skin] if self.skin else []), *self.bones.values()]

    @property
    def after(self) -> list[SurfaceFind]:
        """Skin and bones after the operation."""
        return [*([self.after_skin] if self.after_skin else []), *self.after_bones.values()]

    def asks(self, key: str) -> Question | None:
        """The question about a key, where there is one."""
        return next((question for question in self.questions if question.key == key), None)

    def placed(self, find: SurfaceFind) -> Floats:
        """The vertices of a surface in LPS mm, as far as unit and frame are known, (v, 3)."""
        frame = find.stated or self.frame or "LPS"
        scale = UNITS.get(self.units, 1.0) * (TURN if frame == "RAS" else np.ones(3))
        return find.surface.vertices * scale
