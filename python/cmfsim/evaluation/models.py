"""Models compared on each patient, and the table that Kim et al. (2010) print as Table 3."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim._core import Surface, SurfaceMotion
from cmfsim.errors import CaseInputError
from cmfsim.evaluation.comparison import Choice, Landmarks, SkinComparison, compare_skins
from cmfsim.evaluation.regions import skin_regions
from cmfsim.evaluation.statistics import (
    LENGTHS,
    DistanceStatistics,
    PairedTest,
    distance_statistics,
    wilcoxon_test,
)
from cmfsim.surfaces.depth import moved_outward
from cmfsim.values.checks import Floats, as_rows, as_text, brief, check_one_of, frozen, plain
from cmfsim.values.landmark_sites import SKIN_LANDMARKS
from cmfsim.values.surface_data import SurfaceData
from cmfsim.values.table import NOTHING, Table, csv_of

# The pre-operative skin taken as a prediction: what any model must beat.
NO_CHANGE = "no change"
# Name of the whole evaluated part, next to the names of regions.
WHOLE = "whole"
# Columns of the CSV file after patient, region and model.
COLUMNS = ("count", *(f"{name}_mm" for name in LENGTHS), "outliers")
AVERAGE = "average"


@dataclass(frozen=True)
class Improvement:
    """The gain of a prediction over leaving the face unchanged, on the same vertices.

    Attributes
    ----------
    before, after : float, mm
        Mean |distance| of the pre-operative skin, and of the prediction.
    share_better : float
        Share of vertices at which the prediction is closer.
    """

    before: float
    after: float
    share_better: float

    @property
    def gain(self) -> float:
        """Reduction of the mean |distance|, mm; negative if the prediction is worse."""
        return self.before - self.after

    def as_dict(self) -> dict[str, float]:
        """Plain values with their unit in the name."""
        return {
            "no_change_mm": self.before,
            "prediction_mm": self.after,
            "gain_mm": self.gain,
            "share_better": self.share_better,
        }


@dataclass(frozen=True, eq=False)
class ModelComparison:
    """Predictions of one patient by several models, evaluated at the same vertices.

    Attributes
    ----------
    comparisons : mapping of str to SkinComparison
        By model, with "no change" for the pre-operative skin, each with all its own vertices.
    vertices : (k,) uint32
        Vertices that were evaluated in every comparison.
    errors : mapping of str to (k,) float64, mm
        Signed distances at those vertices, by model.
    statistics : mapping of str to DistanceStatistics
        Of `errors`.
    regions : mapping of str to mapping of str to DistanceStatistics
        By region, then by model.
    improvements : mapping of str to mapping of str to Improvement
        By model, then by region, with "whole" for all vertices.
    """

    comparisons: Mapping[str, SkinComparison]
    vertices: NDArray[np.uint32]
    errors: Mapping[str, Floats]
    statistics: Mapping[str, DistanceStatistics]
    regions: Mapping[str, Mapping[str, DistanceStatistics]]
    improvements: Mapping[str, Mapping[str, Improvement]]

    __repr__ = brief

    @property
    def models(self) -> tuple[str, ...]:
        """The models, without "no change"."""
        return tuple(name for name in self.errors if name != NO_CHANGE)

    def wilcoxon(self, first: str, second: str) -> PairedTest:
        """The signed-rank test of two models' |distances|, vertex by vertex.

        Parameters
        ----------
        first, second : str
            Models, or "no change".
        """
        for name in (first, second):
            check_one_of("model", name, tuple(self.errors))
        return wilcoxon_test(np.abs(self.errors[first]), np.abs(self.errors[second]))

    def as_dict(self) -> dict[str, Any]:
        """Plain values with units in their names, as JSON holds them; no arrays, no tests."""
        return {
            "n_common_vertices": len(self.vertices),
            "models": plain(self.statistics),
            "regions": plain(self.regions),
            "improvements": plain(self.improvements),
            "comparisons": plain(self.comparisons),
        }


def compare_models(
    preoperative: SurfaceData | Surface,
    predictions: Mapping[str, ArrayLike],
    postoperative: SurfaceData | Surface,
    *,
    landmarks: tuple[Landmarks, Landmarks] | None = None,
    method: str | None = None,
    mask: Choice = None,
    regions: Mapping[str, NDArray[np.bool_]] | None = None,
    thickening: Floats | None = None,
) -> ModelComparison:
    """Comparison of several models with the post-operative skin, and with no change.

    Parameters
    ----------
    preoperative : SurfaceData or Surface
        The skin before the operation.
    predictions : mapping of str to (v, 3) float64, mm
        Predicted positions of the vertices of that skin: vertices plus displacements.
    postoperative : SurfaceData or Surface
    landmarks : (landmarks, landmarks), optional
        Of the *pre-operative* and of the post-operative skin; the first follow each prediction.
    method, mask
        As in `compare_skins`. Regions and the mask "face" are placed on the pre-operative skin, so
        that they contain the same vertices for every model.
    regions : mapping of str to (v,) bool, optional
        Parts of the pre-operative skin; default: `skin_regions` where the landmarks have their
        names.
    thickening : (v,) float64, mm, optional
        How far each vertex is moved outward, along its normal, before anything is compared: in
        every prediction, and in "no change" (`fitted_thickness`).

    Raises
    ------
    CaseError
        (also `ValueError`) No prediction, another number of vertices, the name "no change".
    RegistrationError, LandmarkError, MeshError
        (also `ValueError`) As in `compare_skins`; no vertex that all comparisons share.

    Examples
    --------
    >>> import cmfsim
    >>> found = cmfsim.compare_models(
    ...     before, {"H": moved_h, "M+S": moved_ms}, after, landmarks=(marks_before, marks_after)
    ... )  # doctest: +SKIP
    >>> found.improvements["M+S"]["upper lip"].gain  # doctest: +SKIP
    """
    if not predictions:
        raise CaseInputError("there is no prediction to compare")
    skin, after = (
        given if isinstance(given, Surface) else given.searched
        for given in (preoperative, postoperative)
    )
    moved = {NO_CHANGE: skin.vertices}
    for name, vertices in predictions.items():
        if as_text("model", name) == NO_CHANGE:
            raise CaseInputError(f"{NO_CHANGE!r} is the pre-operative skin: rename the model")
        moved[name] = as_rows(f"prediction {name!r}", vertices, 3)
        if len(moved[name]) != len(skin.vertices):
            raise CaseInputError(
                f"prediction {name!r} has {len(moved[name])} vertices, the pre-operative skin "
                f"{len(skin.vertices)}: both must have the same vertices in the same order"
            )
    if thickening is not None:
        moved = {name: moved_outward(skin, at, thickening) for name, at in moved.items()}
    names = landmarks[0] if landmarks is not None else None
    parts: dict[str, NDArray[np.bool_]] = dict(regions or {})
    if regions is None and isinstance(names, Mapping) and all(n in names for n in SKIN_LANDMARKS):
        parts = skin_regions(skin.vertices, names)
    chosen = parts[mask] if isinstance(mask, str) and mask in parts else mask
    comparisons = {
        name: compare_skins(
            skin.moved(vertices),
            after,
            landmarks=_carried(landmarks, skin, vertices),
            method=method,
            mask=chosen,
            regions=parts,
        )
        for name, vertices in moved.items()
    }
    return _side_by_side(comparisons, parts)


def _side_by_side(
    comparisons: Mapping[str, SkinComparison], parts: Mapping[str, NDArray[np.bool_]]
) -> ModelComparison:
    common = next(iter(comparisons.values())).vertices
    for comparison in comparisons.values():
        common = np.intersect1d(common, comparison.vertices)
    if not len(common):
        raise CaseInputError("no vertex was evaluated in every comparison: use a smaller mask")
    errors = {
        name: frozen(c.signed[np.searchsorted(c.vertices, common)])
        for name, c in comparisons.items()
    }
    inside = {name: part[common] for name, part in parts.items() if part[common].any()}
    whole = {WHOLE: np.ones(len(common), dtype=bool)}

    def figures(part: NDArray[np.bool_] | slice) -> Mapping[str, DistanceStatistics]:
        found = {name: distance_statistics(e[part]) for name, e in errors.items()}
        return MappingProxyType(found)

    def gains(name: str) -> Mapping[str, Improvement]:
        found = {}
        for region, chosen in (whole | inside).items():
            before, after = np.abs(errors[NO_CHANGE][chosen]), np.abs(errors[name][chosen])
            better = float((after < before).mean())
            found[region] = Improvement(float(before.mean()), float(after.mean()), better)
        return MappingProxyType(found)

    return ModelComparison(
        comparisons=MappingProxyType(dict(comparisons)),
        vertices=frozen(common),
        errors=MappingProxyType(errors),
        statistics=figures(slice(None)),
        regions=MappingProxyType({region: figures(part) for region, part in inside.items()}),
        improvements=MappingProxyType({n: gains(n) for n in errors if n != NO_CHANGE}),
    )


def _carried(
    landmarks: tuple[Landmarks, Landmarks] | None, skin: Surface, moved: Floats
) -> tuple[Landmarks, Landmarks] | None:
    """The landmarks of the pre-operative skin where a prediction takes them."""
    if landmarks is None:
        return None
    first, second = landmarks
    motion = SurfaceMotion(skin, moved)
    if isinstance(first, Mapping):
        places = np.array(list(first.values()), dtype=np.float64)
        there = places + motion.displacement(places)
        return dict(zip(first, there, strict=True)), second
    places = as_rows("landmarks", first, 3)
    return places + motion.displacement(places), second


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
        return csv_of(self.rows())

    def text(self, region: str = WHOLE) -> str:
        """Mean ± SD, 90th and 95th percentile, mm, as Table 3 of Kim et al. (2010) has them."""
        return self._table(region, numeric=False).text

    def markdown(self, region: str = WHOLE) -> str:
        """The same as a table in Markdown."""
        return self._table(region, numeric=True).markdown

    def _table(self, region: str, *, numeric: bool) -> Table:
        check_one_of("region", region, self.regions)
        rows = []
        for patient in self.patients:
            found = [self.cells.get((patient, region, model)) for model in self.models]
            cells = [
                NOTHING
                if cell is None
                else f"{cell.mean:.2f} ± {cell.std:.2f}  P90 {cell.p90:.2f}  P95 {cell.p95:.2f}"
                for cell in found
            ]
            rows.append((patient, *cells))
        whole, count = self.complete(region), len(self.patients)
        name = AVERAGE if len(whole) == count else f"{AVERAGE} of {len(whole)} of {count}"
        means = [f"{self.average(m, region):.2f}" if whole else NOTHING for m in self.models]
        columns = (f"{region}, mm", *self.models)
        return Table(columns, [*rows, (name, *means)], numeric=numeric, gap="   ")

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
