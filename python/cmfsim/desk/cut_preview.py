"""Procedures as the desk shows them: planes on the bone, the pieces, and what can be dragged."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cmfsim.bones.cuts.planes import Cut, CuttingPlane
from cmfsim.bones.cuts.procedures import option_ranges, option_words, place_procedure
from cmfsim.errors import LandmarkError
from cmfsim.values.case_parts import PROCEDURES
from cmfsim.values.checks import Floats

# How far drawn planes reach beyond the bone, mm.
MARGIN = 6.0
# The step of an option by which the way of its plane is measured, and the least way, mm.
STEP, LEAST_WAY = 0.1, 1e-3

Options = Mapping[str, Mapping[str, float]]


def procedure_choices() -> list[dict[str, Any]]:
    """The procedures with segments, and options: default, lowest, highest, and what each states."""
    return [
        {
            "kind": kind,
            "segments": list(segments),
            "options": option_ranges(kind),
            "words": option_words(kind),
        }
        for kind, segments in PROCEDURES.items()
    ]


def cut_preview(
    cuts: Options, landmarks: Mapping[str, Floats], bones: Mapping[str, Floats]
) -> dict[str, Any]:
    """What procedures cut: planes as polygons, pieces as half spaces, handles, and problems.

    cuts: The options of each procedure that differ from its defaults.
    landmarks, bones: Of the skull, (3,), mm, and the vertices of each bone (v, 3), mm.
    """
    shown: dict[str, Any] = {"planes": [], "pieces": [], "handles": [], "problems": []}
    # What every bone that is left was cut from.
    parts = {name: name for name in bones}
    for kind, options in cuts.items():
        try:
            procedure = place_procedure(kind, landmarks, options)
        except LandmarkError as error:
            shown["problems"].append(str(error))
            continue
        shown["problems"] += [finding.what for finding in procedure.findings]
        for cut in procedure.cuts:
            source = next((name for name in cut.sources if name in parts), None)
            if source is None:
                text = f"{kind} cuts {' or '.join(cut.sources)}, which this head does not have"
                shown["problems"].append(text)
                continue
            part, made = parts[source], cut.of(source)
            shown["planes"] += _polygons(made, bones[part], kind)
            groups = [[[*p.normal, -(p.normal @ p.point)] for p in g] for g in made.groups]
            rest = cut.rest or source
            piece = {"name": cut.segment, "part": part, "groups": groups, "rest": rest}
            shown["pieces"].append(piece)
            parts[cut.segment] = part
            if cut.rest:
                parts[cut.rest] = parts.pop(source)
        shown["handles"] += _handles(kind, options, landmarks, procedure.cuts)
    return shown


def _polygons(cut: Cut, bone: Floats, kind: str) -> list[dict[str, Any]]:
    """Each plane as far as it bounds its group, within the box of the bone in there."""
    found = []
    for group in cut.groups:
        inside = np.min([plane.distance(bone) for plane in group], axis=0) >= 0.0
        if not inside.any():
            continue
        box = np.stack([bone[inside].min(axis=0), bone[inside].max(axis=0)])
        walls = [
            CuttingPlane(corner, sign * axis)
            for sign, corner in ((1.0, box[0] - MARGIN), (-1.0, box[1] + MARGIN))
            for axis in np.eye(3)
        ]
        size = float(np.linalg.norm(box[1] - box[0])) + 4.0 * MARGIN
        for plane in group:
            across = np.linalg.svd(plane.normal[None])[2][1:]
            middle = box.mean(axis=0)
            middle = middle - ((middle - plane.point) @ plane.normal) * plane.normal
            corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) @ across
            polygon = middle + size * corners
            for other in (*walls, *(o for o in group if o is not plane)):
                polygon = _clipped(polygon, other)
            if len(polygon):
                points = polygon.round(3).tolist()
                found.append({"kind": kind, "name": plane.name, "points": points})
    return found


def _clipped(polygon: Floats, plane: CuttingPlane) -> Floats:
    """The part of a polygon on the positive side of a plane (Sutherland and Hodgman 1974)."""
    if not len(polygon):
        return polygon
    depth = plane.distance(polygon)
    kept: list[Floats] = []
    for i, point in enumerate(polygon):
        before, last = depth[i - 1], polygon[i - 1]
        if (before < 0.0) != (depth[i] < 0.0):
            kept.append(last + before / (before - depth[i]) * (point - last))
        if depth[i] >= 0.0:
            kept.append(point)
    return np.array(kept).reshape(-1, 3)


def _handles(
    kind: str, options: Mapping[str, float], landmarks: Mapping[str, Floats], cuts: Sequence[Cut]
) -> list[dict[str, Any]]:
    """Where the plane of each option can be taken hold of, and its way for each unit, mm."""
    before = _planes(cuts)
    found = []
    for option, (default, _, highest) in option_ranges(kind).items():
        value = options.get(option, default)
        step = STEP if value + STEP <= highest else -STEP
        moved = _planes(place_procedure(kind, landmarks, {**options, option: value + step}).cuts)
        for one, other in zip(before, moved, strict=True):
            way = (other.point - one.point) / step
            if np.linalg.norm(way) > LEAST_WAY:
                place = {"point": one.point.tolist(), "way": way.tolist()}
                found.append({"kind": kind, "option": option, "name": one.name, **place})
                break
    return found


def _planes(cuts: Sequence[Cut]) -> list[CuttingPlane]:
    return [plane for cut in cuts for group in cut.groups for plane in group]
