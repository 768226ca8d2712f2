"""Errors of predictions: of one at the vertices of each region, of a method on all patients."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np

from cmfsim.lab.benchmark.bands import MethodBand
from cmfsim.lab.benchmark.patients import LIPS, BenchmarkPatient
from cmfsim.lab.benchmark.skin_predictions import SkinPrediction
from cmfsim.values.calibration import BandFactor
from cmfsim.values.checks import Floats

# Regions in the order of the tables.
REGIONS = (
    "face", "lower face", LIPS, "upper lip", "lower lip", "chin", "nose", "left cheek",
    "right cheek",
)  # fmt: skip
FIGURES = ("mean", "p95", "within", "normal")
# What is usually called acceptable, mm.
WITHIN = 2.0
# Decimals of figures in files, mm and shares: beyond what a prediction in single precision has.
DECIMALS = 6


@dataclass(frozen=True)
class RegionScore:
    """Errors of a prediction in a region of one patient.

    mean, p95: mm, of the length of the difference from the true displacement, over vertices.
    within: Share of vertices with 2 mm or less.
    normal: mm. Mean size of the difference along the normal of the skin: without sliding along
        itself.
    covered: Whether the true skin lies within the stated band at all vertices; None without a band.
    half_width: mm, or None. Mean of that band.
    """

    mean: float
    p95: float
    within: float
    normal: float
    covered: bool | None = None
    half_width: float | None = None

    def as_dict(self) -> dict[str, Any]:
        """Plain values with their unit in the name."""
        names = {
            "mean": "mean_mm",
            "p95": "p95_mm",
            "within": "share_within_2mm",
            "normal": "normal_mm",
            "covered": "covered",
            "half_width": "half_width_mm",
        }
        return {names[name]: value for name, value in asdict(self).items() if value is not None}


def score(
    patient: BenchmarkPatient,
    prediction: SkinPrediction,
    factors: Mapping[str, BandFactor] = MappingProxyType({}),
) -> dict[str, RegionScore]:
    """The scores of a prediction by region.

    factors: How many standard deviations of the prediction its band has in a region; none without a
        calibration.
    Raises `CaseError`: The prediction is of another skin.
    """
    prediction.check_vertices(patient.skin)
    off = prediction.displacement - patient.truth
    length = np.linalg.norm(off, axis=1)
    along = np.abs(np.einsum("vi,vi->v", off, patient.normals))
    found = {}
    for name, part in patient.regions.items():
        errors = length[part]
        covered = half_width = None
        band = _widths(prediction, factors.get(name))
        if band is not None:
            widths = band[part]
            # A region with a vertex that has no band is not covered.
            covered = bool((along[part] <= widths).all())
            half_width = _rounded(np.nanmean(widths)) if np.isfinite(widths).any() else None
        found[name] = RegionScore(
            _rounded(errors.mean()),
            _rounded(np.percentile(errors, 95.0)),
            _rounded((errors <= WITHIN).mean()),
            _rounded(along[part].mean()),
            covered,
            half_width,
        )
    return found


def _widths(prediction: SkinPrediction, factor: BandFactor | None) -> Floats | None:
    """The half widths of the band that a region is scored by, (v,) mm."""
    if prediction.half_width is not None:
        return prediction.half_width
    if prediction.sd is None or factor is None:
        return None
    return factor.factor * prediction.sd


def _rounded(value: Any) -> float:
    return round(float(value), DECIMALS)


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
