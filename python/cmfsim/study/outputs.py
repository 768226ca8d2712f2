"""Outputs of a study: tables and figures of Kim et al. (2010), values, and report."""

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

from cmfsim.errors import CaseInputError
from cmfsim.evaluation import NO_CHANGE, DistanceStatistics, ErrorTable
from cmfsim.io import replacing_files
from cmfsim.io.results.metrics import SkinErrors, read_skin_errors
from cmfsim.pictures import chart_errors, picture_distance_grid
from cmfsim.pipeline.outputs.results import optional_pictures, write_report_page
from cmfsim.report import Figure, study_document
from cmfsim.report.study import table3_text
from cmfsim.study.cohort import StudyReport

STUDY_FILE, TABLE_FILE, TABLE_3_FILE = "study.json", "study.csv", "table3.md"
FIGURE_9_FILE, FIGURE_10_FILE = "figure9.png", "figure10.png"
STUDY_FILES = re.compile(r"study\.(json|csv)|table3\.md|figure(9|10(-\d+)?)\.png|report\.html")
# Faces in one picture are legible on a page up to this many rows.
PATIENTS_PER_PICTURE = 6
# Width of a chart of four patients, and of each further one, inches.
CHART_WIDTH, WIDTH_PER_PATIENT = 8.0, 1.6
FIGURE_9_CAPTION = (
    "Sizes of the distances of each patient by model: quartiles, median, mean (diamond), whiskers "
    "to 1.5 boxes, and beyond them each outlier, with their number above (as the paper's Figure 9)."
)
FIGURE_10_CAPTION = (
    "Signed distances from the face after the operation, −5 to 5 mm; blue where the prediction "
    "lies behind it, grey where nothing was evaluated (as the paper's Figure 10)."
)

Errors = Mapping[str, Mapping[str, SkinErrors]]


def study_table(report: StudyReport) -> ErrorTable:
    """The errors of every case (rows) by every model and "no change" (columns), by region.

    Cases that failed are absent. If one model of a case failed, the other models are listed, and
    averages exclude the case.

    Raises
    ------
    CaseError
        (also `ValueError`) No case was compared with the face after its operation.

    Examples
    --------
    >>> import cmfsim
    >>> report = cmfsim.run_study(cmfsim.Cohort.load("cohort.toml"))  # doctest: +SKIP
    >>> table = cmfsim.study_table(report)  # doctest: +SKIP
    >>> print(table.text())  # doctest: +SKIP
    >>> table.average("M+S"), table.wilcoxon("H", "M+S").p  # doctest: +SKIP
    """
    models = (*report.cohort.models, NO_CHANGE)
    cells, regions = {}, dict[str, None]()
    patients = [outcome for outcome in report.outcomes if outcome.evaluation]
    if not patients:
        raise CaseInputError(
            f"{report.cohort.name}: no case was compared with its post-operative face"
        )
    for outcome in patients:
        found = {**outcome.evaluation["models"], NO_CHANGE: outcome.evaluation["no_change"]}
        for model in (model for model in models if model in found):
            for region, figures in found[model]["regions"].items():
                regions[region] = None
                cells[outcome.name, region, model] = DistanceStatistics.from_dict(figures)
    ordered = {
        (patient.name, region, model): cells[patient.name, region, model]
        for patient in patients
        for region in regions
        for model in models
        if (patient.name, region, model) in cells
    }
    return ErrorTable(tuple(p.name for p in patients), models, tuple(regions), ordered)


def write_study_report(report: StudyReport) -> list[str]:
    """The names of the files of a study, written together into the output folder of its cohort.

    `study.csv` (mean, SD, median, P90, P95, maximum and shares within 1 to 3 mm, a row for each
    case, region and model), `table3.md` (the paper's Table 3, with the paper's own means),
    `figure9.png` (box plots of the distances by model and patient), `figure10.png` (distances as
    colours on the faces; further patients in `figure10-2.png`, …), `study.json` and `report.html`.
    If no case was compared, only the last two are written. If pictures cannot be drawn, or Jinja2
    is missing, the rest is written with a warning.

    Raises
    ------
    CaseError
        (also `ValueError`) The folder of a case has changed since the study.
    OSError
        The folder cannot be written to.

    Examples
    --------
    >>> import cmfsim
    >>> report = cmfsim.run_study(cmfsim.Cohort.load("cohort.toml"))  # doctest: +SKIP
    >>> cmfsim.write_study_report(report)  # doctest: +SKIP
    ['study.csv', 'table3.md', 'figure9.png', 'figure10.png', 'study.json', 'report.html']
    """
    folder, values = report.cohort.output, report.as_dict()

    def fill(fresh: Path) -> list[str]:
        names: list[str] = []
        figures: list[Figure] = []
        if any(outcome.evaluation for outcome in report.outcomes):
            table = study_table(report)
            (fresh / TABLE_FILE).write_text(table.csv(), encoding="utf-8")
            (fresh / TABLE_3_FILE).write_text(table3_text(values, table), encoding="utf-8")
            names += [TABLE_FILE, TABLE_3_FILE]
            errors = _errors(report)
            with optional_pictures():
                for name, caption in _drawn(fresh, errors):
                    names.append(name)
                    figures.append(Figure((fresh / name).read_bytes(), caption))
        text = json.dumps(values, indent=1, allow_nan=False)
        (fresh / STUDY_FILE).write_text(text + "\n", encoding="utf-8")
        page = write_report_page(fresh, study_document(values, figures=figures))
        return [*names, STUDY_FILE, *([] if page is None else [page])]

    def is_ours(name: str) -> bool:
        return STUDY_FILES.fullmatch(name) is not None

    def stale() -> list[str]:
        return [path.name for path in folder.iterdir() if is_ours(path.name)]

    return replacing_files(folder, None, is_ours, fill, stale)


def _errors(report: StudyReport) -> Errors:
    """Errors on the skin of each patient and model that was compared."""
    return {
        outcome.name: {
            model: read_skin_errors(report.cohort.output / outcome.name, outcome.evaluation, model)
            for model in report.cohort.models
            if model in outcome.evaluation["models"]
        }
        for outcome in report.outcomes
        if outcome.evaluation
    }


def _drawn(folder: Path, errors: Errors) -> Iterator[tuple[str, str]]:
    """Name and caption of each figure, once it is drawn."""
    boxes = {
        patient: {model: found.counted for model, found in by_model.items()}
        for patient, by_model in errors.items()
    }
    width = max(CHART_WIDTH, WIDTH_PER_PATIENT * len(boxes))
    chart_errors(folder / FIGURE_9_FILE, boxes, width=width)
    yield FIGURE_9_FILE, FIGURE_9_CAPTION
    patients = list(errors)
    for number, start in enumerate(range(0, len(patients), PATIENTS_PER_PICTURE), start=1):
        shown = patients[start : start + PATIENTS_PER_PICTURE]
        name = FIGURE_10_FILE if number == 1 else f"figure10-{number}.png"
        picture_distance_grid(
            folder / name,
            {
                patient: {model: (e.skin, e.field) for model, e in errors[patient].items()}
                for patient in shown
            },
        )
        yield name, FIGURE_10_CAPTION
