"""Whether a drafted case has everything that was found, and reads as what was shown."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cmfsim.drafting.case_lines import Taken
from cmfsim.drafting.gathering import Gathered
from cmfsim.drafting.plans.motions import Plan
from cmfsim.errors import CaseError, CaseInputError, CmfsimError
from cmfsim.io import Case, read_surface
from cmfsim.io.files.reading_writing import toml_module
from cmfsim.io.landmarks.landmark_files import read_landmarks
from cmfsim.io.slicer.transforms import read_transform
from cmfsim.values.checks import Floats
from cmfsim.values.motion import rigid_motion

# What single precision leaves of coordinates of a head, mm, and what a rotation may differ by.
SAME_PLACE, SAME_MOTION = 1e-3, 1e-9
UNDECIDED = "init did not decide about it: please report this"


@dataclass
class Shown:
    """Where everything lies, and how it moves, as a draft reports it.

    Attributes
    ----------
    surfaces : dict of str to (v, 3) float64, mm, LPS
        By the path that the case names.
    landmarks : dict of str to mapping of str to (3,) float64, mm, LPS
        By "skull", "skin" and "landmarks_after".
    motions : dict of str to (4, 4) float64, mm, LPS
        By segment.
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
        known = label in labels or any(name.startswith(f"{label} / ") for name in labels)
        known = (
            known
            or label == found.scene
            or path in paths
            or any(folder in path.parents for folder in folders)
        )
        if not known and path.resolve() not in found.scene_files:
            missing.append(Taken(label, "not used", UNDECIDED))
    for name, below in found.links.items():
        if name in plan.links:
            continue
        why = f"it moves no segment against the head: {', '.join(below)} is under it"
        missing.append(Taken(f"{found.scene}: {name}", "not used", why))
    return missing


def check_written(file: Path, shown: Shown, *, is_open: bool) -> None:
    """Loads a case that was written, and compares it with what was shown.

    Parameters
    ----------
    file : Path
        The case file.
    shown : Shown
    is_open : bool
        Whether questions are left: the case cannot be loaded as a whole, then.

    Raises
    ------
    CaseError
        Something is missing, or lies or moves otherwise.
    CaseInputError
        The case cannot be loaded, although no question is left.
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
