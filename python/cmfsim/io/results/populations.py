"""A population of virtual patients and its file, `population.json` (docs/virtual_patients.md)."""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cmfsim.io.files.reading_writing import FORMAT_VERSION, check_readable, named, replacing
from cmfsim.io.files.summaries import Closed, Maybe, Shape, Span, check, plain_json
from cmfsim.values.checks import AnyPath, check_one_of, keep

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
        with replacing(folder / POPULATION_FILE) as file:
            file.write((json.dumps(found, indent=1, allow_nan=False) + "\n").encode())

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
