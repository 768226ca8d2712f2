"""What a drafted case names, where that lies, and whether the case reads as what was shown."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from cmfsim.drafting.choices import Anatomy, Images, Marks, Question, Text, quoted
from cmfsim.drafting.finds import (
    EXTRACTED,
    Gathered,
    ImageFind,
    LandmarkFind,
    SurfaceFind,
    Taken,
    unused,
)
from cmfsim.drafting.motions import Plan
from cmfsim.drafting.roles import safe_key
from cmfsim.errors import CaseError, CaseInputError, CmfsimError
from cmfsim.io import Case, read_surface
from cmfsim.io.files.reading_writing import toml_module
from cmfsim.io.landmarks import read_landmarks, write_landmarks
from cmfsim.io.meshes.surfaces import write_surface
from cmfsim.io.slicer.transforms import read_transform
from cmfsim.values.checks import Floats
from cmfsim.values.motion import carried, rigid_motion
from cmfsim.values.surface_data import SurfaceData

# What single precision leaves of coordinates of a head, mm, and what a rotation may differ by.
SAME_PLACE, SAME_MOTION = 1e-3, 1e-9
UNDECIDED = "init did not decide about it: please report this"

# Entries of two transforms that are one differ by less.
SAME = 1e-9


@dataclass
class Shown:
    """Where everything lies, LPS mm, and how it moves, as a draft reports it.

    surfaces: Vertices (v, 3) by the path that the case names.
    landmarks: Points by label, under "skull", "skin" and "landmarks_after".
    motions: (4, 4) by segment.
    """

    surfaces: dict[str, Floats] = field(default_factory=dict)
    landmarks: dict[str, Mapping[str, Floats]] = field(default_factory=dict)
    motions: dict[str, Floats] = field(default_factory=dict)


def unaccounted(found: Gathered, plan: Plan, taken: Sequence[Taken]) -> list[Taken]:
    """Entries for what no other entry is about: a file, or a transform of the scene."""
    labels = {entry.label for entry in taken}
    paths = {path for entry in taken for path in entry.paths}
    folders = {image.path for image in found.images if image.path.is_dir()}
    missing = []
    for path in found.seen:
        label = found.shown(path)
        known = (
            label in {*labels, found.scene}
            or any(name.startswith(f"{label} / ") for name in labels)
            or path in paths
            or any(folder in path.parents for folder in folders)
        )
        if not known and path.resolve() not in found.scene_files:
            missing.append(unused(label, UNDECIDED))
    for name, below in found.links.items():
        if name in plan.links:
            continue
        why = f"it moves no segment against the head: {', '.join(below)} is under it"
        missing.append(unused(f"{found.scene}: {name}", why))
    return missing


def check_written(file: Path, shown: Shown, *, is_open: bool) -> None:
    """Loads a case that was written, and compares it with what was shown.

    is_open: Whether questions are left: the case cannot be loaded as a whole, then.
    Raises `CaseError`: Something is missing, lies or moves otherwise; cannot be loaded.
    """
    if not is_open:
        try:
            Case.load(file)
        except CaseInputError as error:
            raise CaseInputError(f"{error}. Correct the case file that was written") from error
    tables = toml_module().loads(file.read_text(encoding="utf-8"))
    try:
        wrong = [*_surfaces(tables, file.parent, shown), *_landmarks(tables, file.parent, shown)]
        wrong += _motions(tables.get("plan", {}), file.parent, shown)
    except (CmfsimError, OSError) as error:
        wrong = [str(error)]
    if wrong:
        raise CaseError(
            f"{file}: reading the case back gives something else than was shown: "
            f"{'; '.join(wrong[:5])}. Nothing was changed in your files; please report this"
        )


def _surfaces(tables: Mapping[str, Any], folder: Path, shown: Shown) -> Iterator[str]:
    for table in (tables.get("surfaces", {}), tables.get("postoperative", {})):
        options = {key: table[key] for key in ("units", "frame") if key in table}
        names = {**table.get("bones", {}), **({"skin": table["skin"]} if "skin" in table else {})}
        for name, path in names.items():
            there = shown.surfaces.get(path)
            if there is None or "?" in options.values():
                continue
            here = np.asarray(read_surface(folder / path, **options).vertices)
            if here.shape != there.shape:
                yield f"{name} ({path}) has {len(here)} vertices instead of {len(there)}"
            elif (off := float(np.abs(here - there).max())) > SAME_PLACE:
                yield f"{name} ({path}) lies up to {off:.3g} mm elsewhere"


def _landmarks(tables: Mapping[str, Any], folder: Path, shown: Shown) -> Iterator[str]:
    table = tables.get("landmarks", {})
    names = {key: table[key] for key in ("skull", "skin") if key in table}
    if "landmarks" in tables.get("postoperative", {}):
        names["landmarks_after"] = tables["postoperative"]["landmarks"]
    frame = table.get("frame")
    for name, path in names.items():
        there = shown.landmarks.get(name)
        if there is None or "?" in {path, frame}:
            continue
        here = read_landmarks(folder / path, frame=frame)
        for label, point in there.items():
            if label not in here or np.abs(here[label] - point).max() > SAME_PLACE:
                yield f"{label} of the {name} landmarks ({path}) lies elsewhere"


def _motions(plan: Any, folder: Path, shown: Shown) -> Iterator[str]:
    tables = plan if isinstance(plan, dict) else {}
    for name, matrix in shown.motions.items():
        table = tables.get(name, {})
        given = table.get("transform")
        if isinstance(given, dict):
            options = {key: value for key, value in given.items() if key != "file"}
            here = read_transform(folder / given["file"], **options)
        elif "matrix" in table:
            here = np.array(table["matrix"], dtype=np.float64)
        else:
            numbers = ("translation", "angle", "axis", "centre")
            here = rigid_motion(**{key: table[key] for key in numbers if key in table})
        if np.abs(here - matrix).max() > SAME_MOTION:
            yield f"the motion of {name} is another"


@dataclass(frozen=True)
class Place:
    """How the surfaces of a table of the case are placed.

    frame: What the table states; `shown`: that of the files that state none.
    matrix: What carries a surface from its own coordinates to those of the case, LPS mm.
    """

    frame: str | None
    shown: str | None
    matrix: Callable[[SurfaceFind], Floats]


@dataclass
class Draft:
    """What a case is made of, and the text that is made of it."""

    found: Gathered
    unpacked: Path
    images: Images
    anatomy: Anatomy
    marks: Marks
    plan: Plan
    reference: Floats
    by_image: bool
    text: Text = field(default_factory=Text)
    files: dict[str, Callable[[Path], None]] = field(default_factory=dict)
    shown: Shown = field(default_factory=Shown)


def place_before(draft: Draft) -> Place:
    """Where surfaces lie before the operation, and what the case states of their frame."""
    reference = np.eye(4) if draft.by_image else draft.reference
    return _place(draft, draft.anatomy.chosen, draft.anatomy.frame, lambda _: reference)


def place_after(draft: Draft, frame: str | None) -> Place:
    """Where surfaces lie after the operation: a scene shows them there."""
    back = np.linalg.inv(draft.reference) if draft.by_image else np.eye(4)
    return _place(draft, draft.anatomy.after, frame, lambda find: back @ find.to_world)


def _place(
    draft: Draft,
    finds: Sequence[SurfaceFind],
    frame: str | None,
    matrix: Callable[[SurfaceFind], Floats],
) -> Place:
    """What a table of surfaces states of their frame: files that are written state LPS in vain."""
    place = Place(None, frame, lambda find: matrix(find) if find.in_scene else np.eye(4))
    as_they_are = not any(_is_packed(draft, find, place) for find in finds)
    frames = {find.stated or frame for find in finds if find.is_silent}
    one_frame = len(frames) == 1 and all(find.is_silent for find in finds)
    if as_they_are and one_frame and frames == {"RAS"}:
        return replace(place, frame="RAS")
    return replace(place, frame="LPS" if frame == "LPS" else None)


def _is_packed(draft: Draft, find: SurfaceFind, place: Place) -> bool:
    """Whether a surface has no file of its own where the case lies: packed, voxels, or moved."""
    moved = not np.allclose(place.matrix(find), np.eye(4), rtol=0.0, atol=SAME)
    return moved or find.path.is_relative_to(draft.unpacked) or find.is_made


def surface_path(draft: Draft, find: SurfaceFind, name: str, place: Place) -> str:
    """The path of a surface in the case; a copy in LPS mm where its file alone would not do."""
    true = find.stated or place.shown or "LPS"
    matrix, flip = place.matrix(find), [-1.0, -1.0, 1.0] if true == "RAS" else [1.0, 1.0, 1.0]
    known = draft.anatomy.asks("units") is None
    vertices = carried(matrix, find.surface.vertices * flip)
    reads_as = place.frame or ("LPS" if find.is_silent else find.stated)
    if not _is_packed(draft, find, place) and (true == reads_as or not known):
        path = draft.found.shown(find.path)
    elif not known:
        raise CaseInputError(
            f"{find.label} is {find.extent.max():.4g} long: a scene of 3D Slicer is in mm, so its "
            "transforms do not fit this surface: scale it to mm, and save the scene again"
        )
    else:
        path = f"{EXTRACTED}/{name}.ply"
        surface = SurfaceData(vertices, find.surface.triangles)
        if not draft.by_image or find.role.is_after or find.is_made:
            draft.files[path] = lambda target: write_surface(target, surface)
    if known and (draft.anatomy.asks("frame") is None or not find.is_silent):
        draft.shown.surfaces[path] = vertices
    return path


def _candidate_path(draft: Draft, find: SurfaceFind, place: Place) -> str:
    tail = find.label.rpartition(": ")[2].rpartition(" / ")[2].rpartition("/")[2]
    name = safe_key(tail.partition(".")[0] if find.is_made else tail)
    taken = {path for path in draft.files if path.startswith(f"{EXTRACTED}/{name}")}
    return surface_path(draft, find, f"{name}_{len(taken) + 1}" if taken else name, place)


def choices_of(draft: Draft, question: Question, place: Place) -> list[str]:
    """What may be written for a question; a surface of a scene gets a file, so that it can be."""
    return [
        words if find is None else f"{quoted(_candidate_path(draft, find, place))}: {words}"
        for find, words in question.choices
    ]


def landmark_path(draft: Draft, find: LandmarkFind, key: str) -> str:
    """The path of landmarks in the case; where they lie before the operation."""
    matrix = _marks_matrix(draft, find)
    points = {
        label: matrix[:3, :3] @ point + matrix[:3, 3]
        for label, point in draft.marks.placed(find).items()
    }
    if "frame" not in draft.marks.questions or find.read.stated:
        draft.shown.landmarks[key] = points
    apart = not np.allclose(matrix, np.eye(4), rtol=0.0, atol=SAME)
    if not apart and not find.path.is_relative_to(draft.unpacked):
        return draft.found.shown(find.path)
    name = f"{EXTRACTED}/{key}.mrk.json"
    draft.files[name] = lambda path: write_landmarks(path, points)
    return name


def _marks_matrix(draft: Draft, find: LandmarkFind) -> Floats:
    """What carries landmarks of a scene to where they lie before the operation in the case."""
    if not find.in_scene:
        return np.eye(4)
    # A list under a segment's transform goes with the segment; before, it lies with the head.
    moved = [bone for bone in draft.anatomy.bones.values() if bone.chain and bone.is_moved]
    with_bone = any(bone.chain == find.chain for bone in moved) or bool(
        set(find.chain) & draft.plan.links
    )
    matrix = draft.reference if with_bone else find.to_world
    return np.linalg.inv(draft.reference) @ matrix if draft.by_image else matrix


def image_path(draft: Draft, image: ImageFind) -> str:
    """The path of a CT; that of a bundle is copied next to the case."""
    if not image.path.is_relative_to(draft.unpacked):
        return "." if image.path == draft.found.folder else draft.found.shown(image.path)
    name = f"{EXTRACTED}/{safe_key(image.path.name.partition('.')[0])}"
    name += "".join(image.path.suffixes[-2:]) if image.path.suffix == ".gz" else image.path.suffix
    data = image.path.read_bytes()

    def keep(path: Path) -> None:
        path.write_bytes(data)

    draft.files[name] = keep
    return name
