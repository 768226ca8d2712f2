"""Errors of predictions by region, of one and of a method on all patients; and calibrated bands."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from cmfsim.errors import CaseInputError
from cmfsim.evaluation import calibrate, cases_needed, region_scores
from cmfsim.io.results.calibrations import write_calibration
from cmfsim.lab.benchmark.entries import EntryFolder, check_own
from cmfsim.lab.benchmark.patients import (
    LIPS,
    BenchmarkPatient,
    SkinPrediction,
    read_skin_prediction,
)
from cmfsim.values.calibration import BandFactor, Calibration, CalibrationCase
from cmfsim.values.checks import Floats

# The share of patients that a band must cover in each region.
COVERAGE = 0.9
GROUP = "virtual"
NOTE = "in silico: {n} drawn virtual patients, {settings}"
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
class MethodBand:
    """How many of a method's standard deviations cover 90 % of patients, by region.

    factors: Empty where the calibration part has too few predictions with a standard deviation.
    cases: The patients that it was calibrated on.
    settings: What the standard deviations depend on apart from the patient.
    missing: Patients of the calibration part without one.
    """

    factors: Mapping[str, BandFactor]
    cases: tuple[CalibrationCase, ...]
    settings: Mapping[str, Any] = field(default_factory=dict)
    missing: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return {
            "calibration_patients": [case.case for case in self.cases],
            "missing": list(self.missing),
            "factors": {name: factor.as_dict() for name, factor in self.factors.items()},
        }

    def write(self, path: Path, model: str, population: Mapping[str, Any]) -> None:
        """Writes the calibration of one of the package's models, for `predict --calibration`."""
        text = ", ".join(f"{name} {value}" for name, value in population.items())
        note = NOTE.format(n=len(self.cases), settings=text)
        write_calibration(path, Calibration(model, self.settings, self.cases, note))


def calibrated_band(
    method: str, folder: Path, patients: Sequence[BenchmarkPatient]
) -> MethodBand | None:
    """The band of a method; None if it states no standard deviation for any of these patients.

    folder: The folder of all predictions.
    patients: The calibration part; none of them may be scored.
    Raises `CaseError`: A prediction of another skin, or made under other settings than the first.
    """
    place = EntryFolder(folder)
    cases: list[CalibrationCase] = []
    missing, settings = [], ""
    for patient in patients:
        file = place.file(method, patient.name)
        prediction = read_skin_prediction(file) if file.exists() else None
        if prediction is None or prediction.sd is None:
            missing.append(patient.name)
            continue
        settings = settings or prediction.settings
        try:
            check_own(method, prediction, patient)
            prediction.check_vertices(patient.skin)
            _check_settings(prediction, settings)
            cases.append(CalibrationCase(patient.name, _scores(patient, prediction), GROUP))
        except CaseInputError as error:
            raise CaseInputError(f"{file}: {error}") from error
    if not cases:
        return None
    factors = {}
    if len(cases) >= cases_needed(COVERAGE):
        for region in cases[0].scores:
            factors[region] = calibrate([case.scores[region] for case in cases], COVERAGE)
    about = json.loads(settings) if settings else {}
    return MethodBand(factors, tuple(cases), about, tuple(missing))


def _check_settings(prediction: SkinPrediction, settings: str) -> None:
    if prediction.settings != settings:
        raise CaseInputError(
            f"its settings, {prediction.settings[:200]}, are not those of the patients before it: "
            "predict all patients with the same settings"
        )


def _scores(patient: BenchmarkPatient, prediction: SkinPrediction) -> dict[str, float]:
    """The largest error along the normal over the standard deviation, by region."""
    assert prediction.sd is not None  # noqa: S101 (the caller looked)
    off = prediction.displacement - patient.truth
    along = np.einsum("vi,vi->v", off, patient.normals)
    return region_scores(along, prediction.sd, patient.regions)


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
