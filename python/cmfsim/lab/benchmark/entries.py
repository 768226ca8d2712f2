"""The package's own entries: they predict a part of a population, each patient once.

The entry of published ratios moves skin landmarks with the bone by fixed shares, as planning in two
dimensions does. They are known for few landmarks; between these the face follows a thin-plate
spline.
"""

import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cmfsim._core import Surface, ThinPlateSpline
from cmfsim.errors import CaseInputError, CmfsimError
from cmfsim.io import replacing
from cmfsim.lab.benchmark.least_squares import learn_face
from cmfsim.lab.benchmark.patients import BenchmarkPatient
from cmfsim.lab.benchmark.skin_predictions import (
    SkinPrediction,
    read_skin_prediction,
    write_skin_prediction,
)
from cmfsim.pipeline.banding import predict_with_band
from cmfsim.pipeline.building.stages import BuildOptions
from cmfsim.pipeline.predicting import build_patient
from cmfsim.solving.models import predict_patient
from cmfsim.surfaces.barycentric import at_closest
from cmfsim.values.checks import Floats
from cmfsim.values.patient_model import PatientModel
from cmfsim.values.prediction import MODELS, Prediction

NO_CHANGE, RATIOS, LEARNED, HYPERELASTIC = "no-change", "ratios", "pls", "hyperelastic"
ENTRIES = (NO_CHANGE, RATIOS, LEARNED, *MODELS)
# Entries that are made only on request: they take longer.
ON_REQUEST = (HYPERELASTIC,)
# What the hyperelastic entry is but for its kinematics.
HYPERELASTIC_MODEL = "M+S"
FAILURE = ".failed.json"
TIMES = ".seconds"


@dataclass(frozen=True)
class Ratio:
    """The share of a bone's motion that a landmark of the skin follows.

    bone: The landmark of the skull whose planned motion counts.
    segments: Who carries it: the first of these that the plan moves.
    """

    skin: str
    bone: str
    segments: tuple[str, ...]
    forwards: float
    backwards: float


_UPPER = ("maxilla",)
_LOWER = ("mandible_body", "mandible")
_CHIN = ("chin", *_LOWER)
# Of 32 patients after Le Fort I and sagittal split, scanned in three dimensions (PMC6173856, 2018):
# pronasale 17 % and labiale superius 21 % of a maxilla advanced, 14 % of one set back; labiale
# inferius 66 % of the mandible. Of 26 patients after a setback (Angle Orthod 80:896, 2010):
# cheilion 3.4 mm where soft pogonion moved 6.7. Of 62 after an advancement with genioplasty
# (Veltkamp et al. 2002): soft pogonion thinned by 0.8 mm while bone came forward by 11 mm.
# They are of the sagittal motion, and are taken here for all three directions.
SKIN_RATIOS = (
    Ratio("pronasale", "supradentale", _UPPER, 0.17, 0.17),
    Ratio("labiale_superius", "supradentale", _UPPER, 0.21, 0.14),
    Ratio("cheilion_L", "infradentale", _LOWER, 0.51, 0.51),
    Ratio("cheilion_R", "infradentale", _LOWER, 0.51, 0.51),
    Ratio("labiale_inferius", "infradentale", _LOWER, 0.66, 0.66),
    Ratio("pogonion", "pogonion", _CHIN, 0.93, 0.93),
)
# Landmarks that jaws do not move.
STILL = ("nasion", "exocanthion_L", "exocanthion_R", "endocanthion_L", "endocanthion_R")
# Skin this far from the mouth stays, mm; so many of its points hold the spline.
FAR, ANCHORS = 80.0, 60
# Axis that points backwards.
BACK = 1


def predict_by_ratios(patient: BenchmarkPatient) -> Floats:
    """The displacement of each vertex of the skin, (v, 3) mm."""
    skin, landmarks = patient.skin, patient.landmarks
    mouth = 0.5 * (landmarks["cheilion_L"] + landmarks["cheilion_R"])
    far = np.linalg.norm(skin - mouth, axis=1) > FAR
    anchors = skin[far][:: max(1, int(far.sum()) // ANCHORS)]
    moved = np.array([landmarks[ratio.skin] for ratio in SKIN_RATIOS])
    still = np.vstack([[landmarks[name] for name in STILL], anchors])
    moves = np.array([_move(patient, ratio) for ratio in SKIN_RATIOS])
    spline = ThinPlateSpline(np.vstack([moved, still]), np.vstack([moved + moves, still]))
    displacement = spline(skin) - skin
    displacement[far] = 0.0
    return displacement


def _move(patient: BenchmarkPatient, ratio: Ratio) -> Floats:
    """How a landmark of the skin moves, mm."""
    place = patient.skull_landmarks[ratio.bone]
    matrix = patient.planned_motion(*ratio.segments)
    move = matrix[:3, :3] @ place + matrix[:3, 3] - place
    return (ratio.backwards if move[BACK] > 0.0 else ratio.forwards) * move


@dataclass(frozen=True)
class EntryFolder:
    """Where the predictions of a population are stored.

    folder: `predictions`, with a folder for each method.
    """

    folder: Path

    def file(self, method: str, patient: str, ending: str = ".npz") -> Path:
        """The file of a method and a patient."""
        return self.folder / method / f"{patient}{ending}"

    def is_made(self, method: str, patient: str, made_from: str, *, band: bool = False) -> bool:
        """Whether a prediction, or its failure, was made from the same, with a band if wanted."""
        file, failure = (self.file(method, patient, ending) for ending in (".npz", FAILURE))
        if failure.exists():
            return bool(json.loads(failure.read_text("utf-8")).get("made_from") == made_from)
        if not file.exists():
            return False
        found = read_skin_prediction(file)
        return found.made_from == made_from and (found.sd is not None or not band)

    def put(self, method: str, patient: BenchmarkPatient, prediction: SkinPrediction) -> None:
        """Writes a prediction in place of an earlier one or its failure."""
        self.file(method, patient.name, FAILURE).unlink(missing_ok=True)
        write_skin_prediction(self.file(method, patient.name), prediction)

    def fail(self, method: str, patient: BenchmarkPatient, reason: str, made_from: str) -> None:
        """Records why there is no prediction."""
        self.file(method, patient.name).unlink(missing_ok=True)
        path = self.file(method, patient.name, FAILURE)
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as file:
            text = json.dumps({"reason": reason, "made_from": made_from}, indent=1)
            file.write(text.encode())

    def reason(self, method: str, patient: str) -> str | None:
        """Why there is no prediction, if that was recorded."""
        path = self.file(method, patient, FAILURE)
        return str(json.loads(path.read_text("utf-8"))["reason"]) if path.exists() else None

    def took(self, method: str, patient: str, seconds: float) -> None:
        """Writes the run time of a prediction to a file of its own, as it differs in every run."""
        path = self.file(method, patient, TIMES)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"{seconds:.3f}\n", encoding="utf-8")


def times_of(folder: Path, method: str, patients: Sequence[str]) -> dict[str, float]:
    """The run times of predictions, s, where they were recorded: `PATIENT.seconds`.

    Raises `CaseError`: A file that does not contain a number.
    """
    found = {}
    for patient in patients:
        path = EntryFolder(folder).file(method, patient, TIMES)
        if path.exists():
            text = path.read_text(encoding="utf-8").strip()
            try:
                found[patient] = float(text)
            except ValueError as error:
                raise CaseInputError(f"{path}: {text[:40]!r}: must be a number, s") from error
    return found


def patient_entries(
    patient: str, folder: str, methods: Sequence[str], banded: Sequence[str] = ()
) -> None:
    """Predicts one patient by the entries that need no other patient.

    A model that fails is recorded with its reason.

    patient, folder: The patient's folder, and that of all predictions.
    banded: Models whose predictions state a standard deviation, from which a band is calibrated.
    """
    of = BenchmarkPatient(Path(patient).name, Path(patient))
    place, made_from = EntryFolder(Path(folder)), of.digest()
    simple: Mapping[str, Callable[[BenchmarkPatient], Floats]] = {
        NO_CHANGE: lambda p: np.zeros_like(p.skin),
        RATIOS: predict_by_ratios,
    }
    wanted = [m for m in methods if not place.is_made(m, of.name, made_from, band=m in banded)]
    for method in (m for m in wanted if m in simple):
        begun = time.perf_counter()
        moves = simple[method](of)
        place.put(method, of, SkinPrediction(of.skin, moves, made_from=made_from))
        place.took(method, of.name, time.perf_counter() - begun)
    models = [m for m in wanted if m in MODELS or m == HYPERELASTIC]
    if models:
        _by_models(of, place, models, banded, made_from)


def _by_models(
    patient: BenchmarkPatient,
    place: EntryFolder,
    models: Sequence[str],
    banded: Sequence[str],
    made_from: str,
) -> None:
    """The mechanical models: the patient is built once, and its time counts for each of them."""
    # The truth is never opened here.
    case = replace(patient.case, postoperative=None)
    begun = time.perf_counter()
    try:
        solved = [HYPERELASTIC_MODEL if model == HYPERELASTIC else model for model in models]
        built = build_patient(case, solved, BuildOptions(check=False))
    except CmfsimError as error:
        for model in models:
            place.fail(model, patient, str(error), made_from)
        return
    building = time.perf_counter() - begun
    for model in models:
        begun = time.perf_counter()
        try:
            if model == HYPERELASTIC:
                prediction = predict_patient(_hyperelastic(built), HYPERELASTIC_MODEL)
            elif model in banded:
                prediction = predict_with_band(built, model)
            else:
                prediction = predict_patient(built, model)
        except CmfsimError as error:
            place.fail(model, patient, str(error), made_from)
            continue
        place.put(model, patient, _entered(patient, prediction, made_from))
        place.took(model, patient.name, building + time.perf_counter() - begun)


def _hyperelastic(patient: PatientModel) -> PatientModel:
    """The patient, to be solved with finite strain."""
    options = replace(patient.scene.options, kinematics="hyperelastic")
    return replace(patient, scene=replace(patient.scene, options=options))


def _entered(patient: BenchmarkPatient, prediction: Prediction, made_from: str) -> SkinPrediction:
    """A prediction on the vertices of the patient's skin."""
    moves, band = prediction.carried(patient.skin), prediction.band
    if band is None:
        return SkinPrediction(patient.skin, moves, made_from=made_from)
    before = prediction.skin_before
    sd = at_closest(Surface(before.vertices, before.triangles), band.sd, patient.skin)
    settings = json.dumps(dict(band.settings), sort_keys=True)
    return SkinPrediction(patient.skin, moves, sd=sd, settings=settings, made_from=made_from)


def check_own(method: str, prediction: SkinPrediction, patient: BenchmarkPatient) -> None:
    """Refuses an entry of the package made by another version, or for an earlier patient.

    Raises `CaseError`.
    """
    own = (*ENTRIES, *ON_REQUEST)
    if method in own and not prediction.made_from.endswith(patient.digest()):
        raise CaseInputError(
            "was made by another version, or before the patient was made again: predict it "
            f"again (--entries {method}), or rename your own method"
        )


def learned_entries(
    training: Sequence[BenchmarkPatient], patients: Sequence[BenchmarkPatient], folder: Path
) -> None:
    """Predicts patients by the learned entry; none of them may be in the training part.

    If there is nothing to learn from, the entry is recorded as failed.

    Raises `CaseError`: A patient to predict is in the training part.
    """
    both = {patient.name for patient in training} & {patient.name for patient in patients}
    if both:
        raise CaseInputError(
            f"{', '.join(sorted(both))}: not predicted, because they are in the training part"
        )
    taught = hashlib.sha256("".join(p.digest(truth=True) for p in training).encode()).hexdigest()
    place = EntryFolder(folder)
    made_from = {patient.name: f"{taught} {patient.digest()}" for patient in patients}
    wanted = [p for p in patients if not place.is_made(LEARNED, p.name, made_from[p.name])]
    if not wanted:
        return
    try:
        learned = learn_face(training)
    except CmfsimError as error:
        for patient in wanted:
            place.fail(LEARNED, patient, str(error), made_from[patient.name])
        return
    for patient in wanted:
        begun = time.perf_counter()
        prediction = SkinPrediction(
            patient.skin, learned.predict(patient), made_from=made_from[patient.name]
        )
        place.put(LEARNED, patient, prediction)
        place.took(LEARNED, patient.name, time.perf_counter() - begun)
