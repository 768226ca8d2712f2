"""`cmfsim predict`, `evaluate`, `sensitivity`, `study` and `report`: faces after operations."""

import argparse
import contextlib
import json
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from cmfsim.cli import DONE, FAILED
from cmfsim.cli.case_commands import band_options, case_of, checked
from cmfsim.cli.terminal import Notices, StageProgress, escaped, print_json, print_text
from cmfsim.errors import CmfsimError
from cmfsim.io import Cohort, Variants, read_landmark_file, replace_text
from cmfsim.io.results.predictions import predictions_of
from cmfsim.pipeline.evaluating import evaluate as evaluate_case
from cmfsim.pipeline.outputs import results
from cmfsim.pipeline.predicting import predict_models, prepare
from cmfsim.report.band import band_blocks, summary_blocks
from cmfsim.report.case import motion_blocks
from cmfsim.report.document import Note
from cmfsim.report.study import study_text
from cmfsim.study.cohort import CaseOutcome, StudyOptions, run_study, write_study_report
from cmfsim.study.trials import sensitivity as landmark_sensitivity
from cmfsim.study.variants import run_variants, write_variants_report
from cmfsim.values.clinical_motion import plan_lines
from cmfsim.values.prediction import MODELS, Prediction
from cmfsim.values.progress import expected_stages
from cmfsim.values.table import Table

# What is printed of a solution.
SOLVED = ("n_tets", "residual", "contact_iterations", "contact_gap")
# What a study counts, and the typical time of one, s, until the first ends.
COMPARING, ONE_CASE = "predicting and comparing the cases", 60.0


def models_of(given: Sequence[str] | None, default: Sequence[str]) -> tuple[str, ...]:
    """The models given to a command, in the paper's order."""
    named = set(given or default)
    return MODELS if "all" in named else tuple(m for m in MODELS if m in named)


def predict(options: argparse.Namespace) -> int:
    """Predicts the face of a case by one model or by several."""
    case = case_of(options)
    models = models_of(options.model, ("M+S",))
    band = band_options(options, case)
    if band is not None:
        band.check(models)
    prepare(case, report=not options.no_report)
    begun = time.perf_counter()
    notices, asked = checked(options, case, models)
    before = {} if options.no_doctor else {"checking the case": time.perf_counter() - begun}
    each = (f"{work} {model}" for model in models for work in ("solving", "writing"))
    expected = expected_stages(*each, results.REPORT_STAGE)
    with StageProgress(sys.stderr, quiet=options.quiet, expected=expected) as progress:
        predicted = partial(
            predict_models, case, models, progress=progress.stage, band=band, **asked
        )
        written = results.write_results(
            case.output,
            lambda early: _timed(_at_least_one(predicted(**early), notices.failures), before),
            models,
            stage=progress.stage,
            with_report=not options.no_report,
            slicer=options.slicer,
        )
    notices.found(written.findings)
    failed = {model: str(error) for model, error in notices.failures.items()}
    if options.json:
        entries = [_figures(entry, case.output) for entry in written.predictions]
        answer = {"case": case.name, "predictions": entries, "failed": failed}
        more = {"findings": notices.as_dicts(), "left_out": written.left_out}
        print_json({**answer, **more, "report": written.report})
        return FAILED if failed else DONE
    summary = written.predictions[0].summary
    print_text(_plan_text(summary))
    for entry in written.predictions:
        print_text(_prediction_text(_figures(entry, case.output)))
    _print_report(case.output, written.report)
    _end(notices, case.output, written)
    _print_failed(failed)
    return FAILED if failed else DONE


def _at_least_one(
    predictions: Iterable[Prediction], failed: Mapping[str, CmfsimError]
) -> Iterator[Prediction]:
    """The predictions, or the first error if there are none."""
    prediction: Prediction | None = None
    for prediction in predictions:
        yield prediction
    if prediction is None:
        raise next(iter(failed.values()))


def _timed(predictions: Iterable[Prediction], before: Mapping[str, float]) -> Iterator[Prediction]:
    """The predictions with the seconds of what came before them among their timings."""
    for prediction in predictions:
        timings = {**before, **prediction.summary["timings"]}
        yield replace(prediction, summary={**prediction.summary, "timings": timings})


def evaluate(options: argparse.Namespace) -> int:
    """Predicts a case and compares it with the face after the operation."""
    case = case_of(options)
    if options.no_doctor and case.postoperative is not None:
        case = replace(case, postoperative=replace(case.postoperative, verified=True))
    models = models_of(options.model, MODELS)
    prepare(case, report=not options.no_report, evaluation=True)
    notices, asked = checked(options, case, models)
    each = (f"{work} {model}" for work in ("solving", "writing") for model in models)
    expected = expected_stages(*each, "writing the comparison", results.REPORT_STAGE)
    with StageProgress(sys.stderr, quiet=options.quiet, expected=expected) as progress:
        fit = options.fit_thickness
        found = evaluate_case(case, models, progress=progress.stage, fit_thickness=fit, **asked)
        written = results.write_results(
            case.output,
            found.predictions,
            models,
            stage=progress.stage,
            evaluation=lambda: found,
            with_report=not options.no_report,
            slicer=options.slicer,
        )
    notices.found(written.findings)
    values = found.as_dict()
    code = FAILED if found.failed else DONE
    if options.json:
        answer = {**values, "output": str(case.output), "files": written.files}
        more = {"findings": notices.as_dicts(), "left_out": written.left_out}
        print_json({**answer, **more, "report": written.report})
        return code
    print_text(_plan_text(found.predictions[0].summary))
    print_text(_text_of(summary_blocks(values)))
    _print_report(case.output, written.report)
    _end(notices, case.output, written)
    _print_failed(found.failed)
    return code


def _end(notices: Notices, output: Path, written: results.WrittenResults) -> None:
    """Prints doubtful findings again, below the figures."""
    place = written.predictions[0].place
    where = written.report or f"{place}/prediction.json".lstrip("/")
    notices.summarise(str(output / where))


def sensitivity(options: argparse.Namespace) -> int:
    """Reports the effect of errors of skull landmarks on muscles and face."""
    case = case_of(options)
    prepare(case)
    notices, asked = checked(options, case, (options.model,))
    trials: Any = options.trials
    if options.landmarks:
        trials = [read_landmark_file(path).points for path in options.landmarks]
    with StageProgress(sys.stderr, quiet=options.quiet) as progress:
        found = landmark_sensitivity(
            case,
            trials=trials,
            std=options.std,
            seed=options.seed,
            model=options.model,
            progress=progress.stage,
            **asked,
        )
    values = {**found.as_dict(), "findings": notices.as_dicts()}
    case.output.mkdir(parents=True, exist_ok=True)
    text = json.dumps(values, indent=1, allow_nan=False)
    replace_text(case.output / "sensitivity.json", f"{text}\n")
    if options.json:
        print_json(values)
        return DONE
    print_text(
        f"{escaped(case.name)}, model {options.model}: mean distances from the positions under "
        "the case's own landmarks, mm"
    )
    print_text("  trial  landmarks  muscles  masseter    skin  skin 95 %")
    for number, trial in enumerate(found.trials):
        masseter = [d for name, d in trial.muscle_deviation.items() if "masseter" in name]
        muscles = list(trial.muscle_deviation.values())
        skin = trial.as_dict()["skin"]
        print_text(
            f"  {number + 1:5d}  {trial.landmark_deviation:9.2f}  {_mean(muscles):7.2f}  "
            f"{_mean(masseter):8.2f}  {skin['mean']:6.3f}  {skin['p95']:9.3f}"
        )
    moved = found.skin_deviation(moved=True)
    print_text(f"  skin that the operation moves: {moved:.3f} mm on average")
    notices.summarise(str(case.output / "sensitivity.json"))
    return DONE


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values) if values else float("nan")


def study(options: argparse.Namespace) -> int:
    """Predicts and compares every case of a cohort; failed if a case failed."""
    cohort = Cohort.load(options.cohort)
    if options.model:
        cohort = replace(cohort, models=models_of(options.model, ()))
    if options.output is not None:
        cohort = replace(cohort, output=options.output.absolute())
    if options.variants is not None:
        return _study_variants(cohort, options)

    with _counted(len(cohort.cases), quiet=options.quiet) as count:
        found = run_study(
            cohort,
            workers=options.workers,
            scheduler=options.scheduler,
            fresh=options.fresh,
            progress=lambda outcome: count(outcome.name, outcome),
        )
    names = write_study_report(found)
    if options.json:
        print_json({**found.as_dict(), "files": names})
    else:
        print_text(_shown(study_text(found.as_dict())))
        print_text(f"written       {escaped(str(cohort.output))}: {', '.join(names)}")
    _print_reasons((outcome.name, outcome) for outcome in found.failed)
    return FAILED if found.failed else DONE


@contextlib.contextmanager
def _counted(cases: int, *, quiet: bool) -> Iterator[Callable[[str, CaseOutcome], None]]:
    """What is called with the name and outcome of each case: a line each, or on a terminal one."""
    done = 0
    with StageProgress(sys.stderr, quiet=quiet, expected={COMPARING: ONE_CASE * cases}) as progress:

        def count(name: str, outcome: CaseOutcome) -> None:
            nonlocal done, cases
            if outcome.status == "kept":
                # It took no time: nothing follows from it for the others.
                cases -= 1
            else:
                done += 1
            if not (quiet or sys.stderr.isatty()):
                print_text(f"{name}: {outcome.status}, {outcome.seconds:.0f} s", file=sys.stderr)
            progress.stage(f"{COMPARING} ({min(done + 1, cases)} of {cases})")

        progress.stage(f"{COMPARING} (1 of {cases})")
        yield count


def _print_reasons(failed: Iterable[tuple[str, CaseOutcome]]) -> None:
    """Prints why cases failed."""
    for name, outcome in failed:
        print_text(f"cmfsim: error: {escaped(name)}:", file=sys.stderr)
        for line in outcome.error.splitlines():
            print_text(f"  {escaped(line)}", file=sys.stderr)


def _study_variants(cohort: Cohort, options: argparse.Namespace) -> int:
    """Runs a cohort as given and under each variant; failed if a case of one failed."""
    variants = Variants.load(options.variants, cohort.models)
    where = StudyOptions(options.workers, options.scheduler, options.fresh)
    # Cases in which a variant changes nothing are not repeated, so there may be fewer.
    cases = len(cohort.cases) * len(variants.variants)
    with _counted(cases, quiet=options.quiet) as count:
        found = run_variants(
            cohort,
            variants,
            options=where,
            progress=lambda variant, case: count(f"{variant}, {case.name}", case),
        )
    names = write_variants_report(found)
    if options.json:
        more = {"output": str(found.output), "files": names}
        print_json({**found.as_dict(), **more})
    else:
        print_text(_shown(found.text()))
        print_text(f"written       {escaped(str(found.output))}: {', '.join(names)}")
    _print_reasons((f"{variant}, {outcome.name}", outcome) for variant, outcome in found.failed)
    return FAILED if found.failed else DONE


def report(options: argparse.Namespace) -> int:
    """Regenerates the report of a folder of results, or of a case that has them."""
    folder = results.results_folder(options.folder)
    with StageProgress(sys.stderr, quiet=options.quiet) as progress:
        progress.stage("writing the report")
        name = results.write_case_report(folder)
        pages = {"pdf": results.write_chart_page(folder)} if options.pdf else {}
        if options.dicom is not None:
            pages["dicom"] = results.write_dicom_page(folder, options.dicom)
        if options.animation is not None:
            progress.stage("drawing the animation")
            results.write_animation(folder, options.animation)
            pages["animation"] = str(options.animation.absolute())
    if name is None:
        return FAILED
    if options.json:
        clinical = {e["model"]: e.get("clinical") for e in predictions_of(folder).values()}
        print_json({"output": str(folder), "report": name, **pages, "clinical": clinical})
    else:
        for written in (name, *pages.values()):
            _print_report(folder, written)
    return DONE


def _figures(entry: results.WrittenPrediction, output: Path) -> dict[str, Any]:
    solution = entry.summary["solution"]
    return {
        "model": entry.summary["model"],
        **{key: solution[key] for key in SOLVED},
        "plan": {name: m["clinical"] for name, m in entry.summary["plan"].items()},
        "plan_digits": entry.summary.get("plan_digits", ""),
        "skin": dict(entry.summary["skin"]),
        "band": entry.summary.get("band"),
        "timings": dict(entry.summary["timings"]),
        "output": str(output / entry.place),
        "files": entry.files,
    }


def _plan_text(summary: Mapping[str, Any]) -> str:
    """The plan as it was applied, a line for each segment; last what the planning page calls it."""
    plan = {name: entry["clinical"] for name, entry in summary["plan"].items()}
    lines = plan_lines(plan)
    if "plan_digits" in summary:
        lines.append(f"{summary['plan_digits']} (digits of its motions, as in a saved plan's name)")
    lines = [f"plan: {escaped(line)}" for line in lines]
    if summary.get("achieved") is not None:
        lines.append(_text_of(motion_blocks(summary)))
    return "\n".join(lines)


def _text_of(blocks: Iterable[Note | Table]) -> str:
    """Parts of a report as lines for the terminal."""
    return _shown("\n".join(block.text for block in blocks))


def _shown(text: str) -> str:
    """The lines of a text without control characters."""
    return "\n".join(escaped(line) for line in text.split("\n"))


def _prediction_text(entry: dict[str, Any]) -> str:
    skin = entry["skin"]
    average = f"{skin['mean']:.2f} mm on average"
    if "face_mean" in skin:
        average = f"{skin['face_mean']:.2f} mm on average in the face"
    residual = "unknown" if entry["residual"] is None else f"{entry['residual']:.1e}"
    lines = [
        f"model {entry['model']}",
        f"  solved      {entry['n_tets']} tets, residual {residual}",
    ]
    if entry["contact_iterations"]:
        gap = "unknown" if entry["contact_gap"] is None else f"{entry['contact_gap']:.1e} mm"
        lines.append(f"  contact     {entry['contact_iterations']} iterations, largest gap {gap}")
    lines += [
        f"  skin moves  {average}, {skin['largest']:.2f} mm at most",
        f"  time        {sum(entry['timings'].values()):.1f} s from the files to the face",
        f"  written     {escaped(entry['output'])}: {', '.join(entry['files'])}",
    ]
    if entry["band"] is not None:
        lines.append(_text_of(band_blocks(entry["band"])))
    return "\n".join(lines)


def _print_failed(failed: Mapping[str, str]) -> None:
    """Prints which of several models have no result; the others were written."""
    for model, reason in failed.items():
        print_text(f"cmfsim: error: model {model}: {escaped(reason)}", file=sys.stderr)


def _print_report(folder: Path, name: str | None) -> None:
    if name is not None:
        print_text(f"report: {escaped(str(folder / name))}")
