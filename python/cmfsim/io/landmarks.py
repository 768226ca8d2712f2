"""Landmarks of 3D Slicer: `.mrk.json` and `.fcsv`, read into LPS mm, and written as `.mrk.json`.

A file that does not state its frame is never guessed at in silence: it is taken as its format says,
and a finding says so.
"""

import csv
import json
import logging
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from cmfsim.case import Finding
from cmfsim.checks import Floats, check_one_of
from cmfsim.errors import LandmarkInputError
from cmfsim.io.files import refuse_constant, replacing

__all__ = ["LandmarkFile", "read_landmark_file", "read_landmarks", "write_landmarks"]

# A landmark file above this size is not what it says it is, bytes.
MAX_LANDMARK_TEXT = 16 * 2**20
# Slicer's names of its two frames; the numbers are those of older versions.
FRAME_NAMES: Mapping[str, str] = MappingProxyType(
    {"LPS": "LPS", "1": "LPS", "RAS": "RAS", "0": "RAS"}
)
# What each format means where it does not say: Slicer's markups schema, and its fiducial reader.
UNSTATED: Mapping[str, str] = MappingProxyType({".json": "LPS", ".fcsv": "RAS"})
UNIT_LENGTHS: Mapping[str, float] = MappingProxyType(
    {"mm": 1.0, "cm": 10.0, "m": 1000.0, "um": 0.001}
)
# Columns of a `.fcsv` file that does not name them.
FCSV_COLUMNS = ("id", "x", "y", "z", "ow", "ox", "oy", "oz", "vis", "sel", "lock", "label")
SCHEMA = (
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/"
    "Resources/Schema/markups-schema-v1.0.3.json#"
)


@dataclass(frozen=True, eq=False)
class LandmarkFile:
    """The landmarks of a file, and what to know about them.

    Attributes
    ----------
    points : mapping of str to (3,) float64, mm
        LPS, by label, in the order of the file.
    frame : str
        The frame of the numbers in the file, "LPS" or "RAS".
    stated : bool
        Whether the file states it.
    findings : tuple of Finding
        An unstated frame, points that were never placed.
    """

    points: Mapping[str, Floats]
    frame: str
    stated: bool
    findings: tuple[Finding, ...] = ()


@dataclass(frozen=True)
class _Point:
    """A point as a file has it, before frame and units."""

    number: int
    label: str
    position: Floats


def read_landmarks(path: str | os.PathLike[str], *, frame: str | None = None) -> dict[str, Floats]:
    """The landmarks of a `.mrk.json` or `.fcsv` file by label, LPS mm.

    Parameters
    ----------
    path : path
    frame : str, optional
        "LPS" or "RAS", for a file that does not state its frame; a statement in the file wins.
        Without both, the format's own rule holds and a warning is logged.

    Returns
    -------
    dict of str to (3,) float64, mm

    Raises
    ------
    FileNotFoundError
        The file does not exist.
    LandmarkError
        (also `ValueError`) Not such a file, no points, a label twice or empty, a coordinate that is
        not a finite number: with the number of the point.

    Examples
    --------
    >>> import cmfsim
    >>> landmarks = cmfsim.read_landmarks("skull.mrk.json")  # doctest: +SKIP
    >>> landmarks["nasion"].shape  # doctest: +SKIP
    (3,)
    """
    found = read_landmark_file(path, frame=frame)
    for finding in found.findings:
        if finding.severity == "warning":
            logging.getLogger(__name__).warning("%s: %s", finding.where, finding.what)
    return dict(found.points)


def read_landmark_file(path: str | os.PathLike[str], *, frame: str | None = None) -> LandmarkFile:
    """The landmarks of a file with its frame and findings; see `read_landmarks`."""
    path = Path(path)
    if frame is not None:
        check_one_of("frame", frame, ("LPS", "RAS"))
    if path.suffix not in UNSTATED:
        raise LandmarkInputError(
            f"{path.name}: landmarks end in .mrk.json or .fcsv, not {path.suffix!r}"
        )
    if path.is_dir():
        raise LandmarkInputError(f"{path.name}: is a folder, not a file of landmarks")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    size = path.stat().st_size
    if size > MAX_LANDMARK_TEXT:
        raise LandmarkInputError(
            f"{path.name}: has {size} bytes, landmarks {MAX_LANDMARK_TEXT} at most"
        )
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise LandmarkInputError(f"{path.name}: is not UTF-8 text ({error})") from error
    try:
        return (_from_json if path.suffix == ".json" else _from_fcsv)(text, path, frame)
    except LandmarkInputError as error:
        raise LandmarkInputError(f"{path.name}: {error}") from error


def write_landmarks(path: str | os.PathLike[str], landmarks: Mapping[str, ArrayLike]) -> None:
    """Writes landmarks as a `.mrk.json` file of 3D Slicer, LPS mm.

    An existing file is replaced in one step; `read_landmarks` gives the same numbers back.

    Parameters
    ----------
    path : path
        Ends in `.mrk.json`.
    landmarks : mapping of str to (3,) float64, mm

    Raises
    ------
    LandmarkError
        (also `ValueError`) Another ending, no landmarks, an empty label, not three finite numbers.
    OSError
        The folder cannot be written to.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.write_landmarks("skin.mrk.json", {"pronasale": (0, -90, 12)})
    >>> cmfsim.read_landmarks("skin.mrk.json")["pronasale"].tolist()
    [0.0, -90.0, 12.0]
    """
    path = Path(path)
    if not path.name.endswith(".mrk.json"):
        raise LandmarkInputError(f"{path.name}: landmarks are written as .mrk.json")
    points = _by_label(
        [
            _Point(number, label, _position(number, list(np.asarray(value, dtype=object).flat)))
            for number, (label, value) in enumerate(landmarks.items(), start=1)
        ]
    )
    markup = {
        "type": "Fiducial",
        "coordinateSystem": "LPS",
        "coordinateUnits": "mm",
        "controlPoints": [
            {
                "id": str(number),
                "label": label,
                "position": position.tolist(),
                "positionStatus": "defined",
            }
            for number, (label, position) in enumerate(points.items(), start=1)
        ],
    }
    text = json.dumps({"@schema": SCHEMA, "markups": [markup]}, indent=1, allow_nan=False)
    with replacing(path) as file:
        file.write(text.encode())


def _from_json(text: str, path: Path, frame: str | None) -> LandmarkFile:
    try:
        document = json.loads(text, parse_constant=refuse_constant)
    except (ValueError, RecursionError) as error:
        raise LandmarkInputError(f"is not JSON ({error})") from error
    markups = document.get("markups") if isinstance(document, dict) else None
    if not isinstance(markups, list) or not all(isinstance(m, dict) for m in markups):
        raise LandmarkInputError("has no list 'markups': it is no markups file of 3D Slicer")
    points: list[_Point] = []
    unset: list[str] = []
    frames: set[str | None] = set()
    for markup in markups:
        entries = markup.get("controlPoints", [])
        if not isinstance(entries, list):
            raise LandmarkInputError("'controlPoints' is not a list")
        length = _unit_length(markup.get("coordinateUnits", "mm"))
        its_frame = _frame_name(markup.get("coordinateSystem"))
        frames.add(its_frame)
        sign = _signs(its_frame or frame or UNSTATED[".json"])
        for entry in entries:
            number = len(points) + len(unset) + 1
            if not isinstance(entry, dict):
                raise LandmarkInputError(f"point {number} is not a table of names and values")
            if entry.get("positionStatus", "defined") != "defined":
                unset.append(str(entry.get("label", number)))
                continue
            place = _position(number, entry.get("position"))
            points.append(_Point(number, _label(number, entry.get("label")), sign * length * place))
    stated = None not in frames
    chosen = next(iter(sorted(f for f in frames if f)), frame or UNSTATED[".json"])
    return _landmark_file(points, unset, chosen, frame, path, stated=stated)


def _from_fcsv(text: str, path: Path, frame: str | None) -> LandmarkFile:
    columns: tuple[str, ...] = FCSV_COLUMNS
    its_frame: str | None = None
    rows: list[tuple[int, str]] = []
    for line_number, line in enumerate(text.splitlines(), start=1):
        if not line.startswith("#"):
            if line.strip():
                rows.append((line_number, line))
            continue
        key, _, value = line.lstrip("# ").partition("=")
        if key.strip() == "CoordinateSystem":
            its_frame = _frame_name(value.strip())
        elif key.strip() == "columns":
            columns = tuple(name.strip() for name in value.split(","))
    lacking = [name for name in ("x", "y", "z", "label") if name not in columns]
    if lacking:
        raise LandmarkInputError(f"lacks the column {', '.join(lacking)}: it is no .fcsv of Slicer")
    sign = _signs(its_frame or frame or UNSTATED[".fcsv"])
    points: list[_Point] = []
    for number, (line_number, line) in enumerate(rows, start=1):
        try:
            cells = next(csv.reader([line], strict=True))
        except csv.Error as error:
            raise LandmarkInputError(f"line {line_number}: {error}") from error
        if len(cells) <= max(columns.index(name) for name in ("x", "y", "z", "label")):
            raise LandmarkInputError(
                f"point {number} (line {line_number}) has {len(cells)} of {len(columns)} columns"
            )
        row = dict(zip(columns, cells, strict=False))
        numbers: list[object] = []
        for name in ("x", "y", "z"):
            try:
                numbers.append(float(row[name]))
            except ValueError:
                numbers.append(row[name])
        points.append(
            _Point(number, _label(number, row["label"]), sign * _position(number, numbers))
        )
    chosen = its_frame or frame or UNSTATED[".fcsv"]
    return _landmark_file(points, [], chosen, frame, path, stated=its_frame is not None)


def _landmark_file(
    points: list[_Point],
    unset: list[str],
    chosen: str,
    given: str | None,
    path: Path,
    *,
    stated: bool,
) -> LandmarkFile:
    findings: list[Finding] = []
    if not stated:
        origin = "as the case says" if given else "the rule of this format"
        findings.append(
            Finding(
                "note" if given else "warning",
                "landmark-frame-unstated",
                f"the file does not state its frame: read as {chosen}, {origin}",
                path.name,
                "RAS read as LPS turns the head by half a turn about its long axis",
                'state it: "coordinateSystem": "LPS" (.mrk.json), # CoordinateSystem = LPS (.fcsv),'
                ' or frame = "LPS" under [landmarks]',
            )
        )
    if unset:
        names = ", ".join(unset[:5]) + (", …" if len(unset) > 5 else "")
        findings.append(
            Finding(
                "note",
                "landmark-unset",
                f"{len(unset)} points were never placed and are left out: {names}",
                path.name,
                "what is placed from them falls back to its default or is refused",
                "place them in 3D Slicer, or delete them",
            )
        )
    return LandmarkFile(MappingProxyType(_by_label(points)), chosen, stated, tuple(findings))


def _by_label(points: list[_Point]) -> dict[str, Floats]:
    if not points:
        raise LandmarkInputError("holds no points that were placed")
    found: dict[str, _Point] = {}
    for point in points:
        label = _label(point.number, point.label)
        if label in found:
            raise LandmarkInputError(
                f"points {found[label].number} and {point.number} are both called {label!r}"
            )
        found[label] = point
    return {label: point.position for label, point in found.items()}


def _label(number: int, label: object) -> str:
    if not isinstance(label, str) or not label.strip():
        raise LandmarkInputError(f"point {number} has no label")
    return label.strip()


def _position(number: int, position: object) -> Floats:
    if not isinstance(position, list) or len(position) != 3:
        raise LandmarkInputError(f"point {number} is at {position!r}: three numbers are needed")
    for value in position:
        is_number = isinstance(value, int | float | np.integer | np.floating)
        if isinstance(value, bool) or not is_number:
            raise LandmarkInputError(f"point {number} has the coordinate {value!r}: no number")
        if not math.isfinite(value):
            raise LandmarkInputError(f"point {number} has the coordinate {value}: must be finite")
    return np.array(position, dtype=np.float64)


def _frame_name(value: object) -> str | None:
    if value is None or value == "":
        return None
    name = FRAME_NAMES.get(str(value))
    if name is None:
        raise LandmarkInputError(f"is in the frame {value!r}: LPS (or 1) and RAS (or 0) are read")
    return name


def _unit_length(value: object) -> float:
    """The length of a file's unit in mm; Slicer may write [code, scheme, meaning]."""
    name = value[0] if isinstance(value, list) and value else value
    if not isinstance(name, str) or name not in UNIT_LENGTHS:
        known = ", ".join(UNIT_LENGTHS)
        raise LandmarkInputError(f"has coordinateUnits {value!r}: {known} are read")
    return UNIT_LENGTHS[name]


def _signs(frame: str) -> Floats:
    return np.array([-1.0, -1.0, 1.0] if frame == "RAS" else [1.0, 1.0, 1.0])
