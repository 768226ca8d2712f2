"""The choice of the pre-operative CT, and of the landmarks of skull and skin."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from cmfsim.drafting.case_lines import Taken
from cmfsim.drafting.finds import HU_AIR, ImageFind, LandmarkFind
from cmfsim.values.checks import Floats
from cmfsim.values.landmark_sites import SKIN_LANDMARKS, SKULL_LANDMARKS

# LPS to RAS, and back.
TURN = np.array([-1.0, -1.0, 1.0])
# What stored values are when an offset of 1024 was added to HU.
OFFSET_RANGE = (1500.0, 5000.0)


@dataclass
class Images:
    """The CT of a case, the one after the operation, and what was noticed.

    question: Which of several images is the CT, with the choices.
    rescale: The question what takes the values to HU.
    scale: What does, where that is clear.
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
        other = _no_ct(find)
        if other:
            images.taken.append(Taken(find.label, "not used", other))
        elif not find.role.is_after:
            before.append(find)
        elif images.after is None:
            images.after = find
            images.taken.append(
                Taken(find.label, "CT after the operation", f"by its name; {_said(find)}", "", "")
            )
        else:
            images.taken.append(Taken(find.label, "not used", "a second CT after the operation"))
    if len(before) == 1:
        images.ct = before[0]
        _check_values(images, before[0])
    elif before:
        names = " or ".join(find.label for find in before)
        choices = tuple(_choice(find) for find in before)
        images.question = (f"{names}: which one is before the operation?", choices)
        images.taken += [
            Taken(find.label, "", images.question[0], question=True) for find in before
        ]
    return images


def _choice(find: ImageFind) -> str:
    """What may be written for an image, and what it is."""
    path = find.label.removesuffix(f" (series {find.series})")
    series = "" if find.series is None else f' with series = "{find.series}" on a line of its own'
    return f'"{path}"{series}: {_said(find)}'


def _no_ct(find: ImageFind) -> str:
    """Why an image is no CT of the case; empty if it may be."""
    if find.error:
        return f"cannot be read: {find.error}"
    if find.modality not in {"", "CT"}:
        return f"its header says {find.modality}, which is not a CT"
    return ""


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
        offset = OFFSET_RANGE[0] <= high <= OFFSET_RANGE[1]
        images.rescale = (
            f"values are {low:g} to {high:g}: a CT in HU has air at -1000. How do they become HU?",
            (
                "[1, -1024], if 1024 was added to HU"
                + (", as this range suggests" if offset else ""),
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
    """The landmarks of a case.

    frame: What the case states for files that state none.
    questions: By key of [landmarks].
    """

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
            marks.taken.append(Taken(find.label, "not used", why))
        else:
            kinds.setdefault(kind, []).append(find)
    for kind, finds in kinds.items():
        if len(finds) == 1 or kind == "after":
            setattr(marks, kind, finds[0])
            marks.taken += [_taken(find, kind) for find in finds[:1]]
            marks.taken += [
                Taken(find.label, "not used", f"a second set of landmarks ({kind})")
                for find in finds[1:]
            ]
            continue
        names = " or ".join(find.label for find in finds)
        choices = tuple(f'"{find.label}": {len(find.read.points)} points' for find in finds)
        marks.questions[kind] = (f"{names}: which are the {kind} landmarks?", choices)
        marks.taken += [
            Taken(find.label, "", marks.questions[kind][0], question=True) for find in finds
        ]
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
    return Taken(
        find.label, name, f"{why}; frame {'stated' if frame else 'not stated'}", "mm", frame
    )


def _choose_frame(marks: Marks, box: Floats | None) -> None:
    """The frame of landmarks whose file states none, by where they lie."""
    silent = [
        find
        for find in (marks.skull, marks.skin, marks.after)
        if find is not None and not find.read.stated
    ]
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
