"""A population of virtual patients and its file, `population.json` (docs/virtual_patients.md)."""

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

from cmfsim.errors import CaseInputError
from cmfsim.io.files.reading_writing import (
    FORMAT_VERSION,
    check_readable,
    named,
    parsed_json,
    replacing,
)
from cmfsim.values.checks import check_one_of

POPULATION_FILE = "population.json"
FORMAT = "cmfsim-population"
STATES = MADE, FAILED, PENDING = "made", "failed", "pending"
PARTS = TRAIN, CALIBRATION, TEST = "train", "calibration", "test"


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
        for name in ("patients", "settings"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))

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
        with replacing(folder / POPULATION_FILE) as file:
            file.write((json.dumps(found, indent=1, allow_nan=False) + "\n").encode())

    @classmethod
    def load(cls, folder: str | os.PathLike[str]) -> "Population":
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
            found = parsed_json(path.read_text(encoding="utf-8"))
            if not isinstance(found, dict) or found.get("format") != FORMAT:
                raise CaseInputError(f'format = "{FORMAT}" is needed')
            if found.get("version") != FORMAT_VERSION:
                raise CaseInputError(f"version {found.get('version')!r}: {FORMAT_VERSION} is read")
            patients = found.get("patients")
            if not isinstance(patients, dict):
                raise CaseInputError("patients: a table of patients by name is needed")
            return cls(
                {name: _entry(name, values) for name, values in patients.items()},
                found.get("settings") or {},
            )


def _entry(name: str, values: object) -> PopulationEntry:
    """One patient of the file."""
    known = {"state", "part", "operation", "reason"}
    if not name.replace("_", "").replace("-", "").isalnum():
        raise CaseInputError(f"patients: {name!r} is no name: letters, digits, _ and - are allowed")
    if not isinstance(values, dict) or not known >= set(values):
        raise CaseInputError(f"patients.{name}: a table of {', '.join(sorted(known))} is needed")
    if not all(isinstance(value, str) for value in values.values()):
        raise CaseInputError(f"patients.{name}: all values are texts")
    missing = known - {"reason"} - set(values)
    if missing:
        raise CaseInputError(f"patients.{name}: lacks {', '.join(sorted(missing))}")
    return PopulationEntry(**values)
