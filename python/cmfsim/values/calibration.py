"""Sources of uncertainty with their priors, and scores of cases by which bands are calibrated.

A prior is a standard deviation. Moduli have it on their logarithm, since they are positive and
spread over orders of magnitude; the rest is linear. "assumed" means that no publication was found
that gives the figure.
"""

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any

import numpy as np

from cmfsim.errors import CalibrationError
from cmfsim.values.checks import Floats, as_number, as_positive, as_text, check_one_of, keep
from cmfsim.values.solver_options import MODELS


@dataclass(frozen=True)
class Source:
    """A source of uncertainty and its prior, with the reference for its standard deviation.

    unit: "log": of the natural logarithm; "1", "share", "degrees" or "mm".
    """

    name: str
    sd: float
    unit: str
    reference: str

    def __post_init__(self) -> None:
        as_positive(f"sd of {self.name}", self.sd)

    def as_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return {"sd": self.sd, "unit": self.unit, "reference": self.reference}


_PRIORS = json.loads(files("cmfsim.values").joinpath("priors.json").read_text(encoding="utf-8"))
# Of the material: only ratios of moduli matter, so that fat, along and across together count once.
# Of each segment that the plan moves, about the middle of what is joined to it. Along the normal of
# the skin, without a solve.
TISSUE, PLAN, ADDED = (
    tuple(Source(**source) for source in _PRIORS[kind]) for kind in ("tissue", "plan", "added")
)
# What no derivative gives, and what stands for it.
NOT_COVERED: tuple[str, ...] = tuple(_PRIORS["not_covered"])


def band_sources() -> dict[str, Any]:
    """The sources and their priors, as plain values: part of what a calibration belongs to."""
    groups = {"tissue": TISSUE, "plan": PLAN, "added": ADDED}
    return {
        kind: {source.name: {"sd": source.sd, "unit": source.unit} for source in sources}
        for kind, sources in groups.items()
    }


def settings_digest(settings: Mapping[str, Any]) -> str:
    """The SHA-256 of plain values, whatever the order of their names."""
    return hashlib.sha256(json.dumps(dict(settings), sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True)
class BandFactor:
    """The factor on the standard deviation in one region, and its reliability.

    Attributes
    ----------
    factor : float
    n : int
        Calibration cases that have the region.
    rank : int
        The factor is the score of this rank, 1 the smallest.
    coverage : float
        Requested coverage: 0.9 for 90 %.
    interval : (float, float)
        5 % and 95 % quantile of the coverage that a calibration of this size reaches in further
        cases like those that it was made of.
    """

    factor: float
    n: int
    rank: int
    coverage: float
    interval: tuple[float, float]

    def as_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return {
            **{name: getattr(self, name) for name in ("factor", "n", "rank", "coverage")},
            "coverage_5_percent": self.interval[0],
            "coverage_95_percent": self.interval[1],
        }


@dataclass(frozen=True)
class CalibrationCase:
    """The scores of one case whose outcome is known.

    Attributes
    ----------
    case : str
        Its name, unique in a calibration.
    scores : mapping of str to float
        By region of the face: the largest |error| over the standard deviation, 0 or more.
    group : str
        Name of cases that can be calibrated separately: a procedure, a centre, "virtual".

    Raises
    ------
    CalibrationError
        (also `ValueError`) No name, no score, a score that is not a finite number from 0 on.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.CalibrationCase("P1", {"chin": 1.7}).scores["chin"]
    1.7
    """

    case: str
    scores: Mapping[str, float]
    group: str = ""

    def __post_init__(self) -> None:
        as_text("calibration case", self.case)
        if not self.scores:
            raise CalibrationError(f"calibration case {self.case!r} has no score")
        for region, score in self.scores.items():
            value = as_number(f"score of {region!r} in case {self.case!r}", score)
            if not (math.isfinite(value) and value >= 0.0):
                raise CalibrationError(
                    f"score of {region!r} in case {self.case!r} is {value!r}: a finite number "
                    "from 0 on is needed; omit regions that were not compared"
                )
        keep(self, scores=self.scores)


@dataclass(frozen=True)
class Calibration:
    """Scores of cases that were predicted by one model under the same settings.

    Attributes
    ----------
    model : str
        "H", "M", "H+S" or "M+S".
    settings : mapping of str to plain values
        What predictions and their standard deviations depend on besides the case: `band_settings`.
    cases : tuple of CalibrationCase
    note : str
        Description of the cases, such as that they are virtual patients.
    coverage : float or None
        The only coverage that the file may be used for; None for any.

    Raises
    ------
    CalibrationError
        (also `ValueError`) Two cases of one name; none; a coverage outside 0 to 1.
    """

    model: str
    settings: Mapping[str, Any]
    cases: tuple[CalibrationCase, ...]
    note: str = ""
    coverage: float | None = None
    digest: str = field(init=False)

    def __post_init__(self) -> None:
        check_one_of("model", self.model, MODELS)
        if not self.cases:
            raise CalibrationError("a calibration needs at least one case, but it has none")
        seen: set[str] = set()
        for case in self.cases:
            if case.case in seen:
                raise CalibrationError(
                    f"calibration case {case.case!r} appears twice: each patient counts once"
                )
            seen.add(case.case)
        if self.coverage is not None and not 0.0 < as_number("coverage", self.coverage) < 1.0:
            raise CalibrationError(f"coverage is {self.coverage!r}: it must be above 0 and below 1")
        # As a file gives them back: tuples are lists.
        settings = json.loads(json.dumps(dict(self.settings)))
        keep(self, settings=settings, digest=settings_digest(settings))

    @property
    def regions(self) -> tuple[str, ...]:
        """The regions that any case has, in the order in which they appear."""
        return tuple(dict.fromkeys(region for case in self.cases for region in case.scores))

    @property
    def groups(self) -> tuple[str, ...]:
        """The groups of the cases, in the order in which they appear."""
        return tuple(dict.fromkeys(case.group for case in self.cases))

    def scores(self, region: str, group: str | None = None) -> Floats:
        """The scores of a region, (n,), of the cases that have it.

        Parameters
        ----------
        region : str
        group : str, optional
            Only of the cases of this group.
        """
        chosen = [c for c in self.cases if group is None or c.group == group]
        return np.array([c.scores[region] for c in chosen if region in c.scores], dtype=np.float64)
