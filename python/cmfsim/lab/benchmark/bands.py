"""Bands of methods that state a standard deviation, calibrated on a part they are not scored on."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cmfsim.errors import CaseInputError
from cmfsim.evaluation import calibrate, cases_needed, region_scores
from cmfsim.io.results.calibrations import write_calibration
from cmfsim.lab.benchmark.entries import EntryFolder, check_own
from cmfsim.lab.benchmark.patients import BenchmarkPatient
from cmfsim.lab.benchmark.skin_predictions import SkinPrediction, read_skin_prediction
from cmfsim.values.calibration import BandFactor, Calibration, CalibrationCase

# The share of patients that a band must cover in each region.
COVERAGE = 0.9
GROUP = "virtual"
NOTE = "in silico: {n} drawn virtual patients, {settings}"


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
