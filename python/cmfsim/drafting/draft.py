"""A case file drafted from what lies in a folder: what each thing was taken for, and why."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from cmfsim.drafting import motions
from cmfsim.drafting.choices import Anatomy, Text, choose_images, choose_landmarks, legible, quoted
from cmfsim.drafting.finds import Gathered, ImageFind, LandmarkFind, Taken
from cmfsim.drafting.roles import MOVING
from cmfsim.drafting.surfaces import choose_surfaces
from cmfsim.drafting.written import (
    SAME,
    Draft,
    Shown,
    choices_of,
    image_path,
    landmark_path,
    place_after,
    place_before,
    surface_path,
    unaccounted,
)
from cmfsim.io.cases.case_tables import matrix_rows
from cmfsim.values.case_parts import PROCEDURES
from cmfsim.values.motion import carried
from cmfsim.values.proposed_landmarks import ProposedSite

# Middles of the skins before and after that are farther apart are those of two scans, mm.
APART = 20.0
# Questions about what there is after the operation.
AFTER = "postoperative."
CUT = ("[[osteotomies]]", 'procedure = "le_fort_1"', "")
EXAMPLE = """[plan.{name}]
translation = [0, -5, 0]  # mm, LPS: -y is forwards
# or, as 3D Slicer saves it: transform = {{file = "{name}.h5", direction = "from-parent"}}"""

# What the numbers of a typed motion are.
TYPED_UNITS = {
    "translation": "mm, LPS: +x is left, -y forwards, +z up",
    "angle": "degrees",
    "axis": "right-hand rule",
    "centre": "mm: the point that the translation moves",
}


@dataclass
class CaseDraft:
    """A case file that has not been written yet.

    Attributes
    ----------
    text : str
        Of the case file.
    taken : list of Taken
        What each file was taken for.
    questions : list of str
        What a person has to decide before the case can be used.
    files : dict of str to callable
        Functions that write further files, by path; each is called with the path.
    shown : Shown
        Where everything lies, and how it moves, as it was reported.
    """

    text: str = ""
    taken: list[Taken] = field(default_factory=list)
    questions: list[str] = field(default_factory=list)
    files: dict[str, Callable[[Path], None]] = field(default_factory=dict)
    shown: Shown = field(default_factory=Shown)

    def as_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return {
            "found": [taken.as_dict() for taken in self.taken],
            "questions": self.questions,
            "written": sorted(self.files),
        }


def draft_case(
    found: Gathered,
    unpacked: Path,
    name: str,
    typed: motions.TypedPlan | None = None,
    sites: Mapping[str, ProposedSite] = MappingProxyType({}),
) -> CaseDraft:
    """The case file of what was gathered.

    unpacked: Where the files of a bundle lie for now.
    sites: Landmarks of the skull that were found automatically, about which typed motions turn.
    Raises `CaseError`: There is neither a CT, nor a skin with a bone; unsuitable cuts or motions.
    """
    typed = typed or motions.TypedPlan()
    draft = _decide(found, unpacked)
    is_turned = not np.allclose(draft.reference, np.eye(4), rtol=0.0, atol=SAME)
    draft.plan.sites = sites
    motions.add_typed(draft.plan, typed, _bones_of(draft), is_turned=is_turned)
    taken = _taken(draft)
    text = draft.text
    text.comment("Written by cmfsim init. Read every line: each states what a file was taken for.")
    text.comment(
        'A line with "?" must be decided first: until then, cmfsim doctor refuses the case'
    )
    text.comment("and repeats the question. Not a medical device.")
    text.comment()
    for entry in taken:
        mark = "?" if entry.question or not entry.taken_for else entry.taken_for
        text.comment(f"{entry.label}: {mark} ({entry.why})", hang=4)
    text.lines += ["", 'format = "cmfsim-case"', "version = 1", f"name = {quoted(legible(name))}"]
    # Bones after the operation, on which the plan can be measured.
    has_after = bool(draft.anatomy.after_bones) or _uses_image_after(draft)
    achieved = has_after and not draft.plan.motions
    if achieved:
        why = "measured on the post-operative bones, because no plan is given"
        text.value("plan", '"achieved"', why)
    if not draft.by_image:
        _write_surfaces(draft)
    else:
        _write_image(draft)
        if _labelled(draft):
            _write_labelled(draft)
        elif draft.anatomy.skin is not None and draft.anatomy.bones:
            text.lines.append("")
            text.comment("The same head as surfaces, instead of the CT:")
            _write_surfaces(draft, lead="# ")
    _write_landmarks(draft)
    _write_cuts(draft, typed.cuts)
    if not achieved:
        _write_plan(draft, typed.cuts)
    given = draft.marks.skin is not None or draft.marks.questions
    if draft.marks.skull is None and (given or not _shows_skull(draft)):
        text.lines.append("")
        text.comment("Muscles are placed from landmarks of the skull: name their file, and add")
        text.comment("an empty [muscles]. Landmarks are found only where none are given.")
    else:
        text.table("muscles", "the built-in template, placed by the skull landmarks")
    _write_after(draft)
    text.table("output")
    text.value("folder", '"out"')
    for segment, motion in draft.plan.motions.items():
        if motion.shown is not None and not motion.question:
            draft.shown.motions[segment] = motion.shown
    return CaseDraft(str(text), taken, text.questions, draft.files, draft.shown)


def _uses_image_after(draft: Draft) -> bool:
    """Whether the face after the operation is that of a CT: there is no surface of it."""
    anatomy = draft.anatomy
    surfaces = anatomy.after or any(q.key.startswith(AFTER) for q in anatomy.questions)
    return draft.images.after is not None and not surfaces


def _has_any_after(draft: Draft) -> bool:
    """Whether there is anything after the operation."""
    asked = any(question.key.startswith(AFTER) for question in draft.anatomy.questions)
    return bool(draft.anatomy.after) or asked or draft.images.after is not None


def _decide(found: Gathered, unpacked: Path) -> Draft:
    images = choose_images(found.images)
    boxes = [(i.label, i.box) for i in (images.ct,) if i is not None and i.box is not None]
    boxes += [
        (mark.label, np.stack([points.min(axis=0) - 60.0, points.max(axis=0) + 60.0]))
        for mark in found.landmarks
        if mark.read.stated and (points := np.array(list(mark.read.points.values()))).size
    ]
    anatomy = choose_surfaces(found.surfaces, boxes)
    by_image = images.is_there and not (
        anatomy.is_complete and anatomy.skin is not None and _is_cut(anatomy)
    )
    box = boxes[0][1] if boxes and images.ct is not None else None
    if box is None and anatomy.chosen:
        points = np.concatenate([anatomy.placed(find) for find in anatomy.chosen])
        box = np.stack([points.min(axis=0), points.max(axis=0)])
    marks = choose_landmarks(found.landmarks, box)
    reference = np.eye(4)
    if by_image and images.ct is not None:
        reference = images.ct.to_world
    elif anatomy.skin is not None:
        reference = anatomy.skin.to_world
    elif "cranium" in anatomy.bones:
        reference = anatomy.bones["cranium"].to_world
    plan = motions.Plan(anatomy, marks.points)
    if found.scene:
        motions.scene_motions(plan, anatomy.bones, found.loose, reference, in_image=by_image)
    motions.file_motions(plan, found.transforms, by_slicer=found.by_slicer)
    return Draft(found, unpacked, images, anatomy, marks, plan, reference, by_image)


def _is_cut(anatomy: Anatomy) -> bool:
    """Whether the surfaces say more than a CT: pieces that are cut already, or that move."""
    pieces = set(anatomy.bones) - {"cranium", "mandible"}
    return bool(pieces) or any(find.is_moved for find in anatomy.bones.values())


def _taken(draft: Draft) -> list[Taken]:
    """What each file was taken for, those that the case does not use included."""
    surfaces = draft.anatomy.taken
    if draft.by_image:
        surfaces = [_beside_image(draft, taken) for taken in surfaces]
    elif draft.images.is_there:
        draft.images.taken = [
            replace(t, taken_for="not used", why=f"the surfaces are used instead; {t.why}")
            if t.taken_for == "CT"
            else t
            for t in draft.images.taken
        ]
    images, marks = draft.images.taken, draft.marks.taken
    if draft.images.after is not None and not _uses_image_after(draft):
        images = _without(images, draft.images.after, "surfaces after the operation are there")
    if draft.marks.after is not None and not _has_any_after(draft):
        marks = _without(marks, draft.marks.after, "there is no face after the operation")
    others = [
        other
        for other in (*draft.found.others, *draft.plan.others)
        if not other.paths or not set(other.paths) <= set(draft.found.names)
    ]
    others += [
        Taken(draft.found.shown(path), "names of labels", "nnU-Net writes them next to its labels")
        for path in draft.found.names
    ]
    taken = [*images, *surfaces, *marks, *draft.plan.taken, *others]
    return [*taken, *unaccounted(draft.found, draft.plan, taken)]


def _without(taken: list[Taken], find: ImageFind | LandmarkFind, why: str) -> list[Taken]:
    """The entries with that of a file as not used."""
    return [
        replace(t, taken_for="not used", why=f"{why}; {t.why}") if t.label == find.label else t
        for t in taken
    ]


def _beside_image(draft: Draft, taken: Taken) -> Taken:
    if "after the operation" in taken.taken_for or taken.taken_for == "not used":
        return taken
    if taken.taken_for.removeprefix("part of ") in {"cranium", "mandible"} and _labelled(draft):
        return taken
    kept = f"would be the {taken.taken_for}" if taken.taken_for else "not clear what it is"
    ct = draft.images.ct.label if draft.images.ct is not None else "an image"
    why = f"a case has a CT or surfaces, and {ct} is there; {kept}; {taken.why}"
    return replace(taken, taken_for="not used", why=why, question=False)


def _labelled(draft: Draft) -> bool:
    """Whether both bones beside the CT are those of labels: the image's own are not needed."""
    bones = draft.anatomy.bones
    return set(bones) == {"cranium", "mandible"} and all(b.is_made for b in bones.values())


def _write_labelled(draft: Draft) -> None:
    """Adds the bones of labels, which are not segmented in the CT again."""
    draft.text.table("image.bones", "of the labels; the skin is the CT's")
    place = place_before(draft)
    for name, find in draft.anatomy.bones.items():
        draft.text.value(name, quoted(surface_path(draft, find, name, place)))


def _write_image(draft: Draft) -> None:
    text, images = draft.text, draft.images
    text.table("image")
    if images.question is not None:
        text.ask("file", *images.question)
    elif images.ct is not None:
        low, high = images.ct.values
        why = f"{images.ct.words}, {low:g} to {high:g}"
        text.value("file", quoted(image_path(draft, images.ct)), why)
        if images.ct.series is not None:
            text.value("series", quoted(images.ct.series), "the folder holds others as well")
        if not np.allclose(images.ct.to_world, np.eye(4), rtol=0.0, atol=SAME):
            why = "The scene turns this volume; the case is in the volume's own coordinates."
            text.comment(why)
    if images.rescale is not None:
        text.ask("rescale", *images.rescale)
    if images.scale:
        text.comment(images.scale)


def _write_surfaces(draft: Draft, lead: str = "") -> None:
    text, anatomy = Text(), draft.anatomy
    place = place_before(draft)
    text.table("surfaces")
    if (asked := anatomy.asks("skin")) is not None:
        text.ask("skin", asked.text, choices_of(draft, asked, place))
    elif anatomy.skin is not None:
        text.value("skin", quoted(surface_path(draft, anatomy.skin, "skin", place)))
    else:
        text.ask("skin", "no surface that was found is a skin: which file is it?", ())
    if (asked := anatomy.asks("units")) is not None:
        text.ask("units", asked.text, choices_of(draft, asked, place))
    else:
        text.value("units", '"mm"', anatomy.units_why)
    if (asked := anatomy.asks("frame")) is not None:
        text.ask("frame", asked.text, choices_of(draft, asked, place))
    elif place.frame is not None:
        text.value("frame", quoted(place.frame), anatomy.frame_why)
    elif anatomy.frame_why:
        text.comment(f"frame: {anatomy.frame_why}")
    text.table("surfaces.bones")
    for name, find in anatomy.bones.items():
        text.value(name, quoted(surface_path(draft, find, name, place)))
    for question in anatomy.questions:
        part, _, name = question.key.partition(".")
        if part == "bones":
            text.ask(name, question.text, choices_of(draft, question, place))
    if not anatomy.bones and not any(q.key.startswith("bones.") for q in anatomy.questions):
        text.ask("cranium", "no surface that was found is a bone: which file is it?", ())
    draft.text.lines += [f"{lead}{line}".rstrip() for line in text.lines]
    if not lead:
        draft.text.questions += text.questions


def _write_landmarks(draft: Draft) -> None:
    text, marks = draft.text, draft.marks
    if not marks.skull and not marks.skin and not marks.questions:
        text.table("landmarks", "there is no file of landmarks")
        if not _shows_skull(draft):
            text.comment("Cuts by procedures and muscles are placed from those of the skull:")
            why = "skull = ..., skin = ... (.mrk.json). They are not found without a cranium."
            text.comment(why)
            return
        text.value("automatic", "true", "they will be found on bone and skin")
        text.comment('"cmfsim landmarks case.toml" shows them, with the expected error, and')
        text.comment("writes files to correct and name here: skull = ..., skin = ... (.mrk.json).")
        return
    text.table("landmarks")
    for key in ("skull", "skin"):
        find: LandmarkFind | None = getattr(marks, key)
        if key in marks.questions:
            text.ask(key, *marks.questions[key])
        elif find is not None:
            frame = f"{find.read.frame}, stated" if find.read.stated else "frame not stated"
            why = f"{len(find.read.points)} points, {frame}"
            text.value(key, quoted(landmark_path(draft, find, key)), why)
    if "frame" in marks.questions:
        text.ask("frame", *marks.questions["frame"])
    elif marks.frame is not None:
        why = "read this way they are in the head, otherwise not"
        text.value("frame", quoted(marks.frame), why)


def _shows_skull(draft: Draft) -> bool:
    """Whether landmarks of the skull can be found: by a CT, or a cranium as a surface."""
    return draft.by_image or "cranium" in draft.anatomy.bones


def _bones_of(draft: Draft) -> set[str]:
    """The bones of the case before it is cut."""
    return set(draft.anatomy.bones) if not draft.by_image else {"cranium", "mandible"}


def _write_cuts(draft: Draft, cuts: Sequence[str]) -> None:
    """Adds the cuts that were asked for, and those that make what the plan moves."""
    text, plan = draft.text, draft.plan
    bones = _bones_of(draft)
    asked = {q.key.partition(".")[2] for q in draft.anatomy.questions if not draft.by_image}
    needed = {cut: f"it makes {', '.join(PROCEDURES[cut])}" for cut in cuts}
    for name in plan.motions:
        if name in bones | asked:
            continue
        for procedure, segments in PROCEDURES.items():
            if name in segments:
                needed.setdefault(procedure, f"the plan moves {name}, which it cuts")
    for procedure, why in needed.items():
        text.table("[osteotomies]")
        text.value("procedure", quoted(procedure), why)
        if draft.found.scene:
            text.comment("It cuts by landmarks, not where the scene's pieces were cut.")


def _write_plan(draft: Draft, cuts: Sequence[str]) -> None:
    text, plan = draft.text, draft.plan
    if not plan.motions:
        # As a comment: of a piece that is there, or of one that a procedure cuts. A whole mandible
        # does not leave its joints: it is cut first.
        bones = _bones_of(draft).union(*(PROCEDURES[cut] for cut in cuts)) - {"mandible"}
        pieces = [name for name in MOVING if name in bones]
        lines = EXAMPLE.format(name=pieces[0] if pieces else "maxilla").splitlines()
        text.lines += ["", "# No plan was found. To move a segment, state how it moves, such as:"]
        text.lines += [f"# {line}".rstrip() for line in (*(() if pieces else CUT), *lines)]
    for name, motion in plan.motions.items():
        _write_motion(text, name, motion)


def _write_motion(text: Text, name: str, motion: motions.DraftMotion) -> None:
    text.table(f"plan.{name}")
    if motion.words:
        text.comment(f"It {motion.words}.")
    if motion.source:
        text.comment(" ".join(motion.source))
    if motion.question:
        key, value = ("transform", motion.transform) if motion.transform else ("matrix", '"?"')
        text.ask(key, motion.question, motion.choices, value)
    lead = "# " if motion.question else ""
    if motion.typed:
        for key, value in motion.typed.items():
            text.value(key, value, TYPED_UNITS[key])
    elif motion.matrix is not None:
        text.lines += [f"{lead}{row}" for row in matrix_rows(motion.matrix)]
    elif motion.transform and not motion.question:
        text.value("transform", motion.transform)


def _write_place_after(draft: Draft) -> str | None:
    """Unit, frame and place of surfaces after the operation; returns the frame of silent files."""
    text, anatomy = draft.text, draft.anatomy
    silent = [find for find in anatomy.after if find.stated is None]
    if (asked := anatomy.asks("units")) is not None and anatomy.after:
        text.ask("units", asked.text, [words for _, words in asked.choices])
    frame = anatomy.frame
    if silent and (asked := anatomy.asks("frame")) is not None:
        text.ask("frame", asked.text, [words for _, words in asked.choices])
    elif silent and _distance_after(draft, frame or "LPS") >= APART:
        other = "LPS" if frame == "RAS" else "RAS"
        frame = other if _distance_after(draft, other) < APART else frame
    stated = place_after(draft, frame).frame
    if anatomy.after and anatomy.asks("frame") is None and stated is not None:
        text.value("frame", quoted(stated), "so that they are where the skin was before")
    away = _distance_after(draft, frame or "LPS")
    if not np.isfinite(away):
        text.value("aligned", "true", "it is where the head was before; if not, write false")
        return frame
    why = f"the middles of the skins before and after are {away:.0f} mm apart"
    text.value("aligned", "true" if away < APART else "false", why)
    return frame


def _distance_after(draft: Draft, frame: str) -> float:
    """How far the middles of the skins before and after are apart, mm; infinite if not known."""
    anatomy = draft.anatomy
    if anatomy.skin is None or anatomy.after_skin is None or anatomy.asks("units") is not None:
        return float("inf")
    here, there = place_before(draft).matrix(anatomy.skin), place_after(draft, frame).matrix
    before = carried(here, anatomy.placed(anatomy.skin))
    matrix = there(anatomy.after_skin)
    placed = replace(anatomy, frame=frame).placed(anatomy.after_skin)
    after = carried(matrix, placed)
    middles = [0.5 * (points.min(axis=0) + points.max(axis=0)) for points in (before, after)]
    return float(np.linalg.norm(middles[1] - middles[0]))


def _write_after(draft: Draft) -> None:
    text, anatomy, images = draft.text, draft.anatomy, draft.images
    if not _has_any_after(draft):
        return
    text.table("postoperative", "after the operation, by the names of the files")
    if draft.marks.after is not None:
        marks = draft.marks.after
        text.value("landmarks", quoted(landmark_path(draft, marks, "landmarks_after")))
    if images.after is not None and _uses_image_after(draft):
        text.value("image", quoted(image_path(draft, images.after)))
        _write_place_after(draft)
        return
    place = place_after(draft, _write_place_after(draft))
    skin, asked = anatomy.after_skin, anatomy.asks(f"{AFTER}skin")
    if asked is not None:
        text.ask("skin", asked.text, choices_of(draft, asked, place))
    elif skin is not None:
        text.value("skin", quoted(surface_path(draft, skin, "skin_after", place)))
    questions = [q for q in anatomy.questions if q.key.startswith(f"{AFTER}bones.")]
    if anatomy.after_bones or questions:
        text.table("postoperative.bones")
    for name, find in anatomy.after_bones.items():
        text.value(name, quoted(surface_path(draft, find, f"{name}_after", place)))
    for question in questions:
        text.ask(question.key.rpartition(".")[2], question.text, choices_of(draft, question, place))
