"""Surfaces of teeth: each row belongs to its jaw."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from cmfsim.drafting.case_lines import Taken
from cmfsim.drafting.finds import SurfaceFind
from cmfsim.drafting.roles import JAWS_OF_TEETH, safe_key
from cmfsim.drafting.surfaces.anatomy import SAMPLES, Anatomy, Question
from cmfsim.meshing.levels import signed_level
from cmfsim.surfaces.levels import surface_of_level
from cmfsim.values.checks import Floats
from cmfsim.values.image_data import ImageData
from cmfsim.values.surface_data import SurfaceData

# Rows of teeth, by what names say.
ROWS = ("teeth", *JAWS_OF_TEETH)
# Teeth are those of the nearer jaw where its distance is below this part of the other's.
NEARER = 0.5
# Voxels along the longest side of a jaw that its teeth are added to, and the least of them, mm.
VOXELS_OF_JAW, LEAST_VOXEL = 250.0, 0.5


def add_teeth(anatomy: Anatomy, teeth: SurfaceFind) -> None:
    """Adds a surface of teeth to that of its jaw; asks where it is not clear which one that is."""
    jaw = _jaw_of(anatomy, teeth)
    if jaw is not None:
        find = anatomy.bones[jaw]
        joined = replace(
            find,
            surface=_union(anatomy.placed(find), find, anatomy.placed(teeth), teeth),
            stated="LPS",
            is_made=True,
            joined=(*find.joined, teeth.label),
        )
        anatomy.bones[jaw] = joined
        return
    text = (
        f"{teeth.label}: which bone do these teeth belong to? They move with their jaw, and lips "
        "and cheeks lie on them"
    )
    choices = (
        (None, "join them with their jaw in the program that made them, and run init again; or"),
        (None, "remove this line: the jaw is used without them"),
    )
    key = safe_key(teeth.label.rpartition("/")[2].rpartition(": ")[2].partition(".")[0])
    anatomy.questions.append(Question(f"bones.{key}", text, choices))
    anatomy.taken.append(Taken(teeth.label, "", text, question=True))


def report_joined(anatomy: Anatomy, found: Iterable[SurfaceFind]) -> None:
    """Teeth that went with their jaw: they are used where that is."""
    finds = {id(find): find for find in (*found, *anatomy.bones.values())}
    status = {taken.label: taken for taken in anatomy.taken}
    done = set(status)
    for find in finds.values():
        jaw = status.get(find.label)
        for label in find.joined:
            if jaw is None or label in done:
                continue
            done.add(label)
            if jaw.question or jaw.taken_for in {"", "not used"}:
                anatomy.taken.append(replace(jaw, label=label, why=f"as {jaw.label}: {jaw.why}"))
                continue
            why = f"teeth belong to their jaw: they are in the surface of {find.label}"
            anatomy.taken.append(Taken(label, f"part of {jaw.taken_for}", why, "mm", "LPS"))


def _jaw_of(anatomy: Anatomy, teeth: SurfaceFind) -> str | None:
    """The bone of the case that a row of teeth belongs to; None where that is not clear."""
    if anatomy.asks("units") is not None or anatomy.asks("frame") is not None:
        return None
    found: dict[str, str] = {}
    for row, parts in JAWS_OF_TEETH.items():
        # A jaw of which it is asked which surface it is may be the one.
        open_parts = [part for part in parts if anatomy.asks(f"bones.{part}") is not None]
        names = {find.role.part: name for name, find in anatomy.bones.items()}
        first = next((part for part in parts if part in names or part in open_parts), "")
        if first in names and np.array_equal(anatomy.bones[names[first]].to_world, teeth.to_world):
            found[row] = names[first]
    if teeth.role.part in JAWS_OF_TEETH:
        return found.get(teeth.role.part)
    if len(found) < len(JAWS_OF_TEETH):
        return None
    points = anatomy.placed(teeth)
    points = points[:: max(1, len(points) // SAMPLES)]
    away = {}
    for name in found.values():
        bone = anatomy.bones[name]
        closest, _, _ = SurfaceData(anatomy.placed(bone), bone.surface.triangles).searched.closest(
            points
        )
        away[name] = float(np.quantile(np.linalg.norm(closest - points, axis=1), 0.9))
    near, far = sorted(away, key=away.__getitem__) if len(away) == 2 else ("", "")
    return near if near and away[near] < NEARER * away[far] else None


def _union(jaw: Floats, its: SurfaceFind, teeth: Floats, their: SurfaceFind) -> SurfaceData:
    """The surface of a jaw and its teeth, LPS mm: repairs would drop single teeth as debris."""
    points = np.concatenate([jaw, teeth])
    step = max(LEAST_VOXEL, float(np.ptp(jaw, axis=0).max()) / VOXELS_OF_JAW)
    lowest = points.min(axis=0) - 3.0 * step
    shape = np.ceil((points.max(axis=0) + 3.0 * step - lowest) / step).astype(int)
    grid = ImageData(np.broadcast_to(np.float32(0.0), tuple(shape)), (step, step, step), lowest)
    levels = [
        signed_level(SurfaceData(vertices, find.surface.triangles), grid).values
        for vertices, find in ((jaw, its), (teeth, their))
    ]
    return surface_of_level(its.label, grid.with_values(np.maximum(*levels)))
