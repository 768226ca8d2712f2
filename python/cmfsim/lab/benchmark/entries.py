"""The package's own entries: they predict a part of a population, each patient once.

The entry of published ratios moves skin landmarks with the bone by fixed shares, as planning in two
dimensions does. They are known for few landmarks; between these the face follows a thin-plate
spline.

The entry that learns does so by partial least squares from the planned motion to that of the skin:
it knows the patients of the training part with their true faces, and no mechanics.
"""

import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cmfsim._core import Surface, ThinPlateSpline
from cmfsim.errors import CaseInputError, CmfsimError, third_party
from cmfsim.io.files.summaries import kept_record, write_record
from cmfsim.lab.benchmark.entry_names import (
    ENTRIES,
    HYPERELASTIC,
    LEARNED,
    NO_CHANGE,
    ON_REQUEST,
    RATIOS,
)
from cmfsim.lab.benchmark.patients import (
    BenchmarkPatient,
    SkinPrediction,
    read_skin_prediction,
    write_skin_prediction,
)
from cmfsim.pipeline.banding import predict_with_band
from cmfsim.pipeline.building.stages import BuildOptions
from cmfsim.pipeline.predicting import build_patient
from cmfsim.solving.models import predict_patient
from cmfsim.surfaces.depth import at_closest
from cmfsim.values.checks import Floats
from cmfsim.values.landmark_sites import SKIN_LANDMARKS
from cmfsim.values.prediction import MODELS, Prediction

# Fewer patients than this teach nothing: one is left out at a time to choose the components.
LEAST_TRAINED = 4
MOST_COMPONENTS = 8
# Points of the skin that are compared from person to person: of the vertices within a distance of
# the face, mm, about one for each so many mm².
AROUND, AREA = 30.0, 30.0
# A vertex follows so many of these points; from one distance off them on it fades, and beyond the
# other it stays, mm.
NEAREST, FOLLOWS, FADED = 4, 6.0, 20.0
# The plan in numbers: the motions of these landmarks of the skull, by what may carry them.
BODY = ("mandible_body", "mandible")
FEATURES = {
    "supradentale": ("maxilla",), "supra_m2_L": ("maxilla",), "supra_m2_R": ("maxilla",),
    "infradentale": BODY, "sub_m2_L": BODY, "sub_m2_R": BODY, "pogonion": ("chin", *BODY),
    "menton": ("chin", *BODY),
}  # fmt: skip
# What the hyperelastic entry is but for its kinematics.
HYPERELASTIC_MODEL = "M+S"
FAILURE = ".failed.json"
TIMES = ".seconds"


@dataclass(frozen=True, eq=False)
class PartialLeastSquares:
    """A linear map by partial least squares (SIMPLS, de Jong 1993), with means (p,) and (q,)."""

    mean_x: Floats
    mean_y: Floats
    coefficients: Floats

    @classmethod
    def fit(cls, x: Floats, y: Floats, components: int) -> "PartialLeastSquares":
        """The map that leads from the rows of x (n, p) to those of y (n, q).

        Columns are centred, not scaled. With as many components as x has rank, it is least squares.
        """
        mean_x, mean_y = x.mean(axis=0), y.mean(axis=0)
        centred = x - mean_x
        covariance = centred.T @ (y - mean_y)
        least = np.finfo(np.float64).eps * float(np.abs(covariance).max(initial=0.0))
        weights, loads, basis = [], [], np.zeros((x.shape[1], 0))
        for _ in range(components):
            weight = np.linalg.svd(covariance, full_matrices=False)[0][:, 0]
            values = centred @ weight
            size = float(np.linalg.norm(values))
            if size <= least or float(np.abs(covariance).max()) <= least:
                break
            weight, values = weight / size, values / size
            load = centred.T @ values
            direction = load - basis @ (basis.T @ load)
            direction /= np.linalg.norm(direction)
            basis = np.column_stack([basis, direction])
            covariance = covariance - basis @ (basis.T @ covariance)
            weights.append(weight)
            loads.append((y - mean_y).T @ values)
        if not weights:
            return cls(mean_x, mean_y, np.zeros((x.shape[1], y.shape[1])))
        return cls(mean_x, mean_y, np.column_stack(weights) @ np.column_stack(loads).T)

    def __call__(self, x: Floats) -> Floats:
        """The image of each row of x, (n, q)."""
        return self.mean_y + (x - self.mean_x) @ self.coefficients


@dataclass(frozen=True, eq=False)
class LearnedFace:
    """The model learned from the training part.

    landmarks: (14, 3), mm, of the skin of the person whose points (k, 3), mm, are compared.
    map: From the plan in numbers to the displacements of the points.
    components: Chosen within the training part, each patient left out once.
    """

    landmarks: Floats
    points: Floats
    map: PartialLeastSquares
    components: int

    def predict(self, patient: BenchmarkPatient) -> Floats:
        """The displacement of each vertex of a patient's skin, (v, 3) mm."""
        places = patient.skin[_partners(patient, self.landmarks, self.points)]
        moves = self.map(patient.planned_moves(FEATURES)[None]).reshape(-1, 3)
        away, near = _tree(places).query(patient.skin, k=NEAREST)
        weights = 1.0 / np.maximum(away, 1e-3)
        weights /= weights.sum(axis=1, keepdims=True)
        share = np.clip((FADED - away[:, 0]) / (FADED - FOLLOWS), 0.0, 1.0)
        moved: Floats = share[:, None] * np.einsum("vk,vki->vi", weights, moves[near])
        return moved


def learn_face(patients: Sequence[BenchmarkPatient]) -> LearnedFace:
    """The training data of the patients of a part; an error if they are fewer than four."""
    if len(patients) < LEAST_TRAINED:
        raise CaseInputError(
            f"the training part has {len(patients)} patients with a truth: {LEAST_TRAINED} are "
            "needed to learn from"
        )
    first = patients[0]
    landmarks, skin = _landmarks(first), first.skin
    near = _tree(skin[first.regions["face"]]).query(skin)[0] < AROUND
    each = max(1, round(AREA * len(skin) / first.surface.area))
    points = skin[near][::each]
    x = np.array([patient.planned_moves(FEATURES) for patient in patients])
    y = np.array([p.truth[_partners(p, landmarks, points)].ravel() for p in patients])
    components = _components(x, y)
    return LearnedFace(landmarks, points, PartialLeastSquares.fit(x, y, components), components)


def _components(x: Floats, y: Floats) -> int:
    """The number with the least error on patients who are left out one at a time."""
    most = min(MOST_COMPONENTS, len(x) - 2)
    errors = np.zeros(most)
    for out in range(len(x)):
        rest = np.arange(len(x)) != out
        for count in range(1, most + 1):
            found = PartialLeastSquares.fit(x[rest], y[rest], count)(x[out : out + 1])
            errors[count - 1] += float(((found - y[out]) ** 2).sum())
    return int(errors.argmin()) + 1


def _landmarks(patient: BenchmarkPatient) -> Floats:
    return np.array([patient.landmarks[name] for name in SKIN_LANDMARKS])


def _partners(patient: BenchmarkPatient, landmarks: Floats, points: Floats) -> NDArray[np.intp]:
    """The vertex of a patient's skin that answers to each point of another's."""
    spline = ThinPlateSpline(landmarks, _landmarks(patient))
    nearest: NDArray[np.intp] = _tree(patient.skin).query(spline(points))[1]
    return nearest


def _tree(points: Floats):  # type: ignore[no-untyped-def]
    spatial = third_party("scipy.spatial", "faces are learned", "study")
    return spatial.cKDTree(points)


@dataclass(frozen=True)
class Ratio:
    """The share of a bone's motion that a landmark of the skin follows.

    The landmark `bone` of the skull moves with the first of the segments that the plan moves.
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
    moves = np.array([patient.planned_moves({r.bone: r.segments}) for r in SKIN_RATIOS])
    pairs = zip(SKIN_RATIOS, moves, strict=True)
    shares = [r.backwards if move[BACK] > 0.0 else r.forwards for r, move in pairs]
    moves = np.array(shares)[:, None] * moves
    spline = ThinPlateSpline(np.vstack([moved, still]), np.vstack([moved + moves, still]))
    displacement = spline(skin) - skin
    displacement[far] = 0.0
    return displacement


@dataclass(frozen=True)
class EntryFolder:
    """Where the predictions of a population are stored: a folder for each method."""

    folder: Path

    def file(self, method: str, patient: str, ending: str = ".npz") -> Path:
        """The file of a method and a patient."""
        return self.folder / method / f"{patient}{ending}"

    def is_made(self, method: str, patient: str, made_from: str, *, band: bool = False) -> bool:
        """Whether a prediction, or its failure, was made from the same, with a band if wanted."""
        file, failure = (self.file(method, patient, ending) for ending in (".npz", FAILURE))
        if failure.exists():
            return kept_record(failure, made_from=made_from) is not None
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
        record = {"reason": reason, "made_from": made_from}
        write_record(self.file(method, patient.name, FAILURE), record)

    def reason(self, method: str, patient: str) -> str | None:
        """Why there is no prediction, if that was recorded."""
        record = kept_record(self.file(method, patient, FAILURE))
        return None if record is None else str(record["reason"])

    def took(self, method: str, patient: str, seconds: float) -> None:
        """Writes the run time of a prediction to a file of its own, as it differs in every run."""
        path = self.file(method, patient, TIMES)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"{seconds:.3f}\n", encoding="utf-8")


def times_of(folder: Path, method: str, patients: Sequence[str]) -> dict[str, float]:
    """The run times of predictions, s, where they were recorded: `PATIENT.seconds`."""
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
    """Predicts one patient by the entries that need no other; a failed model is recorded with why.

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
                options = replace(built.scene.options, kinematics="hyperelastic")
                strained = replace(built, scene=replace(built.scene, options=options))
                prediction = predict_patient(strained, HYPERELASTIC_MODEL)
            elif model in banded:
                prediction = predict_with_band(built, model)
            else:
                prediction = predict_patient(built, model)
        except CmfsimError as error:
            place.fail(model, patient, str(error), made_from)
            continue
        place.put(model, patient, _entered(patient, prediction, made_from))
        place.took(model, patient.name, building + time.perf_counter() - begun)


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
    """Refuses an entry of the package made by another version, or for an earlier patient."""
    own = (*ENTRIES, *ON_REQUEST)
    if method in own and not prediction.made_from.endswith(patient.digest()):
        raise CaseInputError(
            "was made by another version, or before the patient was made again: predict it "
            f"again (--entries {method}), or rename your own method"
        )


def learned_entries(
    training: Sequence[BenchmarkPatient], patients: Sequence[BenchmarkPatient], folder: Path
) -> None:
    """Predicts patients by the learned entry; an error if one of them is in the training part.

    If there is nothing to learn from, the entry is recorded as failed.
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
