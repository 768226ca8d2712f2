"""The dependence of a prediction on the placement of skull landmarks (Kim et al. 2010, 3.3)."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from cmfsim.errors import CaseInputError, LandmarkInputError
from cmfsim.io import CaseOrPath, as_case
from cmfsim.pipeline.building.stages import BuildKeywords, build_options
from cmfsim.pipeline.building.tissue.muscles import with_muscles
from cmfsim.pipeline.predicting import build_patient
from cmfsim.solving.models import predict_patient
from cmfsim.values.case_parts import CaseMuscles
from cmfsim.values.checks import Floats, as_positive, as_rows
from cmfsim.values.musculature import Musculature
from cmfsim.values.patient_model import PatientModel
from cmfsim.values.prediction import Prediction
from cmfsim.values.progress import expected_stages

if TYPE_CHECKING:
    from typing_extensions import Unpack

# Standard deviation of a landmark's place along each axis that moves the masseter by the 2 mm of
# the paper's three trials, mm.
LANDMARK_SD = 2.0


@dataclass(frozen=True, eq=False)
class LandmarkTrial:
    """One trial: landmarks placed again, and what that changes, mm.

    landmark_deviation: Mean distance of the landmarks from those of the case.
    muscle_deviation: Mean distance of each muscle's vertices from where those put them.
    skin_deviation: (k,). Distance of each vertex of the predicted skin from that of the case.
    """

    landmarks: Mapping[str, Floats]
    landmark_deviation: float
    muscle_deviation: Mapping[str, float]
    skin_deviation: Floats

    def as_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        skin = self.skin_deviation
        return {
            "landmark_deviation": self.landmark_deviation,
            "muscle_deviation": dict(self.muscle_deviation),
            "skin": {
                "mean": float(skin.mean()),
                "std": float(skin.std()),
                "p95": float(np.percentile(skin, 95)),
                "max": float(skin.max()),
            },
            "landmarks": {name: point.tolist() for name, point in self.landmarks.items()},
        }


@dataclass(frozen=True, eq=False)
class SensitivityReport:
    """The effect of landmark errors on muscles and face.

    Attributes
    ----------
    prediction : Prediction
        With the case's own landmarks.
    trials : tuple of LandmarkTrial
    moved : (k,) bool
        Vertices of the skin that the operation moves by a tenth of its largest movement or more.
    """

    prediction: Prediction
    trials: tuple[LandmarkTrial, ...]
    moved: np.ndarray = field(repr=False)

    def muscle_deviation(self, part: str = "") -> float:
        """Mean over trials and the muscles whose name contains `part`, mm."""
        found = [d for t in self.trials for name, d in t.muscle_deviation.items() if part in name]
        if not found:
            raise CaseInputError(f"no muscle's name contains {part!r}")
        return float(np.mean(found))

    def skin_deviation(self, *, moved: bool = False) -> float:
        """Mean over trials and the skin, or the part of it that the operation moves, mm."""
        rows = self.moved if moved else slice(None)
        return float(np.mean([trial.skin_deviation[rows].mean() for trial in self.trials]))

    def as_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return {
            "case": self.prediction.name,
            "case_key": self.prediction.summary["case_key"],
            "model": self.prediction.model,
            "muscle_deviation": self.muscle_deviation(),
            "skin_deviation": self.skin_deviation(),
            "skin_deviation_moved": self.skin_deviation(moved=True),
            "trials": [trial.as_dict() for trial in self.trials],
        }


def landmark_trials(
    landmarks: Mapping[str, ArrayLike], *, count: int = 3, std: float = LANDMARK_SD, seed: int = 0
) -> Iterator[dict[str, Floats]]:
    """The landmarks with errors drawn from a normal distribution, one set per trial.

    Parameters
    ----------
    landmarks : mapping of str to (3,) float64, mm
    count : int
    std : float, mm
        Along each axis.
    seed : int
        Trial i of a seed does not depend on their number.

    Yields
    ------
    dict of str to (3,) float64, mm

    Examples
    --------
    >>> import cmfsim
    >>> trials = cmfsim.landmark_trials({"nasion": (0, 0, 0), "menton": (0, 0, -110)}, std=1.0)
    >>> [round(float(trial["nasion"][0]), 3) for trial in trials]
    [0.126, 0.103, -0.6]
    """
    as_positive("standard deviation of landmarks", std)
    names = list(landmarks)
    points = as_rows("landmarks", [np.asarray(landmarks[name]) for name in names], 3)
    for trial in range(count):
        drawn = np.random.default_rng([seed, trial]).normal(scale=std, size=points.shape)
        yield dict(zip(names, points + drawn, strict=True))


def sensitivity(
    case: CaseOrPath,
    *,
    trials: int | Sequence[Mapping[str, ArrayLike]] = 3,
    std: float = LANDMARK_SD,
    seed: int = 0,
    model: str = "M+S",
    **options: "Unpack[BuildKeywords]",
) -> SensitivityReport:
    """The effect of errors of skull landmarks on muscles and predicted face.

    The patient is built once; each trial maps the muscles again, samples them and solves.

    Parameters
    ----------
    case : Case, or path of its file or folder
    trials : int, or sequence of mapping of str to (3,) float64, mm
        Number of trials to draw, or the landmarks of each trial, as an operator placed them again.
    std : float, mm
        Of drawn trials, along each axis.
    seed : int
    model : str
        "M" or "M+S".
    **options
        As for `predict`.

    Raises
    ------
    CaseError
        (also `ValueError`) A homogeneous model, no trial.
    LandmarkError
        (also `ValueError`) A trial to which the template cannot be mapped.

    Examples
    --------
    >>> import cmfsim
    >>> report = cmfsim.sensitivity(cmfsim.Case.load("case.toml"))  # doctest: +SKIP
    >>> report.muscle_deviation("masseter"), report.skin_deviation()  # doctest: +SKIP
    (2.0, 0.05)
    """
    if not model.startswith("M"):
        raise CaseInputError(f"model {model!r} has no muscles for landmarks to move: use M or M+S")
    if (trials if isinstance(trials, int) else len(trials)) < 1:
        raise CaseInputError("no trial was given: at least one is needed")
    case = as_case(case)
    with build_options(options, expected_stages(f"solving {model}", "trial")) as asked:
        patient = build_patient(case, (model,), asked)
        skull = patient.landmarks.get("skull", {})
        if isinstance(trials, int):
            trials = list(landmark_trials(skull, count=trials, std=std, seed=seed))
        asked.observer.stage(f"solving {model}")
        prediction = predict_patient(patient, model)
        done = []
        for number, landmarks in enumerate(trials):
            asked.observer.stage(f"trial {number + 1} of {len(trials)}")
            done.append(_trial(prediction, case.muscles or CaseMuscles(), landmarks, model))
    moved = np.linalg.norm(prediction.skin_displacements, axis=1)
    return SensitivityReport(prediction, tuple(done), moved >= 0.1 * moved.max())


def _trial(
    prediction: Prediction, given: CaseMuscles, landmarks: Mapping[str, ArrayLike], model: str
) -> LandmarkTrial:
    patient: PatientModel = prediction.patient
    known = patient.landmarks["skull"]
    placed = {name: np.asarray(point, dtype=np.float64) for name, point in landmarks.items()}
    unknown = [name for name in placed if name not in known]
    if unknown:
        raise LandmarkInputError(
            f"a trial has the landmark {unknown[0]!r}, which the case does not have"
        )
    # A trial may place some landmarks again; the others stay.
    placed = {**known, **placed}
    changed = with_muscles(patient, given, landmarks=placed)
    again = predict_patient(changed, model)
    before, after = patient.muscles, changed.muscles
    if before is None or after is None:  # models with muscles have them
        raise AssertionError(model)
    apart = [np.linalg.norm(placed[name] - known[name]) for name in known]
    skin = np.linalg.norm(again.skin_displacements - prediction.skin_displacements, axis=1)
    return LandmarkTrial(
        MappingProxyType(placed), float(np.mean(apart)), _apart(before, after), skin
    )


def _apart(before: Musculature, after: Musculature) -> dict[str, float]:
    """Mean distance of each muscle's vertices from those of the same muscle, mm."""
    found = {}
    for muscle in before:
        moved = after[muscle.name].surface.vertices - muscle.surface.vertices
        found[muscle.name] = float(np.linalg.norm(moved, axis=1).mean())
    return found
