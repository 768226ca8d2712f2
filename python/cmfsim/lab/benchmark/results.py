"""The scores of one method on all patients of a part."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from cmfsim.lab.benchmark.bands import MethodBand
from cmfsim.lab.benchmark.patients import LIPS
from cmfsim.lab.benchmark.scores import RegionScore

# Regions in the order of the tables.
REGIONS = (
    "face",
    "lower face",
    LIPS,
    "upper lip",
    "lower lip",
    "chin",
    "nose",
    "left cheek",
    "right cheek",
)
FIGURES = ("mean", "p95", "within", "normal")


@dataclass(frozen=True)
class MethodResult:
    """The scores of one method.

    scores: By patient, then by region.
    missing: Patients without a prediction.
    failed: The reasons that the method gives for some of them, by patient.
    band: Calibration of its standard deviations on the calibration part, where it states any.
    """

    method: str
    scores: Mapping[str, Mapping[str, RegionScore]]
    missing: tuple[str, ...] = ()
    failed: Mapping[str, str] = field(default_factory=dict)
    band: MethodBand | None = None

    def figures(self, region: str, name: str) -> list[float]:
        """The value of a figure for each patient who has it."""
        found = [getattr(scores[region], name) for scores in self.scores.values()]
        return [float(value) for value in found if value is not None]

    def mean(self, region: str, name: str) -> float | None:
        """The mean of a figure over patients; None where none has it."""
        found = self.figures(region, name)
        return float(np.mean(found)) if found else None

    def row(self, region: str, count: int) -> list[str]:
        """The cells of the CSV file."""
        means = self.figures(region, "mean")
        spread = float(np.std(means, ddof=1)) if len(means) > 1 else None
        values = [self.mean(region, name) for name in FIGURES]
        banded = self.figures(region, "covered")
        band = [self.mean(region, name) for name in ("covered", "half_width")]
        numbers = [_number(value) for value in (values[0], spread, *values[1:])]
        counts = [str(len(means)), str(count)]
        factor = self.band.factors.get(region) if self.band is not None else None
        band_cells = [str(len(banded)), *(_number(value) for value in band)]
        band_cells += ["", ""] if factor is None else [str(factor.n), _number(factor.factor)]
        return [self.method, region, *counts, *numbers, *band_cells]


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.6f}"
