"""Errors of predictions by region, calibrated bands, and their tables: CSV, Markdown and JSON."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from cmfsim.errors import CaseInputError
from cmfsim.evaluation.conformal import calibrate, cases_needed, covered_interval, region_scores
from cmfsim.io.results.populations import write_calibration
from cmfsim.lab.benchmark.entries import EntryFolder, check_own
from cmfsim.lab.benchmark.entry_names import NO_CHANGE
from cmfsim.lab.benchmark.patients import (
    LIPS,
    BenchmarkPatient,
    SkinPrediction,
    read_skin_prediction,
)
from cmfsim.values.calibration import BandFactor, Calibration, CalibrationCase
from cmfsim.values.checks import Floats, Plain, in_files, plain
from cmfsim.values.table import NOTHING, Table, csv_of

# The share of patients that a band must cover in each region.
COVERAGE = 0.9
GROUP = "virtual"
NOTE = "in silico: {n} drawn virtual patients, {settings}"
# Regions in the order of the tables.
REGIONS = (
    "face", "lower face", LIPS, "upper lip", "lower lip", "chin", "nose", "left cheek",
    "right cheek",
)  # fmt: skip
# What is usually called acceptable, mm.
WITHIN = 2.0
# Decimals of figures in files, mm and shares: beyond what a prediction in single precision has.
DECIMALS = 6


@dataclass(frozen=True)
class MethodBand:
    """How many of a method's standard deviations cover 90 % of patients, by region.

    factors: Empty where the calibration part has too few predictions with a standard deviation.
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
            "factors": plain(self.factors),
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

    The patients are the calibration part: none of them may be scored. Predictions of another skin,
    or made under other settings than the first, are an error.
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
            off = prediction.displacement - patient.truth
            along = np.einsum("vi,vi->v", off, patient.normals)
            # The largest error along the normal over the standard deviation, by region.
            found = region_scores(along, prediction.sd, patient.regions)
            cases.append(CalibrationCase(patient.name, found, GROUP))
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


@dataclass(frozen=True)
class RegionScore(Plain):
    """Errors of a prediction in a region of one patient, mm.

    mean, p95: Of the length of the difference from the true displacement, over vertices.
    within: Share of vertices with 2 mm or less.
    normal: Mean size of the difference along the normal of the skin: without sliding along itself.
    covered: Whether the true skin lies within the stated band, of this mean half width, everywhere.
    """

    mean: float = field(metadata=in_files("mean_mm"))
    p95: float = field(metadata=in_files("p95_mm"))
    within: float = field(metadata=in_files("share_within_2mm"))
    normal: float = field(metadata=in_files("normal_mm"))
    covered: bool | None = None
    half_width: float | None = field(default=None, metadata=in_files("half_width_mm"))

    def as_dict(self) -> dict[str, Any]:
        """Plain values with their unit in the name."""
        return {k: value for k, value in super().as_dict().items() if value is not None}


def score(
    patient: BenchmarkPatient,
    prediction: SkinPrediction,
    factors: Mapping[str, BandFactor] = MappingProxyType({}),
) -> dict[str, RegionScore]:
    """The scores of a prediction by region.

    factors: How many standard deviations of the prediction its band has in a region, if calibrated.
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
    """The scores of one method, by patient and region.

    missing, failed: Patients without a prediction, and the reasons that the method gives for some.
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

    def row(self, region: str, count: int) -> dict[str, str]:
        """The row of the CSV file: of `count` patients, by column."""
        means, banded = self.figures(region, "mean"), self.figures(region, "covered")
        factor = self.band.factors.get(region) if self.band is not None else None

        def mean(name: str) -> str:
            return _number(self.mean(region, name))

        return {
            "method": self.method,
            "region": region,
            "patients": str(len(means)),
            "of": str(count),
            "mean_mm": mean("mean"),
            "sd_between_patients_mm": _number(np.std(means, ddof=1) if len(means) > 1 else None),
            "p95_mm": mean("p95"),
            "share_within_2mm": mean("within"),
            "normal_mm": mean("normal"),
            "patients_with_band": str(len(banded)),
            "share_covered": mean("covered"),
            "half_width_mm": mean("half_width"),
            "calibration_patients": "" if factor is None else str(factor.n),
            "standard_deviations": _number(None if factor is None else factor.factor),
        }


def _number(value: Any) -> str:
    return "" if value is None else f"{value:.6f}"


ABOUT = (
    "Number of patients whose true skin lies within the band at all vertices of a region; in "
    "brackets, the range of this number that a band of this calibration has with a probability "
    "of 90 %."
)

FORMAT = "cmfsim-benchmark"
IN_SILICO = (
    "In silico: synthetic heads and computed operations, no patients. Each figure is the mean "
    "over patients. The error at a vertex is the length of the difference from its true "
    "displacement, including sliding along the skin."
)


def band_sections(results: Sequence[MethodResult], far: Sequence[str]) -> list[str]:
    """Sections for methods with a band; none where no method has one."""
    banded = [result for result in results if result.figures("face", "covered")]
    found = []
    if banded:
        found = [
            f"## Bands of {COVERAGE:.0%}",
            ABOUT,
            _by_region([row for result in banded for row in _rows(result, far)]),
        ]
    for result in results:
        if result.band is not None and not result.band.factors:
            found.append(
                f"**{result.method}** states standard deviations, but {len(result.band.cases)} "
                f"calibration patients are too few for a band: {cases_needed(COVERAGE)} are "
                "needed."
            )
        elif result.band is not None and result.band.missing:
            names = ", ".join(result.band.missing)
            found.append(f"The band of **{result.method}** is calibrated without {names}.")
    return found


def _rows(result: MethodResult, far: Sequence[str]) -> list[tuple[str, ...]]:
    """Covered patients, those of them far from the models, half-widths and factors."""
    among = [name for name in far if name in result.scores]
    titles = {name: f"{result.method}: {name}" for name in ("covered", "half-width, mm")}
    rows = [
        (titles["covered"], *(_covered(result, region, list(result.scores)) for region in REGIONS))
    ]
    if among:
        title = f"{result.method}: of the {len(among)} farthest from the models"
        rows.append((title, *(_covered(result, region, among) for region in REGIONS)))
    widths = (cell(result.mean(region, "half_width"), "{:.2f}") for region in REGIONS)
    rows.append((titles["half-width, mm"], *widths))
    if result.band is not None:
        factors = [result.band.factors.get(region) for region in REGIONS]
        cells = (NOTHING if f is None else f"{f.factor:.2f} (n = {f.n})" for f in factors)
        rows.append((f"{result.method}: standard deviations", *cells))
    return rows


def _covered(result: MethodResult, region: str, names: Sequence[str]) -> str:
    """How many of some patients are covered, and how many were to be expected."""
    found = [result.scores[name][region].covered for name in names]
    known = [value for value in found if value is not None]
    if not known:
        return NOTHING
    text = f"{int(np.count_nonzero(known))} of {len(known)}"
    factor = result.band.factors.get(region) if result.band is not None else None
    if factor is None:
        return text
    low, high = covered_interval(factor, len(known))
    return f"{text} ({low}–{high})"


def _by_region(rows: Sequence[Sequence[str]]) -> str:
    """Rows of cells, one for each region after the first."""
    return Table(("", *REGIONS), rows, numeric=False).markdown


def cell(value: float | None, form: str) -> str:
    """A figure in a form, or a dash where there is none."""
    return NOTHING if value is None else form.format(value)


@dataclass(frozen=True)
class BenchmarkTable:
    """All methods on the patients of one part.

    Attributes
    ----------
    part : str
    patients : tuple of str
        The scored patients.
    without_truth : tuple of str
        Patients of the part whose truth could not be computed.
    results : tuple of MethodResult
    settings : mapping
        Of the population.
    far : tuple of str
        The half of the patients whose truth differs most from what predictions can know; empty if
        that is not recorded.
    """

    part: str
    patients: tuple[str, ...]
    without_truth: tuple[str, ...]
    results: tuple[MethodResult, ...]
    settings: Mapping[str, Any]
    far: tuple[str, ...] = ()

    def csv(self) -> str:
        """A row for each method and region."""
        count = len(self.patients)
        return csv_of([r.row(region, count) for r in self.results for region in REGIONS])

    def as_dict(self) -> dict[str, Any]:
        """Every figure of every patient, as plain values."""
        return {
            "format": FORMAT,
            "version": 1,
            "note": IN_SILICO,
            "part": self.part,
            "population": dict(self.settings),
            "patients": list(self.patients),
            "patients_without_truth": list(self.without_truth),
            "patients_far_from_the_models": list(self.far),
            "methods": {
                result.method: {
                    "missing": list(result.missing),
                    "failed": list(result.failed),
                    "reasons": dict(result.failed),
                    "band": plain(result.band),
                    "patients": plain(result.scores),
                }
                for result in self.results
            },
        }

    def json(self) -> str:
        """`as_dict` as text."""
        return json.dumps(self.as_dict(), indent=1, allow_nan=False) + "\n"

    def markdown(self) -> str:
        """The tables for readers: the face and the lips, each region, and what is missing."""
        count = len(self.patients)
        settings = ", ".join(f"{name} {value}" for name, value in self.settings.items())
        parts = [
            f"# Benchmark: {count} virtual patients, {self.part} part",
            f"{IN_SILICO} Population: {settings}.",
            self._summary(),
            "## Mean error by region, mm",
            self._by_region("mean", "{:.2f}"),
            "## 95th percentile by region, mm",
            self._by_region("p95", "{:.2f}"),
            "## Share of vertices within 2 mm by region, %",
            self._by_region("within", "{:.0%}"),
            "## Mean error along the normal by region, mm",
            self._by_region("normal", "{:.2f}"),
            *band_sections(self.results, self.far),
            *self._missing(),
        ]
        return "\n\n".join([*parts, ""])

    def _summary(self) -> str:
        titles = (
            "", "patients", "face: mean ± SD, mm", "P95", "< 2 mm", "lips: mean", "P95",
            "worse than no change in",
        )  # fmt: skip
        rows = []
        for result in self.results:
            face = result.figures("face", "mean")
            spread = f" ± {np.std(face, ddof=1):.2f}" if len(face) > 1 else ""
            rows.append(
                (
                    result.method,
                    f"{len(face)} of {len(self.patients)}",
                    cell(result.mean("face", "mean"), "{:.2f}") + spread,
                    cell(result.mean("face", "p95"), "{:.2f}"),
                    cell(result.mean("face", "within"), "{:.0%}"),
                    cell(result.mean(LIPS, "mean"), "{:.2f}"),
                    cell(result.mean(LIPS, "p95"), "{:.2f}"),
                    self._losses(result.method),
                )
            )
        return Table(titles, rows, numeric=False).markdown

    def _losses(self, method: str) -> str:
        """Regions where a method's mean error exceeds that of predicting no change."""
        named = {result.method: result for result in self.results}
        base, found = named.get(NO_CHANGE), named[method]
        if base is None or method == NO_CHANGE:
            return NOTHING
        worse = []
        for region in REGIONS:
            both = [
                (scores[region].mean, base.scores[name][region].mean)
                for name, scores in found.scores.items()
                if name in base.scores
            ]
            if both and np.mean([own - other for own, other in both]) > 0.0:
                worse.append(region)
        return ", ".join(worse) or NOTHING

    def _by_region(self, figure: str, form: str) -> str:
        rows = [
            (result.method, *(cell(result.mean(region, figure), form) for region in REGIONS))
            for result in self.results
        ]
        return _by_region(rows)

    def _missing(self) -> list[str]:
        """Patients missing from the figures."""
        found = []
        if self.without_truth:
            names = ", ".join(self.without_truth)
            found.append(f"Not scored, because they have no truth: {names} (population.json).")
        for result in self.results:
            if result.missing:
                reason = f"; it failed on {', '.join(result.failed)}" if result.failed else ""
                found.append(
                    f"**{result.method}** has no prediction of "
                    f"{', '.join(result.missing)}{reason}: its figures are from fewer patients "
                    "than those of the other methods and cannot be compared with them."
                )
                found += [f"- {name}: {why}" for name, why in result.failed.items()]
        return found
