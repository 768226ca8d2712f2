"""The benchmark's tables, as CSV, Markdown and JSON: methods by regions, and coverage of bands."""

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cmfsim.evaluation import cases_needed, covered_interval
from cmfsim.lab.benchmark.entries import NO_CHANGE
from cmfsim.lab.benchmark.patients import LIPS
from cmfsim.lab.benchmark.scores import COVERAGE, REGIONS, MethodResult

DASH = "–"

ABOUT = (
    "Number of patients whose true skin lies within the band at all vertices of a region; in "
    "brackets, the range of this number that a band of this calibration has with a probability "
    "of 90 %."
)

FORMAT = "cmfsim-benchmark"
COLUMNS = (
    "method", "region", "patients", "of", "mean_mm", "sd_between_patients_mm", "p95_mm",
    "share_within_2mm", "normal_mm", "patients_with_band", "share_covered", "half_width_mm",
    "calibration_patients", "standard_deviations",
)  # fmt: skip
NOTE = (
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
            table(("", *REGIONS), [row for result in banded for row in _rows(result, far)]),
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
        cells = (DASH if f is None else f"{f.factor:.2f} (n = {f.n})" for f in factors)
        rows.append((f"{result.method}: standard deviations", *cells))
    return rows


def _covered(result: MethodResult, region: str, names: Sequence[str]) -> str:
    """How many of some patients are covered, and how many were to be expected."""
    found = [result.scores[name][region].covered for name in names]
    known = [value for value in found if value is not None]
    if not known:
        return DASH
    text = f"{int(np.count_nonzero(known))} of {len(known)}"
    factor = result.band.factors.get(region) if result.band is not None else None
    if factor is None:
        return text
    low, high = covered_interval(factor, len(known))
    return f"{text} ({low}–{high})"


def cell(value: float | None, form: str) -> str:
    """A figure in a form, or a dash where there is none."""
    return DASH if value is None else form.format(value)


def table(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Rows of cells below their titles."""
    lines = [titles, ["---"] * len(titles), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


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
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(COLUMNS)
        for result in self.results:
            writer.writerows(result.row(region, len(self.patients)) for region in REGIONS)
        return text.getvalue()

    def as_dict(self) -> dict[str, Any]:
        """Every figure of every patient, as plain values."""
        return {
            "format": FORMAT,
            "version": 1,
            "note": NOTE,
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
                    "band": None if result.band is None else result.band.as_dict(),
                    "patients": {
                        name: {region: found.as_dict() for region, found in scores.items()}
                        for name, scores in result.scores.items()
                    },
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
            f"{NOTE} Population: {settings}.",
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
        titles = ("", "patients", "face: mean ± SD, mm", "P95", "< 2 mm", "lips: mean", "P95")
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
                )
            )
        return table((*titles, "worse than no change in"), [(*r, self._losses(r[0])) for r in rows])

    def _losses(self, method: str) -> str:
        """Regions where a method's mean error exceeds that of predicting no change."""
        named = {result.method: result for result in self.results}
        base, found = named.get(NO_CHANGE), named[method]
        if base is None or method == NO_CHANGE:
            return DASH
        worse = []
        for region in REGIONS:
            both = [
                (scores[region].mean, base.scores[name][region].mean)
                for name, scores in found.scores.items()
                if name in base.scores
            ]
            if both and np.mean([own - other for own, other in both]) > 0.0:
                worse.append(region)
        return ", ".join(worse) or DASH

    def _by_region(self, figure: str, form: str) -> str:
        rows = [
            (result.method, *(cell(result.mean(region, figure), form) for region in REGIONS))
            for result in self.results
        ]
        return table(("", *REGIONS), rows)

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
