"""Markups of 3D Slicer (`.mrk.json`): points with labels, by kind, frame and unit; curves."""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cmfsim.errors import LandmarkInputError
from cmfsim.io.files.reading_writing import MAX_WHOLE, check_readable, parsed_json, replace_text
from cmfsim.values.checks import AnyPath, Floats, as_rows

# What Slicer calls markups whose points follow one another along a line.
CURVE_KINDS = ("Curve", "ClosedCurve", "Line")

# A landmark file above this size is not what it says it is, bytes.
MAX_LANDMARK_TEXT = 16 * 2**20
# Slicer's names of its two frames; the numbers are those of older versions.
FRAME_NAMES: Mapping[str, str] = MappingProxyType(
    {"LPS": "LPS", "1": "LPS", "RAS": "RAS", "0": "RAS"}
)
UNIT_LENGTHS: Mapping[str, float] = MappingProxyType(
    {"mm": 1.0, "cm": 10.0, "m": 1000.0, "um": 0.001}
)
SCHEMA = (
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/"
    "Resources/Schema/markups-schema-v1.0.3.json#"
)


@dataclass(frozen=True, eq=False)
class MarkupPoint:
    """A point of a markup: label, place in LPS mm (None if never placed), description."""

    label: object
    position: Floats | None
    description: str = ""


@dataclass(frozen=True, eq=False)
class Markup:
    """One markup of a file: its kind, its frame where the file states it, its points."""

    kind: str
    frame: str | None
    entries: tuple[MarkupPoint, ...]


def markup_text(path: Path) -> str:
    """The text of a file of landmarks."""
    check_readable(path, LandmarkInputError)
    size = path.stat().st_size
    if size > MAX_LANDMARK_TEXT:
        raise LandmarkInputError(
            f"{path.name}: has {size} bytes, landmarks {MAX_LANDMARK_TEXT} at most"
        )
    try:
        return path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise LandmarkInputError(f"{path.name}: is not UTF-8 text ({error})") from error


def markups_of(text: str, unstated: str) -> list[Markup]:
    """The markups of a JSON text, in LPS mm; `unstated` is the frame of one that states none."""
    try:
        document = parsed_json(text)
    except (ValueError, RecursionError) as error:
        raise LandmarkInputError(f"is not JSON ({error})") from error
    markups = document.get("markups") if isinstance(document, dict) else None
    if not isinstance(markups, list) or not all(isinstance(m, dict) for m in markups):
        raise LandmarkInputError("has no list 'markups': it is not a markups file of 3D Slicer")
    found: list[Markup] = []
    number = 0
    for markup in markups:
        entries = markup.get("controlPoints", [])
        if not isinstance(entries, list):
            raise LandmarkInputError("'controlPoints' is not a list")
        frame = frame_name(markup.get("coordinateSystem"))
        scale = frame_signs(frame or unstated) * _unit_length(markup.get("coordinateUnits", "mm"))
        points: list[MarkupPoint] = []
        for entry in entries:
            number += 1
            if not isinstance(entry, dict):
                raise LandmarkInputError(f"point {number} is not a table of names and values")
            placed = entry.get("positionStatus", "defined") == "defined"
            place = scale * as_position(number, entry.get("position")) if placed else None
            said = entry.get("description")
            points.append(
                MarkupPoint(entry.get("label"), place, said if isinstance(said, str) else "")
            )
        found.append(Markup(str(markup.get("type", "")), frame, tuple(points)))
    return found


def markup_of(
    kind: str, points: Iterable[tuple[str, Floats]], descriptions: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """A markup as Slicer writes it, LPS mm, with a description of each point by label."""
    said = descriptions or {}
    return {
        "type": kind,
        "coordinateSystem": "LPS",
        "coordinateUnits": "mm",
        "controlPoints": [
            {
                "id": str(number),
                "label": label,
                **({"description": said[label]} if label in said else {}),
                "position": position.tolist(),
                "positionStatus": "defined",
            }
            for number, (label, position) in enumerate(points, start=1)
        ],
    }


def write_markups(path: Path, markups: Sequence[Mapping[str, Any]]) -> None:
    """Replaces a `.mrk.json` file in one step."""
    replace_text(path, markups_text(markups))


def markups_text(markups: Sequence[Mapping[str, Any]]) -> str:
    """The text of a `.mrk.json` file."""
    return json.dumps({"@schema": SCHEMA, "markups": markups}, indent=1, allow_nan=False)


def as_position(number: int, position: object) -> Floats:
    """Three finite numbers, or an error with the number of the point."""
    if not isinstance(position, list) or len(position) != 3:
        raise LandmarkInputError(f"point {number} is at {position!r}: three numbers are needed")
    for value in position:
        is_number = isinstance(value, int | float | np.integer | np.floating)
        if isinstance(value, bool) or not is_number:
            raise LandmarkInputError(f"point {number} has the coordinate {value!r}: no number")
        if isinstance(value, int) and abs(value) > MAX_WHOLE:
            raise LandmarkInputError(f"point {number} has a coordinate of more than 308 digits")
        if not math.isfinite(value):
            raise LandmarkInputError(f"point {number} has the coordinate {value}: must be finite")
    return np.array(position, dtype=np.float64)


def frame_name(value: object) -> str | None:
    """The frame, "LPS" or "RAS", for what a file calls it; None where it says nothing."""
    if value is None or value == "":
        return None
    name = FRAME_NAMES.get(str(value))
    if name is None:
        raise LandmarkInputError(f"is in the frame {value!r}: LPS (or 1) and RAS (or 0) are read")
    return name


def frame_signs(frame: str) -> Floats:
    """What coordinates of a frame are multiplied by to be LPS."""
    return np.array([-1.0, -1.0, 1.0] if frame == "RAS" else [1.0, 1.0, 1.0])


def _unit_length(value: object) -> float:
    """The length of a file's unit in mm; Slicer may write [code, scheme, meaning]."""
    name = value[0] if isinstance(value, list) and value else value
    if not isinstance(name, str) or name not in UNIT_LENGTHS:
        known = ", ".join(UNIT_LENGTHS)
        raise LandmarkInputError(f"has coordinateUnits {value!r}: {known} are read")
    return UNIT_LENGTHS[name]


def read_curves(path: AnyPath) -> tuple[Floats, ...]:
    """The curves of a `.mrk.json` file as polylines through their points, (n, 3) each, LPS mm.

    A closed curve ends where it starts. A file that states no frame is read as LPS, as Slicer's
    schema says.
    """
    path = Path(path)
    text = markup_text(path)
    try:
        markups = markups_of(text, "LPS")
        return tuple(_line(markup, number) for number, markup in enumerate(markups, start=1))
    except LandmarkInputError as error:
        raise LandmarkInputError(f"{path.name}: {error}") from error


def write_curves(path: AnyPath, lines: Sequence[ArrayLike]) -> None:
    """Writes polylines as open curves of 3D Slicer, LPS mm; `read_curves` gives them back."""
    path = Path(path)
    markups = []
    for number, line in enumerate(lines, start=1):
        points = as_rows(f"line {number}", line, 3)
        markups.append(markup_of("Curve", ((str(i), p) for i, p in enumerate(points, start=1))))
    write_markups(path, markups)


def _line(markup: Markup, number: int) -> Floats:
    if markup.kind not in CURVE_KINDS:
        known = ", ".join(CURVE_KINDS)
        raise LandmarkInputError(f"markup {number} is a {markup.kind!r}: one of {known} is needed")
    points = [entry.position for entry in markup.entries if entry.position is not None]
    if len(points) < 2:
        raise LandmarkInputError(f"curve {number} has {len(points)} placed points: two are needed")
    if markup.kind == "ClosedCurve":
        points.append(points[0])
    return np.array(points)
