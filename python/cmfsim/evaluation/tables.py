"""The table of patients and models that Kim et al. (2010) print as Table 3."""

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from cmfsim.errors import CaseInputError
from cmfsim.evaluation.models import WHOLE, ModelComparison
from cmfsim.evaluation.statistics import DistanceStatistics, PairedTest, wilcoxon_test
from cmfsim.values.checks import as_text, check_one_of

# Columns of the CSV file after patient, region and model.
COLUMNS = (
    "count", "mean_mm", "std_mm", "median_mm", "rms_mm", "p90_mm", "p95_mm", "max_mm",
    "signed_mean_mm", "signed_std_mm", "outliers",
)  # fmt: skip
AVERAGE = "average"
# Stands where a patient has no figure.
NOTHING = "–"


@dataclass(frozen=True, eq=False)
class ErrorTable:
    """Errors of patients (rows) by models (columns), whole and by region.

    Attributes
    ----------
    patients, models, regions : tuple of str
        "whole" is the first region.
    cells : mapping of (patient, region, model) to DistanceStatistics
        Regions in which a patient has no vertex are absent, and so are models that failed.
    """

    patients: tuple[str, ...]
    models: tuple[str, ...]
    regions: tuple[str, ...]
    cells: Mapping[tuple[str, str, str], DistanceStatistics]

    def complete(self, region: str = WHOLE) -> tuple[str, ...]:
        """The patients with every model: models are averaged and tested over the same ones."""
        check_one_of("region", region, self.regions)
        return tuple(
            patient
            for patient in self.patients
            if all((patient, region, model) in self.cells for model in self.models)
        )

    def average(self, model: str, region: str = WHOLE) -> float:
        """The mean of the means of the complete patients, mm, each with the same weight.

        Raises
        ------
        CaseError
            (also `ValueError`) No patient has every model; an unknown model or region.
        """
        return float(np.mean(self._means(model, region)))

    def wilcoxon(self, first: str, second: str, region: str = WHOLE) -> PairedTest:
        """The signed-rank test of two models' mean errors, patient by patient."""
        return wilcoxon_test(self._means(first, region), self._means(second, region), by="patient")

    def rows(self) -> list[dict[str, Any]]:
        """A row for each patient, region and model, with plain values."""
        found = []
        for (patient, region, model), cell in self.cells.items():
            figures = cell.as_dict()
            row = {"patient": patient, "region": region, "model": model}
            row |= {name: figures[name] for name in COLUMNS}
            row |= {f"within_{k.replace(' ', '_')}": v for k, v in figures["within"].items()}
            found.append(row)
        return found

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as JSON holds them."""
        return {
            "patients": list(self.patients),
            "models": list(self.models),
            "regions": list(self.regions),
            "rows": self.rows(),
            "averages_mm": {
                region: {m: self.average(m, region) for m in self.models} for region in self.regions
            },
        }

    def csv(self) -> str:
        """The rows as comma-separated values, with a header."""
        rows = self.rows()
        text = io.StringIO()
        writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: _plain(value) for name, value in row.items()} for row in rows)
        return text.getvalue()

    def text(self, region: str = WHOLE) -> str:
        """Mean ± SD, 90th and 95th percentile, mm, as Table 3 of Kim et al. (2010) has them."""
        lines = self._lines(region)
        widths = [max(len(line[i]) for line in lines) for i in range(len(lines[0]))]
        return "\n".join(
            "   ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)).rstrip()
            for line in lines
        )

    def markdown(self, region: str = WHOLE) -> str:
        """The same as a table in Markdown."""
        head, *rows = self._lines(region)
        lines = [head, ["---", *["---:"] * len(self.models)], *rows]
        return "\n".join("| " + " | ".join(line) + " |" for line in lines)

    def _lines(self, region: str) -> list[list[str]]:
        """The cells of the table, its head first and the average last."""
        check_one_of("region", region, self.regions)
        lines = [[f"{region}, mm", *self.models]]
        for patient in self.patients:
            found = [self.cells.get((patient, region, model)) for model in self.models]
            cells = [
                NOTHING
                if cell is None
                else f"{cell.mean:.2f} ± {cell.std:.2f}  P90 {cell.p90:.2f}  P95 {cell.p95:.2f}"
                for cell in found
            ]
            lines.append([patient, *cells])
        whole, count = self.complete(region), len(self.patients)
        name = AVERAGE if len(whole) == count else f"{AVERAGE} of {len(whole)} of {count}"
        means = [f"{self.average(m, region):.2f}" if whole else NOTHING for m in self.models]
        return [*lines, [name, *means]]

    def _means(self, model: str, region: str) -> list[float]:
        check_one_of("model", model, self.models)
        patients = self.complete(region)
        if not patients:
            raise CaseInputError(
                f"no patient has an error of each of {', '.join(self.models)} in {region!r}, so "
                "there is nothing to average"
            )
        return [self.cells[patient, region, model].mean for patient in patients]


def error_table(patients: Mapping[str, ModelComparison]) -> ErrorTable:
    """The table of patients and models.

    Parameters
    ----------
    patients : mapping of str to ModelComparison
        Each with the same models.

    Raises
    ------
    CaseError
        (also `ValueError`) No patient, or patients with different models.

    Examples
    --------
    >>> import cmfsim
    >>> table = cmfsim.error_table({"P1": first, "P2": second})  # doctest: +SKIP
    >>> print(table.text("upper lip"))  # doctest: +SKIP
    >>> table.wilcoxon("H", "M+S").p  # doctest: +SKIP
    """
    if not patients:
        raise CaseInputError("there is no patient for the table")
    first = next(iter(patients.values()))
    models = tuple(first.statistics)
    regions = [WHOLE]
    cells: dict[tuple[str, str, str], DistanceStatistics] = {}
    for patient, comparison in patients.items():
        as_text("patient", patient)
        if set(comparison.statistics) != set(models):
            raise CaseInputError(
                f"patient {patient!r} has the models {', '.join(comparison.statistics)}, the "
                f"first has {', '.join(models)}: all patients need the same models"
            )
        table = {WHOLE: comparison.statistics, **comparison.regions}
        regions += [region for region in table if region not in regions]
        for region, by_model in table.items():
            for model in models:
                cells[patient, region, model] = by_model[model]
    return ErrorTable(tuple(patients), models, tuple(regions), MappingProxyType(cells))


def _plain(value: Any) -> Any:
    """A value that no spreadsheet takes for a formula."""
    formula = isinstance(value, str) and value[:1] in {"=", "+", "-", "@", "\t", "\r"}
    return f"'{value}" if formula else value
