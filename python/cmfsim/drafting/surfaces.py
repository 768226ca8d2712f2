"""The surfaces of a case, their unit and frame, with the reasons; teeth go to their bones."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from cmfsim.drafting.choices import SAMPLES, TURN, Anatomy, Question
from cmfsim.drafting.finds import SurfaceFind, Taken, unused
from cmfsim.drafting.roles import JAWS_OF_TEETH, MOVING, safe_key
from cmfsim.meshing.levels import signed_level
from cmfsim.surfaces.depth import distances
from cmfsim.surfaces.levels import surface_of_level
from cmfsim.values.case_parts import SKIN_EXTENT, UNITS
from cmfsim.values.checks import Floats
from cmfsim.values.image_data import ImageData
from cmfsim.values.surface_data import SurfaceData

# Rows of teeth, by what names say.
ROWS = ("teeth", *JAWS_OF_TEETH)
# Teeth are those of the nearer jaw where its distance is below this part of the other's.
NEARER = 0.5
# Voxels along the longest side of a jaw that its teeth are added to, and the least of them, mm.
VOXELS_OF_JAW, LEAST_VOXEL = 250.0, 0.5
# Longest extent of bones, mm.
BONE_EXTENT = (15.0, 320.0)
# Share of a piece in a bone from which on it is part of it, and distance that counts as in it, mm.
PART_SHARE, NEAR = 0.8, 0.6
# The jaw's middle lies so far in front of the cranium's, mm, for this to tell the frame.
IN_FRONT = 5.0
# A ramus that lies so far beyond the middle, mm, is on the other side.
OFF_MIDDLE = 5.0
PIECES_OF = {
    "mandible": ("mandible_body", "ramus_left", "ramus_right", "chin"),
    "cranium": ("maxilla", "midface"),
}


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
        placed = SurfaceData(anatomy.placed(bone), bone.surface.triangles)
        away[name] = float(np.quantile(distances(points, placed.searched), 0.9))
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


def choose_surfaces(
    found: Sequence[SurfaceFind], boxes: Sequence[tuple[str, Floats]] = ()
) -> Anatomy:
    """Skin and bones among surfaces; what is not clear becomes a question.

    boxes: sequence of (str, (2, 3)). What certainly lies in LPS mm, with its corners.
    """
    anatomy = Anatomy()
    before = [find for find in found if not find.role.is_after]
    parts = _by_part(anatomy, before)
    teeth = [find for row in ROWS for find in parts.pop(row, [])]
    _choose_skin(anatomy, parts)
    _choose_bones(anatomy, parts)
    _check_pieces(anatomy)
    _choose_units(anatomy)
    _choose_frame(anatomy, boxes)
    _check_sides(anatomy)
    for row in teeth:
        add_teeth(anatomy, row)
    _choose_after(anatomy, [find for find in found if find.role.is_after])
    _report(anatomy)
    report_joined(anatomy, found)
    return anatomy


def _by_part(anatomy: Anatomy, found: Iterable[SurfaceFind]) -> dict[str, list[SurfaceFind]]:
    parts: dict[str, list[SurfaceFind]] = {}
    for find in found:
        if find.role.part == "other":
            why = f"its name contains {find.role.word!r}, which is not a bone of a case"
            anatomy.taken.append(unused(find.label, why))
        else:
            parts.setdefault(find.role.part, []).append(find)
    return parts


def _choose_skin(anatomy: Anatomy, parts: dict[str, list[SurfaceFind]]) -> None:
    named = parts.pop("skin", [])
    if not named:
        unnamed = parts.get("", [])
        others = [find for finds in parts.values() for find in finds]
        around = [find for find in unnamed if len(others) > 1 and _encloses(find, others)]
        if len(around) == 1:
            unnamed.remove(around[0])
            anatomy.skin = around[0]
            why = "it encloses every other surface"
            anatomy.taken.append(Taken(around[0].label, "skin", why))
            return
    if len(named) == 1:
        anatomy.skin = named[0]
    elif named:
        _ask_which(anatomy, "skin", named)


def _encloses(outer: SurfaceFind, others: Sequence[SurfaceFind]) -> bool:
    """Whether the box of a surface holds the boxes of all others."""
    points = outer.surface.vertices
    low, high = points.min(axis=0), points.max(axis=0)
    for find in others:
        inner = find.surface.vertices
        if find is not outer and ((inner.min(axis=0) < low) | (inner.max(axis=0) > high)).any():
            return False
    return True


def _choose_bones(anatomy: Anatomy, parts: dict[str, list[SurfaceFind]]) -> None:
    whole = parts.pop("bone", [])
    unnamed = parts.pop("", [])
    if whole and "cranium" not in parts:
        parts["cranium"] = whole
        whole = []
    for find in whole:
        why = (
            "the bones are given separately; according to its name, this file contains all of them"
        )
        anatomy.taken.append(unused(find.label, why))
    for part in ("cranium", *MOVING):
        named = _moved_alone(anatomy, parts.get(part, []))
        if len(named) == 1:
            anatomy.bones[part] = named[0]
        elif named:
            _ask_which(anatomy, f"bones.{part}", named)
    for find in unnamed:
        key = safe_key(find.label.rpartition("/")[2].rpartition(": ")[2].partition(".")[0])
        text = f"{find.label} ({_shape(find)}): which bone is it?"
        known = ", ".join(("cranium", *MOVING))
        choices = (
            (find, "if it is a bone of the case: rename the key, too,"),
            (None, f"to one of {known}, or to a name of your own; or remove the line"),
        )
        anatomy.questions.append(Question(f"bones.{key}", text, choices))
        anatomy.taken.append(Taken(find.label, "", text, question=True))


def _moved_alone(anatomy: Anatomy, named: Sequence[SurfaceFind]) -> Sequence[SurfaceFind]:
    """Of several surfaces of a part, the only one that its scene moves, if there is one."""
    moved = [find for find in named if find.is_moved]
    if len(named) < 2 or len(moved) != 1 or any(find.chain for find in named if not find.is_moved):
        return named
    for find in named:
        if find is not moved[0]:
            why = f"the scene moves {moved[0].label}, which is the same part, and not this one"
            anatomy.taken.append(unused(find.label, why))
    return moved


def _ask_which(anatomy: Anatomy, key: str, finds: Sequence[SurfaceFind]) -> None:
    part = key.rpartition(".")[2]
    names = " or ".join(find.label for find in finds)
    choices = tuple((find, _shape(find)) for find in finds)
    anatomy.questions.append(Question(key, f"{names}: which one is it?", choices))
    for find in finds:
        why = f"{len(finds)} surfaces are called {part}; this one is {_shape(find)}"
        anatomy.taken.append(Taken(find.label, "", why, question=True))


def _check_pieces(anatomy: Anatomy) -> None:
    """Asks about a bone that is there twice: whole, and as the piece that was cut from it."""
    for whole_name, names in PIECES_OF.items():
        whole = anatomy.bones.get(whole_name)
        pieces = {n: anatomy.bones[n] for n in names if n in anatomy.bones}
        if whole is None or not pieces:
            continue
        inside = {n: share for n, p in pieces.items() if (share := _share(p, whole)) > PART_SHARE}
        if not inside:
            continue
        rami = {"ramus_left", "ramus_right"} & set(inside)
        if whole_name == "mandible" and "mandible_body" in inside and rami and not whole.is_moved:
            del anatomy.bones[whole_name]
            why = f"it is the bone before it was cut: {', '.join(inside)} lie in it"
            anatomy.taken.append(unused(whole.label, why))
            continue
        name, share = max(inside.items(), key=lambda entry: entry[1])
        piece = anatomy.bones.pop(name)
        text = (
            f"{piece.label} lies in {whole.label} ({share:.0%} of it): the bone would be in the "
            "case twice. Which is right?"
        )
        cut = {"maxilla": "le_fort_1", "midface": "le_fort_3", "chin": "genioplasty"}
        procedure = cut.get(name, "bsso")
        choices = (
            (piece, f"if {whole_name} is replaced by the bone without it; or remove this line"),
            (None, f'and add [[osteotomies]] with procedure = "{procedure}": cmfsim cuts it'),
        )
        anatomy.questions.append(Question(f"bones.{name}", text, choices))
        anatomy.taken.append(Taken(piece.label, "", text, question=True))


def _share(piece: SurfaceFind, whole: SurfaceFind) -> float:
    """The share of a piece's vertices that lie in or on a bone."""
    if (piece.stated or "LPS") != (whole.stated or "LPS"):
        return 0.0
    points = piece.surface.vertices
    points = np.ascontiguousarray(points[:: max(1, len(points) // SAMPLES)], dtype=np.float64)
    index = whole.surface.searched
    near = distances(points, index) < NEAR * whole.extent.max() / 150.0
    inside = index.winding_number(points) > 0.5
    return float((near | inside).mean())


def _choose_units(anatomy: Anatomy) -> None:
    """The unit by the size of the skin, or of the largest bone."""
    if not anatomy.chosen:
        return
    judged = anatomy.skin or max(anatomy.bones.values(), key=lambda find: find.extent.max())
    low, high = SKIN_EXTENT if judged is anatomy.skin else BONE_EXTENT
    size = float(judged.extent.max())
    long = f"{judged.label} is {size:.4g} long"
    if low <= size <= high:
        what = "a skin has" if judged is anatomy.skin else "bones have"
        anatomy.units_why = f"{long}, as {what} it in mm"
        return
    fitting = [unit for unit, length in UNITS.items() if low <= size * length <= high]
    choices = tuple(
        (None, f'"{unit}": then it is {size * UNITS[unit]:.0f} mm long') for unit in fitting
    )
    none = ((None, "none of mm, cm, m, um and inch fits: export the surfaces in mm"),)
    text = f"{long}, and in mm {low:.0f} to {high:.0f} is usual: which unit is it?"
    anatomy.questions.append(Question("units", text, choices or none))
    if len(fitting) == 1:
        # To go on with: distances and directions are in mm from here on.
        anatomy.units = fitting[0]


def _choose_frame(anatomy: Anatomy, boxes: Sequence[tuple[str, Floats]]) -> None:
    """The frame of the files: as they state it, else as what lies in them shows it."""
    chosen = anatomy.chosen
    silent = [find for find in chosen if find.stated is None]
    stated = sorted({find.stated for find in chosen if find.stated is not None})
    if not silent:
        anatomy.frame_why = f"stated by each file, its scene or its labels: {' and '.join(stated)}"
        return
    names = ", ".join(find.label for find in silent[:4]) + (", …" if len(silent) > 4 else "")
    frame, why = _shown_frame(anatomy, silent, boxes)
    if frame is None:
        text = f"{names}: no frame is stated, and {why}. Is x to the left or to the right?"
        choices = (
            (None, '"LPS": x to the left, y to the back (3D Slicer since 2020, ITK)'),
            (None, '"RAS": x to the right, y to the front (older Slicer, FreeSurfer)'),
        )
        anatomy.questions.append(Question("frame", text, choices))
        return
    anatomy.frame = None if frame == "LPS" and stated else frame
    anatomy.frame_why = f"{names}: none is stated; {why}"


def _shown_frame(
    anatomy: Anatomy, silent: Sequence[SurfaceFind], boxes: Sequence[tuple[str, Floats]]
) -> tuple[str | None, str]:
    """The frame that the places of things show, and how; None where they show none."""
    unit = UNITS[anatomy.units]
    points = np.concatenate([find.surface.vertices for find in silent]) * unit
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    others = [
        (find.label, find.surface.vertices * unit * (TURN if f == "RAS" else 1.0))
        for find in anatomy.chosen
        if (f := find.stated) is not None
    ]
    certain = [*boxes, *((name, np.stack([p.min(axis=0), p.max(axis=0)])) for name, p in others)]
    for name, box in certain:
        fits = {
            frame: bool(((middle * signs >= box[0]) & (middle * signs <= box[1])).all())
            for frame, signs in (("LPS", np.ones(3)), ("RAS", TURN))
        }
        if fits["LPS"] != fits["RAS"]:
            frame = "LPS" if fits["LPS"] else "RAS"
            return frame, f"read as {frame} they are where {name} is, otherwise elsewhere"
    cranium = anatomy.bones.get("cranium")
    for name in ("mandible", "mandible_body", "maxilla", "chin"):
        jaw = anatomy.bones.get(name)
        if cranium in silent and jaw in silent and cranium is not None and jaw is not None:
            ahead = (jaw.surface.vertices.mean(axis=0) - cranium.surface.vertices.mean(axis=0))[1]
            ahead = unit * float(ahead)
            if abs(ahead) > IN_FRONT:
                frame = "LPS" if ahead < 0.0 else "RAS"
                return frame, (
                    f"read as {frame} {name} lies {abs(ahead):.0f} mm in front of the cranium's "
                    "middle, and otherwise behind it"
                )
    return None, "nothing in the files shows it"


def _check_sides(anatomy: Anatomy) -> None:
    """Asks about a left ramus that lies on the right, or the other way round."""
    if anatomy.asks("frame") is not None or anatomy.asks("units") is not None:
        return
    rami = {n: anatomy.bones[n] for n in ("ramus_left", "ramus_right") if n in anatomy.bones}
    middles = {name: float(anatomy.placed(find)[:, 0].mean()) for name, find in rami.items()}
    if len(rami) == 2:
        middle = 0.5 * sum(middles.values())
    else:
        rest = [find for name, find in anatomy.bones.items() if name not in rami]
        whole = anatomy.skin or next(iter(rest), None)
        if whole is None or not rami:
            return
        middle = float(np.ptp(anatomy.placed(whole)[:, 0])) / 2.0
        middle += float(anatomy.placed(whole)[:, 0].min())
    for name, x in middles.items():
        side, other = ("left", "right") if name == "ramus_left" else ("right", "left")
        away = (x - middle) * (1.0 if side == "left" else -1.0)
        if away > -OFF_MIDDLE:
            continue
        find = anatomy.bones.pop(name)
        text = (
            f"{find.label}: by its name it is the {side} ramus, but it lies {-away:.0f} mm to the "
            f"patient's {other}: are the names exchanged, or is the frame wrong?"
        )
        choices = [(f, "if the names are exchanged") for f in rami.values() if f is not find]
        choices.append((find, "if its name is right: the head is a mirror image, then"))
        anatomy.questions.append(Question(f"bones.{name}", text, tuple(choices)))
        anatomy.taken.append(Taken(find.label, "", text, question=True))


def _choose_after(anatomy: Anatomy, found: Sequence[SurfaceFind]) -> None:
    parts: dict[str, list[SurfaceFind]] = {}
    for find in found:
        part = find.role.part
        if part in ("skin", "cranium", *MOVING):
            parts.setdefault(part, []).append(find)
        elif part == "" and anatomy.skin is not None:
            ratio = float(find.extent.max() / anatomy.skin.extent.max())
            if 0.5 < ratio < 2.0:
                parts.setdefault("skin", []).append(find)
                continue
            anatomy.taken.append(unused(find.label, "after the operation; which part?"))
        else:
            why = f"{find.role.part or 'a part that its name does not say'} after the operation"
            anatomy.taken.append(unused(find.label, f"{why}, which no case uses"))
    for part, finds in parts.items():
        if len(finds) > 1:
            key = "skin" if part == "skin" else f"bones.{part}"
            _ask_which(anatomy, f"postoperative.{key}", finds)
        elif part == "skin":
            anatomy.after_skin = finds[0]
        else:
            anatomy.after_bones[part] = finds[0]


def _report(anatomy: Anatomy) -> None:
    """What each surface that is used was taken for."""
    used = {"skin": anatomy.skin, **anatomy.bones}
    done = {taken.label for taken in anatomy.taken}
    for part, find in used.items():
        if find is None or find.label in done:
            continue
        frame = find.stated or anatomy.frame or "LPS"
        unit = "" if anatomy.asks("units") else anatomy.units
        why = f"its name contains {find.role.word!r}; {_shape(find, unit)}"
        if find.role.part == "bone":
            why += "; a jaw that is part of it cannot move separately"
        asked = anatomy.asks("frame") is not None and find.stated is None
        anatomy.taken.append(Taken(find.label, part, why, unit, "" if asked else frame))
    after = {"skin": anatomy.after_skin, **anatomy.after_bones}
    for part, find in after.items():
        if find is not None:
            why = f"its name contains {find.role.word or 'after'!r}, after the operation"
            what = f"{part} after the operation"
            anatomy.taken.append(Taken(find.label, what, why, "mm", find.stated or "LPS"))


def _shape(find: SurfaceFind, unit: str = "") -> str:
    size = " × ".join(f"{length:.3g}" for length in find.extent)
    closed = "closed" if find.is_closed else "open"
    count = len(find.surface.triangles)
    unit = unit or ("mm" if find.is_made else "in its own unit")
    return f"{size} {unit}, {count} triangles, {closed}"
