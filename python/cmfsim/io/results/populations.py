"""What many patients have taught, as JSON: populations of virtual ones, and calibrations.

See docs/virtual_patients.md and docs/band.md.
"""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cmfsim.errors import CalibrationError, CaseInputError
from cmfsim.io.files.reading_writing import FORMAT_VERSION, check_readable, named, replace_text
from cmfsim.io.files.summaries import Closed, Maybe, Shape, Span, check, plain_json
from cmfsim.values.calibration import Calibration, CalibrationCase
from cmfsim.values.checks import AnyPath, check_one_of, keep
from cmfsim.values.prediction import MODELS

POPULATION_FILE = "population.json"
FORMAT = "cmfsim-population"
STATES = MADE, FAILED, PENDING = "made", "failed", "pending"
PARTS = TRAIN, CALIBRATION, TEST = "train", "calibration", "test"
# A name of a patient is that of a folder.
_ENTRY = Closed({"state": str, "part": str, "operation": str, "reason?": str})
_POPULATION: Shape = {
    "format": frozenset({FORMAT}), "version": Span(FORMAT_VERSION, FORMAT_VERSION, whole=True),
    "settings?": Maybe({str: object}), "patients": {re.compile(r"[\w-]*[^\W_][\w-]*"): _ENTRY},
}  # fmt: skip


def part_of(index: int) -> str:
    """The part that the patient of an index belongs to: each third one, whatever the count."""
    return PARTS[(index - 1) % len(PARTS)]


@dataclass(frozen=True)
class PopulationEntry:
    """The state of one drawn patient.

    Attributes
    ----------
    state : str
        "made"; "failed": there is no truth, and `reason` states why; "pending": not tried yet.
    part : str
        "train", "calibration" or "test".
    operation : str
    reason : str
    """

    state: str
    part: str
    operation: str
    reason: str = ""

    def __post_init__(self) -> None:
        check_one_of("state", self.state, STATES)
        check_one_of("part", self.part, PARTS)

    def as_dict(self) -> dict[str, str]:
        """Plain values, ready for JSON."""
        found = {"state": self.state, "part": self.part, "operation": self.operation}
        return {**found, "reason": self.reason} if self.reason else found


@dataclass(frozen=True)
class Population:
    """Drawn patients, including those whose truth failed.

    Attributes
    ----------
    patients : mapping of str to PopulationEntry
        By name, in their order.
    settings : mapping
        The settings with which they were drawn and computed.
    """

    patients: Mapping[str, PopulationEntry]
    settings: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        keep(self, patients=self.patients, settings=self.settings)

    def named(self, state: str, *parts: str) -> tuple[str, ...]:
        """The names of the patients in a state, of some parts or, without, of all."""
        return tuple(
            name
            for name, entry in self.patients.items()
            if entry.state == state and (not parts or entry.part in parts)
        )

    def write(self, folder: Path) -> None:
        """Writes `population.json`: the same bytes for the same population."""
        found = {
            "format": FORMAT,
            "version": FORMAT_VERSION,
            "note": "in silico: synthetic heads and computed operations; no patients",
            "settings": dict(self.settings),
            "patients": {name: entry.as_dict() for name, entry in self.patients.items()},
        }
        replace_text(folder / POPULATION_FILE, json.dumps(found, indent=1, allow_nan=False) + "\n")

    @classmethod
    def load(cls, folder: AnyPath) -> "Population":
        """The population of a folder.

        Raises
        ------
        FileNotFoundError
            There is no `population.json`.
        CaseError
            (also `ValueError`) No population's file, or one that this version does not read.
        """
        path = Path(folder) / POPULATION_FILE
        check_readable(path)
        with named(path):
            found = plain_json(path)
            check("", found, _POPULATION)
            entries = {name: PopulationEntry(**of) for name, of in found["patients"].items()}
            return cls(entries, found.get("settings") or {})


CALIBRATION_FORMAT, CALIBRATION_VERSION = "cmfsim-calibration", 1

_CASE = Closed({"case": str, "scores": {str: Span(0.0, 1e9)}, "group?": str})
_CALIBRATION = Closed({
    "format": frozenset({CALIBRATION_FORMAT}),
    "version": Span(CALIBRATION_VERSION, CALIBRATION_VERSION, whole=True),
    "model": frozenset(MODELS), "settings": {str: object}, "settings_digest": str, "cases": [_CASE],
    "note?": str, "coverage?": Maybe(Span(0.0, 1.0)),
})  # fmt: skip


def read_calibration(path: AnyPath) -> Calibration:
    """The calibration in a file.

    Raises
    ------
    FileNotFoundError
        There is no such file.
    CalibrationError
        (also `ValueError`) Not a calibration, another version, a value out of range, settings that
        are not those of the digest: with the file and the place in it.

    Examples
    --------
    >>> import cmfsim
    >>> calibration = cmfsim.read_calibration("calibration.json")  # doctest: +SKIP
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such calibration file")
    try:
        content: dict[str, Any] = plain_json(path)
        check("", content, _CALIBRATION)
        found = Calibration(
            content["model"],
            content["settings"],
            tuple(CalibrationCase(**case) for case in content["cases"]),
            content.get("note", ""),
            content.get("coverage"),
        )
    except (OSError, CaseInputError) as error:
        raise CalibrationError(f"{path}: {error}") from error
    if found.digest != content["settings_digest"]:
        raise CalibrationError(
            f"{path}: settings_digest is not that of its settings: one of them was changed by "
            "hand; write the file again with write_calibration"
        )
    return found


def write_calibration(path: AnyPath, calibration: Calibration) -> None:
    """Writes a calibration; the same calibration always gives the same bytes.

    Raises
    ------
    OSError
        The file cannot be written.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.write_calibration("calibration.json", calibration)  # doctest: +SKIP
    """
    content = {
        "format": CALIBRATION_FORMAT,
        "version": CALIBRATION_VERSION,
        "model": calibration.model,
        "note": calibration.note,
        "coverage": calibration.coverage,
        "settings_digest": calibration.digest,
        "settings": dict(calibration.settings),
        "cases": [
            {"case": case.case, "group": case.group, "scores": dict(case.scores)}
            for case in calibration.cases
        ],
    }
    text_of = json.dumps(content, indent=1, sort_keys=False, allow_nan=False, ensure_ascii=False)
    replace_text(Path(path), f"{text_of}\n")
