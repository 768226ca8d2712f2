"""Landmarks of 3D Slicer: `.mrk.json` and `.fcsv`, read into LPS mm, and written as `.mrk.json`.

A file that does not state its frame is never guessed at in silence: it is taken as its format says,
and a finding says so.
"""

import csv
import logging
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from cmfsim.errors import LandmarkInputError
from cmfsim.io.slicer.markups import (
    as_position,
    frame_name,
    frame_signs,
    markup_of,
    markup_text,
    markups_of,
    write_markups,
)
from cmfsim.values.checks import AnyPath, Floats, check_one_of
from cmfsim.values.finding import Finding, log_warnings
from cmfsim.values.landmark_sites import SKIN_LANDMARKS, SKULL_LANDMARKS, label_key, named_site

# What each format means where it does not say: Slicer's markups schema, and its fiducial reader.
UNSTATED: Mapping[str, str] = MappingProxyType({".json": "LPS", ".fcsv": "RAS"})
# A number as Slicer writes it; Python takes more for one, 1_0 among them.
NUMBER = re.compile(r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?|[-+]?(?:nan|inf)")
# Columns of a `.fcsv` file that does not name them.
FCSV_COLUMNS = (
    *("id", "x", "y", "z", "ow", "ox", "oy", "oz"),
    *("vis", "sel", "lock", "label", "desc", "associatedNodeID"),
)
# Slicer 5 writes two more values than it names columns. The first is the status of the point: not
# placed, shown under the mouse, or placed.
STATUS = "positionStatus"
NOT_PLACED = frozenset({"0", "1"})


@dataclass(frozen=True, eq=False)
class LandmarkFile:
    """The landmarks of a file by label, LPS, mm, in its order, and what to know about them.

    frame, stated: The frame of the numbers in the file, and whether the file states it.
    findings, unset: An unstated frame; points that were never placed, by label.
    """

    points: Mapping[str, Floats]
    frame: str
    stated: bool
    findings: tuple[Finding, ...] = ()
    unset: tuple[str, ...] = ()
    descriptions: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class _Point:
    """A point as a file has it, before frame and units."""

    number: int
    label: str
    position: Floats
    description: str = ""


def read_landmarks(path: AnyPath, *, frame: str | None = None) -> dict[str, Floats]:
    """The landmarks of a `.mrk.json` or `.fcsv` file by label, LPS mm.

    Parameters
    ----------
    path : path
    frame : str, optional
        "LPS" or "RAS", for a file that does not state its frame; a statement in the file wins.
        Without both, the rule of the format applies and a warning is logged.

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
    >>> landmarks = cmfsim.read_landmarks("skull.mrk.json")
    >>> landmarks["nasion"].shape
    (3,)
    """
    found = _read(path, frame)
    log_warnings(logging.getLogger(__name__), found.findings)
    return dict(found.points)


def read_landmark_file(
    path: AnyPath, *, frame: str | None = None, kind: str | None = None
) -> LandmarkFile:
    """The landmarks of a file with its frame and findings; see `read_landmarks`.

    Labels that differ from those of `SKULL_LANDMARKS` and `SKIN_LANDMARKS` in spelling alone
    (capitals, spaces, hyphens) get theirs, and a finding reports it: `Nasion` is `nasion` wherever
    a case uses it. With a kind, "skull" or "skin", abbreviations of `CEPHALOMETRY` are read as
    well: `LGo` is `gonion_L`.
    """
    found = _read(path, frame)
    names, findings = _known_labels(found.points, Path(path).name, kind)
    return replace(
        found,
        points=MappingProxyType({names[label]: point for label, point in found.points.items()}),
        descriptions={names[label]: text for label, text in found.descriptions.items()},
        findings=(*found.findings, *findings),
    )


def _known_labels(
    points: Mapping[str, Floats], where: str, kind: str | None
) -> tuple[Mapping[str, str], list[Finding]]:
    """The label by which the package knows each landmark, by that of the file."""
    known = {label_key(name): name for name in (*SKULL_LANDMARKS, *SKIN_LANDMARKS)}
    labels = {label: known.get(label_key(label), label) for label in points}
    if kind is not None:
        try:
            labels = {label: named_site(label, kind) or labels[label] for label in points}
        except LandmarkInputError as error:
            raise LandmarkInputError(f"{where}: {error}") from error
    for label, name in labels.items():
        if label != name and name in points:
            raise LandmarkInputError(
                f"{where}: has {name!r} and {label!r}, which are one landmark: remove or rename one"
            )
    renamed = [f"{label!r} is {name!r}" for label, name in labels.items() if label != name]
    if len(set(labels.values())) < len(labels):
        raise LandmarkInputError(
            f"{where}: has a landmark twice, under two names ({', '.join(renamed[:4])}): remove "
            "or rename one"
        )
    if not renamed:
        return labels, []
    more = f" and {len(renamed) - 4} more" if len(renamed) > 4 else ""
    finding = Finding(
        "landmark-spelling",
        f"{len(renamed)} labels are spelled differently: {', '.join(renamed[:4])}{more}",
        where=where,
        why="the second spelling is used",
    )
    return labels, [finding]


def _read(path: AnyPath, frame: str | None) -> LandmarkFile:
    path = Path(path)
    if frame is not None:
        check_one_of("frame", frame, ("LPS", "RAS"))
    if path.suffix not in UNSTATED:
        raise LandmarkInputError(
            f"{path.name}: landmarks end in .mrk.json or .fcsv, not {path.suffix!r}"
        )
    text = markup_text(path)
    try:
        return (_from_json if path.suffix == ".json" else _from_fcsv)(text, path, frame)
    except LandmarkInputError as error:
        raise LandmarkInputError(f"{path.name}: {error}") from error


def write_landmarks(
    path: AnyPath,
    landmarks: Mapping[str, ArrayLike],
    *,
    descriptions: Mapping[str, str] | None = None,
) -> None:
    """Writes landmarks as a `.mrk.json` file of 3D Slicer, LPS mm.

    An existing file is replaced in one step; `read_landmarks` returns the same numbers.

    Parameters
    ----------
    path : path
        Ends in `.mrk.json`.
    landmarks : mapping of str to (3,) float64, mm
    descriptions : mapping of str to str, optional
        Description that 3D Slicer shows with each point, by label.

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
    items = enumerate(landmarks.items(), start=1)
    given = [
        _Point(number, label, as_position(number, list(np.asarray(value, dtype=object).flat)))
        for number, (label, value) in items
    ]
    points = _by_label(given)
    write_markups(path, [markup_of("Fiducial", points.items(), descriptions)])


def _from_json(text: str, path: Path, frame: str | None) -> LandmarkFile:
    points: list[_Point] = []
    unset: list[str] = []
    frames: set[str | None] = set()
    for markup in markups_of(text, UNSTATED[".json"] if frame is None else frame):
        frames.add(markup.frame)
        for number, entry in enumerate(markup.entries, start=len(points) + len(unset) + 1):
            if entry.position is None:
                unset.append(str(number if entry.label is None else entry.label))
            else:
                label = _label(number, entry.label)
                points.append(_Point(number, label, entry.position, entry.description))
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
            its_frame = frame_name(value.strip())
        elif key.strip() == "columns":
            columns = tuple(name.strip() for name in value.split(","))
    lacking = [name for name in ("x", "y", "z", "label") if name not in columns]
    if lacking:
        raise LandmarkInputError(
            f"lacks the column {', '.join(lacking)}: it is not a Slicer .fcsv file"
        )
    sign = frame_signs(its_frame or frame or UNSTATED[".fcsv"])
    points: list[_Point] = []
    unset: list[str] = []
    for number, (line_number, line) in enumerate(rows, start=1):
        try:
            cells = next(csv.reader([line], strict=True))
        except csv.Error as error:
            raise LandmarkInputError(f"line {line_number}: {error}") from error
        if len(cells) <= max(columns.index(name) for name in ("x", "y", "z", "label")):
            raise LandmarkInputError(
                f"point {number} (line {line_number}) has {len(cells)} of {len(columns)} columns"
            )
        row = dict(zip((*columns, STATUS), cells, strict=False))
        if row.get(STATUS, "").strip() in NOT_PLACED:
            unset.append(row["label"].strip() or str(number))
            continue
        words = (row[name].strip() for name in ("x", "y", "z"))
        numbers = [float(cell) if NUMBER.fullmatch(cell) else cell for cell in words]
        label, place = _label(number, row["label"]), sign * as_position(number, numbers)
        points.append(_Point(number, label, place, row.get("desc", "").strip()))
    chosen = its_frame or frame or UNSTATED[".fcsv"]
    return _landmark_file(points, unset, chosen, frame, path, stated=its_frame is not None)


def _landmark_file(
    points: list[_Point],
    unset: list[str],
    chosen: str,
    given: str | None,
    path: Path,
    *,
    stated: bool,
) -> LandmarkFile:
    findings, where = list[Finding](), path.name
    if not stated:
        origin = "as the case says" if given else "the rule of this format"
        severity = "note" if given else "warning"
        what = f"the file does not state its frame: read as {chosen}, {origin}"
        why = "reading RAS as LPS rotates the head by 180° about its long axis"
        fix = (
            'state it: "coordinateSystem": "LPS" (.mrk.json), # CoordinateSystem = LPS (.fcsv), '
            'or frame = "LPS" under [landmarks]'
        )
        findings.append(
            Finding("frame-unstated", what, severity=severity, where=where, why=why, fix=fix)
        )
    if unset:
        names = ", ".join(unset[:5]) + (", …" if len(unset) > 5 else "")
        what = f"{len(unset)} points were never placed and are skipped: {names}"
        findings.append(Finding("landmark-unset", what, where=where))
    placed = MappingProxyType(_by_label(points))
    said = {_label(p.number, p.label): p.description for p in points if p.description}
    return LandmarkFile(placed, chosen, stated, tuple(findings), tuple(unset), said)


def _by_label(points: list[_Point]) -> dict[str, Floats]:
    if not points:
        raise LandmarkInputError("contains no placed points")
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
