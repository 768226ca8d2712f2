"""Many cases by several models, each in a process of its own and kept once done; their report."""

import json
import logging
import os
import re
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from cmfsim.doctor import examine
from cmfsim.errors import CaseError, CaseInputError, CmfsimError, error_text
from cmfsim.evaluation.models import NO_CHANGE, ErrorTable
from cmfsim.evaluation.statistics import DistanceStatistics
from cmfsim.io import Case, CaseChanges, Cohort, finish_writing, replacing_files
from cmfsim.io.files.folders import check_below, check_writable
from cmfsim.io.files.summaries import checked_file
from cmfsim.io.results.result_files import (
    AGAIN,
    SkinErrors,
    read_evaluation,
    read_skin_errors,
    skin_errors_file,
)
from cmfsim.pictures import chart_errors, picture_distance_grid
from cmfsim.pipeline.evaluating import evaluate, evaluation_key
from cmfsim.pipeline.outputs.results import optional_pictures, write_report_page, write_results
from cmfsim.pipeline.predicting import case_for_models, prepare
from cmfsim.processes.parallel import as_they_end, on_cluster
from cmfsim.processes.worker import Worker, WorkerEndedError, WorkerFailedError
from cmfsim.report.document import Figure
from cmfsim.report.study import study_document, table3_text
from cmfsim.values.checks import as_whole
from cmfsim.values.finding import findings_text

# Lines of a failed case's log that are shown.
SHOWN_LINES = 12
LOG_FILE = "log.txt"
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


@dataclass(frozen=True)
class CaseJob:
    """One case of a study, as plain values that travel to another process or machine.

    changes: Of its settings, as `CaseChanges.as_json` writes them; empty if there are none.
    """

    name: str
    file: str
    output: str
    models: tuple[str, ...]
    threads: int
    changes: str = ""


@dataclass(frozen=True)
class CaseOutcome:
    """The outcome of one case: what `cmfsim evaluate` wrote or, if it failed, its log's last lines.

    status: "done", "kept" (finished by an earlier run, nothing has changed since) or "failed".
    """

    name: str
    status: str
    seconds: float = 0.0
    error: str = ""
    evaluation: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class StudyReport:
    """The outcome of every case of a cohort, in its order."""

    cohort: Cohort
    outcomes: tuple[CaseOutcome, ...]
    seconds: float

    @property
    def failed(self) -> tuple[CaseOutcome, ...]:
        """The cases that failed."""
        return tuple(o for o in self.outcomes if o.status == "failed")

    def as_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return {
            "cohort": self.cohort.name,
            "note": self.cohort.note,
            "models": list(self.cohort.models),
            "seconds": self.seconds,
            "cases": [asdict(outcome) for outcome in self.outcomes],
        }


def run_study(
    cohort: Cohort,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    fresh: bool = False,
    progress: Callable[[CaseOutcome], None] | None = None,
) -> StudyReport:
    """Every case of a cohort, predicted by every model and compared with the post-operative face.

    Each case runs in its own process, so that a case that crashes or fills the memory is reported
    and does not stop the others. A case that an earlier run finished is kept as long as its inputs,
    its models and this version are the same.

    Parameters
    ----------
    cohort : Cohort
    workers : int, optional
        Cases at a time on this machine; default: one per two cores, because a case uses several.
    scheduler : str, optional
        Address of a Dask cluster with access to the same files; it then decides how many run at a
        time.
    fresh : bool
        Whether finished cases are repeated.
    progress : callable, optional
        Called with each outcome as soon as it is known.

    Raises
    ------
    CaseError
        (also `ValueError`) Less than one worker; no Dask installed, or no cluster at the address;
        an output folder that is a file, or a link that leads out of the cohort's folder.
    OSError
        The output folder cannot be made or written to.

    Examples
    --------
    >>> import cmfsim
    >>> report = cmfsim.run_study(cmfsim.Cohort.load("cohort.toml"))  # doctest: +SKIP
    >>> [outcome.status for outcome in report.outcomes]  # doctest: +SKIP
    ['done', 'done', 'kept', 'failed']
    """
    options = StudyOptions(workers, scheduler, fresh)
    say = progress or (lambda _: None)
    return run_studies([cohort], options, progress=lambda _, outcome: say(outcome))[0]


@dataclass(frozen=True)
class StudyOptions:
    """Where and how many at a time the cases of a study run; see `run_study`."""

    workers: int | None = None
    scheduler: str | None = None
    fresh: bool = False


def run_studies(
    cohorts: Sequence[Cohort],
    options: StudyOptions,
    *,
    progress: Callable[[Cohort, CaseOutcome], None],
) -> list[StudyReport]:
    """The reports of several cohorts with different output folders, whose cases share the workers.

    progress: Called with each outcome as soon as it is known.
    """
    cores = os.cpu_count() or 1
    workers = max(1, cores // 2) if options.workers is None else options.workers
    as_whole("workers", workers, 1)
    begun = time.perf_counter()
    outcomes: list[dict[str, CaseOutcome]] = [{} for _ in cohorts]
    jobs: list[CaseJob] = []
    of: list[int] = []
    for number, cohort in enumerate(cohorts):
        check_below(cohort.output, cohort.file.parent)
        check_writable(cohort.output)
        cohort.output.mkdir(parents=True, exist_ok=True)
        for name in cohort.cases:
            job = _job(cohort, name, max(1, cores // workers))
            kept = None if options.fresh else _kept(job, cohort.changes)
            if kept is None:
                jobs.append(job)
                of.append(number)
            else:
                outcomes[number][name] = kept
                progress(cohort, kept)
    scheduler = options.scheduler
    run = as_they_end(run_job, jobs, workers) if scheduler is None else _on_dask(jobs, scheduler)
    for index, outcome in run:
        outcomes[of[index]][outcome.name] = outcome
        progress(cohorts[of[index]], outcome)
    seconds = time.perf_counter() - begun
    return [
        StudyReport(cohort, tuple(found[name] for name in cohort.cases), seconds)
        for cohort, found in zip(cohorts, outcomes, strict=True)
    ]


def _job(cohort: Cohort, name: str, threads: int) -> CaseJob:
    output = cohort.output / name
    check_below(output, cohort.output)
    changes = "" if cohort.changes is None else cohort.changes.as_json()
    return CaseJob(name, str(cohort.cases[name]), str(output), cohort.models, threads, changes)


def _kept(job: CaseJob, changes: CaseChanges | None) -> CaseOutcome | None:
    """The outcome of an earlier run, if nothing has changed since."""
    output = Path(job.output)
    try:
        finish_writing(output)
        written = read_evaluation(output)
        key = evaluation_key(Case.load(job.file, changes=changes), job.models)
        # The study's figures are drawn from these.
        for model in written["models"]:
            checked_file(output, written, skin_errors_file(model), AGAIN)
    except (OSError, ValueError, CmfsimError):
        return None
    return _outcome(job.name, "kept", 0.0, written) if written["key"] == key else None


def _outcome(name: str, status: str, seconds: float, written: Mapping[str, Any]) -> CaseOutcome:
    """The outcome of a case that was evaluated; failed if one of its models did."""
    failed = written.get("failed") or {}
    error = "\n".join(f"model {model}: {reason}" for model, reason in failed.items())
    return CaseOutcome(name, "failed" if failed else status, seconds, error, written)


def _on_dask(jobs: list[CaseJob], scheduler: str) -> Iterator[tuple[int, CaseOutcome]]:
    for index, outcome, error in on_cluster(scheduler, run_job, [(job,) for job in jobs]):
        if error is None:
            yield index, outcome
        else:
            reason = f"the cluster lost the case: {error}"
            yield index, CaseOutcome(jobs[index].name, "failed", error=reason)


def run_job(job: CaseJob, start: Callable[..., Worker] = Worker) -> CaseOutcome:
    """The outcome of one case, worked on by another process."""
    begun = time.perf_counter()
    try:
        evaluation = _evaluated(job, start)
    except (CmfsimError, OSError, ValueError) as error:
        text = str(error) if isinstance(error, CmfsimError) else f"{type(error).__name__}: {error}"
        return CaseOutcome(job.name, "failed", time.perf_counter() - begun, text)
    return _outcome(job.name, "done", time.perf_counter() - begun, evaluation)


def _evaluated(job: CaseJob, start: Callable[..., Worker]) -> Mapping[str, Any]:
    """What another process writes about a case; the error has the last lines of its log."""
    output = Path(job.output)
    case = {key: getattr(job, key) for key in ("file", "output", "changes", "models")}
    why = []
    output.mkdir(parents=True, exist_ok=True)
    log_file = output / LOG_FILE
    # Made again, so that a link of that name leads nowhere.
    log_file.unlink(missing_ok=True)
    with log_file.open("xb") as log, start(threads=job.threads, log=log) as worker:
        try:
            if worker.ask("cmfsim.study.cohort:evaluate_case", case).values:
                return read_evaluation(output)
        except WorkerEndedError as ended:
            code = ended.code
            why = [f"killed by signal {-code}" if code < 0 else f"exit code {code}"]
        except WorkerFailedError as failed:
            log.write(failed.trace.encode())
    lines = log_file.read_text(encoding="utf-8", errors="replace").splitlines()
    raise CaseError("\n".join([*why, *lines[-SHOWN_LINES:]]))


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

    return replacing_all(folder, STUDY_FILES, fill)


def replacing_all(
    folder: Path, ours: re.Pattern[str], fill: Callable[[Path], list[str]]
) -> list[str]:
    """The names of files that took the places of all in a folder whose names match a pattern."""

    def is_ours(name: str) -> bool:
        return ours.fullmatch(name) is not None

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


_log = logging.getLogger(__name__)


def evaluate_case(file: str, output: str, changes: str, models: Sequence[str]) -> bool:
    """Whether a case was compared, though some of its models may have failed.

    It writes what `cmfsim evaluate` writes; if so, `metrics.json` is whole and new. Changes of its
    settings are as `CaseChanges.as_json` writes them, or an empty text.
    """
    logging.basicConfig(format="cmfsim: %(message)s", level=logging.WARNING, stream=sys.stderr)
    try:
        made = CaseChanges.from_json(changes) if changes else None
        return _compared(replace(Case.load(file, changes=made), output=Path(output)), models)
    except (CmfsimError, OSError, ValueError, MemoryError) as error:
        _log.error("error: %s", error_text(error))
        return False


def _compared(case: Case, models: Sequence[str]) -> bool:
    """Whether the doctor let the case pass; it was then predicted, compared and written."""
    prepare(case, report=True, evaluation=True)
    found = examine(case_for_models(case, models), models=models).findings
    if any(finding.severity == "error" for finding in found):
        _log.error("%s", findings_text(found))
        return False
    evaluation = evaluate(case, models, check=False, findings=found)
    write_results(
        case.output, evaluation.predictions, models, stage=_log.info, evaluation=lambda: evaluation
    )
    return True
