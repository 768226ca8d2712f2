"""What commands on cases write: predictions with pictures, errors, and the report of both."""

import contextlib
import json
import logging
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cmfsim.errors import CmfsimError
from cmfsim.evaluation import error_table
from cmfsim.io import finish_writing, replacing_files, write_prediction
from cmfsim.pictures import (
    chart_errors,
    picture_distances,
    picture_muscles,
    picture_plan,
    picture_prediction,
)
from cmfsim.prediction import Prediction
from cmfsim.report import Figure, case_document, study_document, write_page
from cmfsim.study import EVALUATION_FILE, CaseEvaluation, StudyReport
from cmfsim.template import joined_surface

__all__ = ["folder_of", "write_case_report", "write_evaluation", "write_prediction_files"]

_log = logging.getLogger(__name__)

REPORT_FILE = "report.html"
# Pictures of a case's report, in the folder of its first prediction and in its own.
PREDICTION_PICTURES = ("prediction", "plan", "muscles")
BOXES_CAPTION = (
    "Sizes of the errors by region: quartiles, median, mean (diamond), whiskers to 1.5 boxes, and "
    "beyond them each outlier, with their number above (as the paper's Figure 9)."
)


def folder_of(output: Path, model: str, n_models: int) -> Path:
    """Where a model's prediction lies: the case's own folder, or one for each of several models."""
    return output if n_models == 1 else output / model


def write_prediction_files(
    folder: Path, prediction: Prediction, *, pictures: bool = True
) -> list[str]:
    """The names of the files of a prediction, with its pictures where they can be drawn."""
    draw = partial(_draw, prediction) if pictures else None
    return write_prediction(folder, prediction, draw)


def _draw(prediction: Prediction, folder: Path) -> list[str]:
    drawn: list[str] = []
    with _pictures():
        for name, draw in _pictures_of(prediction):
            draw(folder / name)
            drawn.append(name)
    return drawn


def _pictures_of(prediction: Prediction) -> Iterator[tuple[str, Callable[[Path], None]]]:
    yield "prediction.png", partial(picture_prediction, prediction=prediction)
    yield "plan.png", partial(picture_plan, prediction=prediction)
    if prediction.muscles is not None:
        segments = prediction.patient.segments
        yield (
            "muscles.png",
            partial(
                picture_muscles,
                musculature=prediction.muscles,
                skull=joined_surface([segment.surface for segment in segments]),
            ),
        )


@contextlib.contextmanager
def _pictures() -> Iterator[None]:
    """Lets results be written without pictures where these cannot be drawn, and says so."""
    try:
        yield
    except CmfsimError as error:
        _log.warning("no more pictures: %s", error)


def write_evaluation(folder: Path, evaluation: CaseEvaluation) -> list[str]:
    """The names of the files of a comparison: figures as JSON and CSV, pictures, and the report.

    They take their places together: a case that has its figures has its report. The predictions
    are in the folder already.
    """
    comparison = evaluation.comparison
    models = [prediction.model for prediction in evaluation.predictions]
    n_models = len(models) + len(evaluation.failed)
    places = [folder_of(folder, model, n_models) for model in models]

    def fill(fresh: Path) -> list[str]:
        names = ["metrics.csv"]
        table = error_table({evaluation.predictions[0].name: comparison})
        (fresh / names[0]).write_text(table.csv(), encoding="utf-8")
        with _pictures():
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
        document = _document(places, {**evaluation.as_dict(), "files": names}, fresh)
        written = _write_report(fresh, document)
        names += [*([written] if written else []), EVALUATION_FILE]
        text = json.dumps({**evaluation.as_dict(), "files": names}, indent=1, allow_nan=False)
        (fresh / EVALUATION_FILE).write_text(text + "\n", encoding="utf-8")
        return names

    return replacing_files(folder, EVALUATION_FILE, _is_evaluation_file, fill)


def _is_evaluation_file(name: str) -> bool:
    return name in {"metrics.csv", "errors.png", EVALUATION_FILE, REPORT_FILE} or (
        name.startswith("error-") and name.endswith(".png")
    )


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


def write_case_report(folder: Path, places: Sequence[Path]) -> str | None:
    """The name of the report made of the predictions in `places`; none without Jinja2."""
    finish_writing(folder)
    evaluation = _json(folder / EVALUATION_FILE) if (folder / EVALUATION_FILE).exists() else None
    return _write_report(folder, _document(places, evaluation, folder))


def _document(places: Sequence[Path], evaluation: Any, folder: Path) -> Any:
    """The report of predictions in their places, with an evaluation whose pictures a folder has."""
    predictions = [_json(place / "prediction.json") for place in places]
    pictures = {
        name: (places[-1] / f"{name}.png").read_bytes()
        for name in PREDICTION_PICTURES
        if (places[-1] / f"{name}.png").exists()
    }
    figures = []
    if evaluation is not None:
        # The box plot first: it shows all models together.
        for name in sorted(evaluation["files"], key=lambda name: name != "errors.png"):
            if not name.endswith(".png"):
                continue
            model = name.removeprefix("error-").removesuffix(".png")
            caption = BOXES_CAPTION if name == "errors.png" else _error_caption(model)
            figures.append(Figure((folder / name).read_bytes(), caption))
    return case_document(predictions, evaluation=evaluation, pictures=pictures, figures=figures)


def _error_caption(model: str) -> str:
    return (
        f"Model {model}: signed distance from the face after the operation, −5 to 5 mm; blue where "
        "the prediction lies behind it, grey where nothing was evaluated (the paper's Figure 10)."
    )


def write_study_report(report: StudyReport) -> list[str]:
    """The names of the files of a study: its table as JSON and CSV, and its report."""
    folder, names = report.cohort.output, ["study.json"]
    text = json.dumps(report.as_dict(), indent=1, allow_nan=False)

    def fill(fresh: Path) -> list[str]:
        (fresh / "study.json").write_text(text + "\n", encoding="utf-8")
        return names

    replacing_files(folder, "study.json", lambda name: name in names, fill)
    written = _write_report(folder, study_document(report.as_dict()))
    return [*names, *([written] if written else [])]


def _write_report(folder: Path, document: Any) -> str | None:
    try:
        write_page(folder / REPORT_FILE, document)
    except CmfsimError as error:
        _log.warning("no report: %s", error)
        return None
    return REPORT_FILE


def _json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))
