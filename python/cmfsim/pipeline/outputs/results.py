"""The outputs of commands on cases: predictions with pictures, errors, and their report.

All files of a command take their places together at its end: whoever reads the folder finds the
results of one run. What belongs to another plan, or to other inputs or another version, goes.
"""

import contextlib
import logging
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cmfsim.errors import CaseInputError, CmfsimError
from cmfsim.evaluation.models import error_table
from cmfsim.io import Case, replace_text, replacing_files
from cmfsim.io.cases.case_files import CASE_FILE
from cmfsim.io.files.summaries import hashes_of, write_summary
from cmfsim.io.images.dicom_series import write_dicom_pdf
from cmfsim.io.results.predictions import (
    check_own,
    fill_prediction,
    is_prediction_file,
    is_result_file,
    predictions_of,
    read_face_colours,
    read_parts,
    read_prediction,
    read_prediction_picture,
    stale_results,
    write_timings,
)
from cmfsim.io.results.result_files import (
    CHART_PAGE_FILE,
    DICOM_PAGE_FILE,
    EVALUATION_FILE,
    REPORT_FILE,
    read_evaluation,
    read_evaluation_picture,
    skin_errors_file,
    write_skin_errors,
)
from cmfsim.io.slicer.output import SLICER_FILE, write_slicer_bundle
from cmfsim.pictures import (
    Picture,
    band_picture,
    chart_errors,
    contacts_picture,
    picture_distances,
    picture_muscles,
    plan_picture,
    prediction_picture,
)
from cmfsim.pictures.canvas import Painter
from cmfsim.pictures.charts import write_figure
from cmfsim.pictures.faces import animate_face
from cmfsim.pictures.lateral import LateralView, picture_lateral
from cmfsim.pipeline.banding import face_motion
from cmfsim.pipeline.building.inputs import input_hash
from cmfsim.pipeline.building.stages import BuildKeywords
from cmfsim.pipeline.evaluating import CaseEvaluation
from cmfsim.pipeline.planning import PAGE_FILE, page_state
from cmfsim.planning.face_measures.clinical_figures import clinical_figures, lateral_sites
from cmfsim.planning.face_measures.occlusion import poor_bite
from cmfsim.planning.face_view import face_view
from cmfsim.planning.occlusion.contacts import ContactMap, planned_contacts
from cmfsim.report.case import case_document, findings_of
from cmfsim.report.chart_page import A4, draw_chart_page
from cmfsim.report.document import Document, Figure
from cmfsim.report.page import render_page
from cmfsim.solving.models import planned_motions
from cmfsim.values.anatomy import BoneSegment
from cmfsim.values.finding import Finding
from cmfsim.values.musculature import Musculature
from cmfsim.values.patient_model import PatientModel
from cmfsim.values.prediction import MODELS, Prediction
from cmfsim.values.progress import Progress
from cmfsim.values.surface_data import SurfaceData, joined_surface

_log = logging.getLogger(__name__)

# Predictions, or what gives them and calls functions with what is known before it solves any.
Predictions = Iterable[Prediction] | Callable[[BuildKeywords], Iterable[Prediction]]

# Pictures of a case's report, in the folder of its prediction and in its own.
PREDICTION_PICTURES = ("prediction", "lateral", "band", "plan", "contacts", "muscles")
MUSCLES = "muscles.png"
REPORT_STAGE = "writing the report"
BOXES_CAPTION = (
    "Sizes of the errors by region: quartiles, median, mean (diamond), whiskers to 1.5 boxes, and "
    "beyond them each outlier, with their number above (as the paper's Figure 9)."
)
ERROR_CAPTION = (
    "Model {}: signed distance from the face after the operation, −5 to 5 mm; blue where the "
    "prediction lies behind it, grey where nothing was evaluated (the paper's Figure 10)."
)


@dataclass(frozen=True)
class WrittenPrediction:
    """The files of a prediction, from the output folder, and its summary."""

    place: str
    files: list[str]
    summary: Mapping[str, Any]


@dataclass
class WrittenResults:
    """What was written to an output folder, in the order in which predictions were solved.

    files: Of a comparison, its report included.
    left_out: Files that were removed, since they belonged to something else.
    """

    predictions: list[WrittenPrediction] = field(default_factory=list)
    files: list[str] = field(default_factory=list)
    report: str | None = None
    left_out: list[str] = field(default_factory=list)

    @property
    def findings(self) -> list[Finding]:
        """Those of all predictions, with what their figures showed."""
        entries = [f for entry in self.predictions for f in entry.summary["findings"]]
        return [Finding.from_values(entry) for entry in entries]


@dataclass
class _Clock:
    """Seconds of each stage of the prediction at a place, or where that is None of all of them."""

    seconds: dict[str, dict[str, float]] = field(default_factory=dict)
    place: str | None = None
    _within: float = 0.0

    def begin(self, place: str, seconds: Mapping[str, float]) -> None:
        """Goes on to a prediction, which took some seconds."""
        self.place, self.seconds[place] = place, dict(seconds)

    @contextlib.contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Adds a stage; one within another counts once."""
        begun, outer = time.perf_counter(), self._within
        self._within = 0.0
        try:
            yield
        finally:
            took = time.perf_counter() - begun
            for place in self.seconds if self.place is None else [self.place]:
                before = self.seconds[place].get(name, 0.0)
                self.seconds[place][name] = before + took - self._within
            self._within = outer + took

    def write(self, fresh: Path) -> None:
        """Writes the timings of each prediction below a folder."""
        for place, of_prediction in self.seconds.items():
            write_timings(fresh / place, of_prediction)


class _Drawing:
    """The pictures of predictions as they are begun, in a folder for each of several models."""

    def __init__(
        self, painter: Painter, fresh: Path, models: Sequence[str], wanted: Callable[[str], bool]
    ) -> None:
        self._painter, self._fresh = painter, fresh
        self._models, self._wanted = models, wanted
        self._begun: dict[tuple[str, str], Future[None]] = {}
        self._contacts: dict[PatientModel, ContactMap | dict[str, Any]] = {}

    def place(self, model: str) -> str:
        """The folder of a model's prediction."""
        return "" if len(self._models) == 1 else model

    def contacts(self, patient: PatientModel) -> ContactMap | dict[str, Any]:
        """The contacts of the planned tooth rows, or why they are not known."""
        if patient not in self._contacts:
            try:
                self._contacts[patient] = planned_contacts(patient)
            except CmfsimError as error:
                self._contacts[patient] = {"absent": str(error)}
        return self._contacts[patient]

    def begin_muscles(self, muscles: Musculature, segments: Sequence[BoneSegment]) -> None:
        """Begins the muscles of the first model that shows them: they need no solution."""
        model = next((m for m in self._models if m.startswith("M") and self._wanted(m)), None)
        if model is not None:
            self._start(model, MUSCLES, _muscles_picture(muscles, segments))

    def begin_planned(self, patient: PatientModel) -> None:
        """Begins what the first model shows without its solution, while it is solved."""
        model = next(filter(self._wanted, self._models), None)
        if model is not None:
            for name, picture in _pictures_of(patient, self.contacts(patient)):
                self._start(model, name, picture)

    def begin(self, prediction: Prediction) -> dict[str, "Future[None]"]:
        """The pictures of a prediction by name, with those that were begun early."""
        model, patient = prediction.model, prediction.patient
        if not self._wanted(model):
            return {}
        pictures = _pictures_of(patient, self.contacts(patient), prediction)
        return {name: self._start(model, name, picture) for name, picture in pictures}

    def early(self) -> BuildKeywords:
        """What a build is to call, so that pictures begin before a model is solved."""
        return {"on_muscles": self.begin_muscles, "on_built": self.begin_planned}

    def _start(self, model: str, name: str, picture: Picture) -> "Future[None]":
        if (model, name) not in self._begun:
            folder = self._fresh / self.place(model)
            folder.mkdir(exist_ok=True)
            self._begun[model, name] = self._painter.begin(picture, folder / name)
        return self._begun[model, name]


def write_results(
    output: Path,
    predictions: Predictions,
    models: Sequence[str],
    *,
    stage: Progress,
    evaluation: Callable[[], CaseEvaluation] | None = None,
    with_report: bool = True,
    pictures: Callable[[str], bool] = lambda _: True,
    slicer: bool = False,
) -> WrittenResults:
    """What was written of predictions, their comparison and the report of both.

    output: The case's output folder: predictions of several models lie in a folder for each.
    predictions: Written one by one, as each is solved. A callable gives them; it takes the
        functions to be called with what is known before any is solved, which begin pictures.
    models: That were asked for, whether or not all could be predicted.
    evaluation: Gives the comparison, once the predictions are there.
    pictures: Whether those of a model are drawn, by its name.
    slicer: Whether each prediction is written as a bundle for 3D Slicer as well, `prediction.mrb`.
    Raises what a prediction or a file ends in; the folder is then as it was.
    """
    check_own(output)
    written = WrittenResults()
    clock = _Clock()

    def fill(fresh: Path) -> list[str]:
        drawing = _Drawing(painter, fresh, models, pictures)
        for prediction in predictions(drawing.early()) if callable(predictions) else predictions:
            stage(f"writing {prediction.model}")
            written.predictions.append(
                _fill_model(fresh, prediction, clock, drawing=drawing, slicer=slicer)
            )
        clock.place = None
        compared: Mapping[str, Any] | None
        if evaluation is not None:
            stage("writing the comparison")
            compared = _fill_evaluation(fresh, evaluation())
            written.files = [*compared["files"], EVALUATION_FILE]
        else:
            compared = _earlier_evaluation(output, written.predictions[0].summary["case_key"])
        if with_report:
            stage(REPORT_STAGE)
            with clock.timed(REPORT_STAGE):
                written.report = _report_of(fresh, output, written, compared)
        clock.write(fresh)
        own = [written.report] if written.report is not None else []
        if evaluation is not None and compared is not None:
            sealed = hashes_of(fresh, compared["files"])
            written.files += own
            write_summary(fresh / EVALUATION_FILE, {**compared, "files": written.files}, sealed)
        of_models = [f"{w.place}/{n}".lstrip("/") for w in written.predictions for n in w.files]
        return list(dict.fromkeys([*of_models, *written.files, *own]))

    def stale() -> list[str]:
        key = written.predictions[0].summary["case_key"]
        written.left_out = stale_results(output, key)
        return [*written.left_out, *_older(output, [entry.place for entry in written.predictions])]

    # A comparison lists its files; those of predictions are found by their names.
    summary = None if evaluation is None else EVALUATION_FILE
    with Painter() as painter:
        if any(pictures(model) for model in models):
            # While the first prediction is solved.
            painter.load()
        names = replacing_files(output, summary, is_result_file, fill, stale)
    written.left_out = [name for name in written.left_out if name not in names]
    _warn_of_removed(output, written.left_out)
    return written


def _fill_model(
    fresh: Path, prediction: Prediction, clock: _Clock, *, drawing: _Drawing, slicer: bool
) -> WrittenPrediction:
    """The files of one prediction in its folder, with the pictures that are wanted."""
    place = drawing.place(prediction.model)
    (fresh / place).mkdir(exist_ok=True)
    # They take longest.
    begun = drawing.begin(prediction)
    summary = prediction.summary
    skin = {**summary["skin"], **face_motion(prediction)}
    clinical, contacts = clinical_figures(prediction), drawing.contacts(prediction.patient)
    clinical["contacts"] = contacts if isinstance(contacts, dict) else contacts.as_dict()
    own = [asdict(finding) for finding in poor_bite(clinical["occlusion"])]
    findings = [*summary.get("findings", ()), *own]
    now = datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %z")
    figures = {"skin": skin, "clinical": clinical, "findings": findings, "written_at": now}
    prediction = replace(prediction, summary={**summary, **figures})
    more = partial(_more_files, prediction, begun, clock, slicer=slicer)
    clock.begin(place, prediction.summary["timings"])
    with clock.timed("writing the files"):
        names = fill_prediction(fresh / place, prediction, more)
    return WrittenPrediction(place, names, prediction.summary)


def _older(output: Path, places: Iterable[str]) -> list[str]:
    """Pictures of an earlier run that this one has not drawn, and a report that it has not made."""
    older = [REPORT_FILE, CHART_PAGE_FILE, DICOM_PAGE_FILE]
    for place in places:
        folder = output / place
        if folder.is_dir() and (folder / "prediction.json").exists():
            names = [path.name for path in folder.iterdir() if is_prediction_file(path.name)]
            older += [f"{place}/{name}".lstrip("/") for name in names]
    return older


def _earlier_evaluation(output: Path, key: str) -> dict[str, Any] | None:
    """The comparison that is in the folder, if it belongs to the predictions with this key."""
    if (output / EVALUATION_FILE).exists() and EVALUATION_FILE not in stale_results(output, key):
        return read_evaluation(output)
    return None


def _warn_of_removed(output: Path, names: Sequence[str]) -> None:
    if not names:
        return
    # The files that state what the others are.
    stated = [name for name in names if name.endswith((".json", ".html"))] or names
    _log.warning(
        "%s: removed the results of another plan, of other inputs or of another version: %s",
        output,
        ", ".join(stated),
    )
    if EVALUATION_FILE in names:
        _log.warning("the comparison belonged to another plan: run cmfsim evaluate again")


def _more_files(
    prediction: Prediction,
    begun: Mapping[str, "Future[None]"],
    clock: "_Clock",
    folder: Path,
    *,
    slicer: bool,
) -> list[str]:
    """The names of the files beside those of each prediction: pictures that could be drawn."""
    names: list[str] = []
    if slicer:
        write_slicer_bundle(folder / SLICER_FILE, prediction)
    with clock.timed("waiting for the pictures"), optional_pictures():
        for name, picture in begun.items():
            picture.result()
            names.append(name)
    return [*names, SLICER_FILE] if slicer else names


def _pictures_of(
    patient: PatientModel,
    contacts: ContactMap | dict[str, Any],
    prediction: Prediction | None = None,
) -> Iterator[tuple[str, Picture]]:
    """The pictures of a prediction; before there is one, those of its plan."""
    if prediction is not None and prediction.muscles is not None:
        yield MUSCLES, _muscles_picture(prediction.muscles, patient.segments)
    yield "plan.png", plan_picture(patient, planned_motions(patient, patient.scene))
    if prediction is not None:
        yield "prediction.png", prediction_picture(prediction)
    if not isinstance(contacts, dict):
        upper = contacts.upper.surface, contacts.upper_gaps
        yield "contacts.png", contacts_picture(upper, (contacts.lower.surface, contacts.lower_gaps))
    if prediction is not None and prediction.band is not None:
        yield "band.png", band_picture(prediction)
    # The last: it alone needs matplotlib, and those after one that cannot be drawn are left out.
    if prediction is not None and patient.landmarks.get("skull"):
        yield "lateral.png", _lateral(prediction)


def _lateral(prediction: Prediction) -> Picture:
    """The profile tracing before the operation and as planned."""
    before, planned, frame = lateral_sites(prediction)
    bones = prediction.bones
    at_rest = {segment.name: segment.surface for segment in prediction.patient.segments}
    moved = {n: SurfaceData(vertices, s.triangles) for n, (s, vertices) in bones.items()}
    middle = frame.middle
    if middle is None:
        middle = float(prediction.skin_before.vertices.mean(axis=0) @ frame.left)
    plane = np.stack([frame.forwards, frame.up, frame.left]), middle
    return partial(
        picture_lateral,
        before=LateralView(at_rest, prediction.face_before, before, *plane),
        planned=LateralView(moved, prediction.face, planned, *plane),
    )


def _muscles_picture(muscles: Musculature, segments: Sequence[BoneSegment]) -> Picture:
    return partial(
        picture_muscles,
        musculature=Musculature(muscles.muscles),
        skull=joined_surface([segment.surface for segment in segments]),
    )


@contextlib.contextmanager
def optional_pictures() -> Iterator[None]:
    """Lets results be written without pictures where these cannot be drawn, and reports it."""
    try:
        yield
    except CmfsimError as error:
        # The last line of the error of a worker, which begins with its trace.
        _log.warning("no more pictures: %s", str(error).strip().rpartition("\n")[2])


def _fill_evaluation(fresh: Path, evaluation: CaseEvaluation) -> dict[str, Any]:
    """The values of a comparison whose figures and pictures were written into a folder."""
    comparison = evaluation.comparison
    names = ["metrics.csv"]
    table = error_table({evaluation.predictions[0].name: comparison})
    (fresh / names[0]).write_text(table.csv(), encoding="utf-8")
    for prediction in evaluation.predictions:
        names.append(skin_errors_file(prediction.model))
        errors = comparison.errors[prediction.model]
        write_skin_errors(fresh / names[-1], prediction.skin, comparison.vertices, errors)
    with optional_pictures():
        for prediction in evaluation.predictions:
            model = prediction.model
            found = comparison.comparisons[model]
            picture_distances(
                fresh / f"error-{model}.png",
                prediction.skin,
                found.field(len(prediction.skin_nodes)),
                regions={name: s.signed_mean for name, s in found.regions.items()},
            )
            names.append(f"error-{model}.png")
        chart_errors(fresh / "errors.png", _by_region(evaluation))
        names.append("errors.png")
    return {**evaluation.as_dict(), "files": names}


def _by_region(evaluation: CaseEvaluation) -> dict[str, dict[str, Any]]:
    """Errors of each model in each region."""
    comparison = evaluation.comparison
    parts: dict[str, Any] = {"whole": slice(None)}
    vertices = next(iter(comparison.comparisons.values())).region_vertices
    for region in comparison.regions:
        parts[region] = np.isin(comparison.vertices, vertices[region])
    return {
        region: {model: errors[part] for model, errors in comparison.errors.items()}
        for region, part in parts.items()
    }


def _report_of(
    fresh: Path, output: Path, written: WrittenResults, evaluation: Mapping[str, Any] | None
) -> str | None:
    """The name of the report of what was just written, with the comparison that belongs to it."""
    order = {model: number for number, model in enumerate(MODELS)}
    entries = sorted(written.predictions, key=lambda entry: order[entry.summary["model"]])
    found = {fresh / entry.place: read_prediction(fresh / entry.place) for entry in entries}
    figures = {}
    if evaluation is not None:
        is_new = "sha256" not in evaluation
        figures = {
            name: (fresh / name).read_bytes()
            if is_new
            else read_evaluation_picture(output, evaluation, name)
            for name in evaluation["files"]
            if name.endswith(".png")
        }
    return write_report_page(fresh, _document(output, found, evaluation, figures))


def write_case_report(folder: Path) -> str | None:
    """The name of the report made of a folder's results; none without Jinja2.

    Raises as `predictions_of`: there is no prediction; some belong to different plans.
    """
    found = predictions_of(folder)
    key = next(iter(found.values()))["case_key"]
    evaluation, figures, left_out = None, {}, ""
    if (folder / EVALUATION_FILE).exists():
        evaluation = read_evaluation(folder)
        if evaluation["case_key"] != key:
            evaluation = None
            left_out = (
                f"the comparison of {EVALUATION_FILE} belongs to another plan, other inputs or "
                "another version: skipped; run cmfsim evaluate"
            )
            _log.warning("%s", left_out)
    if evaluation is not None:
        names = [name for name in evaluation["files"] if name.endswith(".png")]
        figures = {name: read_evaluation_picture(folder, evaluation, name) for name in names}
    return write_report_page(folder, _document(folder, found, evaluation, figures, left_out))


def _document(
    folder: Path,
    found: Mapping[Path, Mapping[str, Any]],
    evaluation: Mapping[str, Any] | None,
    figures: Mapping[str, bytes],
    left_out: str = "",
) -> Document:
    """The report of predictions in their places, with the planning page if it was made for them."""
    place, pictures = _shown(found)
    shown_figures = []
    # The box plot first: it shows all models together.
    for name in sorted(figures, key=lambda name: name != "errors.png"):
        model = name.removeprefix("error-").removesuffix(".png")
        caption = BOXES_CAPTION if name == "errors.png" else ERROR_CAPTION.format(model)
        shown_figures.append(Figure(figures[name], caption))
    document = case_document(
        list(found.values()),
        shown=found[place]["model"],
        evaluation=evaluation,
        pictures=pictures,
        figures=shown_figures,
        view=_view(place),
        left_out=left_out,
    )
    state = page_state(folder / PAGE_FILE)
    # Compared one by one: a file that was changed may hold anything there.
    fits = state is not None and all(entry.get("plan_key") == state for entry in found.values())
    if state is not None and not fits:
        _log.warning("%s shows another head or other cuts: run cmfsim plan again", PAGE_FILE)
    return replace(document, links={"Planning page": PAGE_FILE} if fits else {})


def _view(place: Path) -> tuple[str, str] | None:
    """The view of a prediction; none, with a warning, where its surfaces cannot be simplified."""
    parts = read_parts(place, ("bones",))
    try:
        return face_view(parts, read_face_colours(place))
    except CmfsimError as error:
        _log.warning("no view of the face to turn: %s", error)
        return None


def _shown(found: Mapping[Path, Mapping[str, Any]]) -> tuple[Path, dict[str, bytes]]:
    """The folder of the last prediction that has pictures, of the last without any, and these."""
    pictures: dict[str, bytes] = {}
    shown = Path()
    for place, summary in found.items():
        drawn = {
            name: image
            for name in PREDICTION_PICTURES
            if (image := read_prediction_picture(place, summary, f"{name}.png")) is not None
        }
        if drawn or not pictures:
            pictures, shown = drawn, place
    return shown, pictures


def results_folder(given: Path) -> Path:
    """The folder with the results of a case, or the given one, which has results.

    Raises `CaseError`: The results of a case are of other inputs than it has now: an earlier plan
        or scan would be shown for the present one. Next to results, that is a warning.
    """
    is_case = given.is_file() or (given / CASE_FILE).is_file()
    case_file = given if given.is_file() else (given if is_case else given.parent) / CASE_FILE
    if not case_file.is_file():
        return given
    folder = Case.load(case_file).output if is_case else given
    (found, *_) = predictions_of(folder).values()
    inputs = found["inputs"]
    if not is_case and case_file.name not in inputs:
        return folder
    # Files beyond the case's folder are listed by their names alone, and are not compared.
    there = {name: case_file.parent / name for name in {case_file.name: "", **inputs}}
    other = [n for n, p in there.items() if p.exists() and input_hash(p) != inputs.get(n)]
    if not other:
        return folder
    text = f"{folder}: holds the results of another {other[0]}, or of this one as it was"
    if is_case:
        raise CaseInputError(
            f"{text} (report-older): run cmfsim predict again, or give {folder} if these are meant"
        )
    _log.warning("%s: run cmfsim predict again if the plan or an input has changed", text)
    return folder


def write_chart_page(folder: Path) -> str:
    """The name of the page for the chart, PDF, of the results in a folder; raises as the report."""
    found = predictions_of(folder)
    place, pictures = _shown(found)
    findings = findings_of([*found.values()], None)
    write_figure(
        folder / CHART_PAGE_FILE,
        A4,
        lambda page: draw_chart_page(page, found[place], pictures, findings),
    )
    return CHART_PAGE_FILE


def write_dicom_page(folder: Path, source: Path) -> str:
    """The name of the page for the chart as DICOM, in the study of the CT that was planned on.

    source: The CT as the case names it: its folder or file, whose hash is among the results.
    Raises as the report; `CaseError`: another CT. See also `write_dicom_pdf`.
    """
    place, _ = _shown(predictions_of(folder))
    if input_hash(source) not in predictions_of(folder)[place]["inputs"].values():
        raise CaseInputError(
            f"{source} is not the CT of these results (dicom-other-ct), or has changed since: give "
            "the folder that [image] names in the case file; otherwise the page would be filed "
            "under another patient"
        )
    pdf = (folder / write_chart_page(folder)).read_bytes()
    write_dicom_pdf(folder / DICOM_PAGE_FILE, pdf, source, "Predicted face, research only")
    return DICOM_PAGE_FILE


def write_animation(folder: Path, path: Path) -> None:
    """Writes an animation of the face that the report of a folder shows; raises as that does."""
    place, _ = _shown(predictions_of(folder))
    ((before, after),) = read_parts(place, ())["skin"].values()
    animate_face(path, before, after, read_face_colours(place))


def write_report_page(folder: Path, document: Document) -> str | None:
    """The name of the page that a report was written to; none, with a warning, without Jinja2."""
    try:
        page = render_page(document)
    except CmfsimError as error:
        _log.warning("no report: %s", error)
        return None
    replace_text(folder / REPORT_FILE, page)
    return REPORT_FILE
