"""`cmfsim demo`: the embedded case from its files to its report."""

import argparse
import json
import sys
import time
from collections.abc import Iterable
from pathlib import Path

from cmfsim.cli.exit_codes import DONE, FAILED
from cmfsim.cli.terminal import Notices, StageProgress, escaped, open_page
from cmfsim.lab.virtual.demo import DemoCase, write_demo_case
from cmfsim.pipeline.building.stages import BuildKeywords
from cmfsim.pipeline.evaluating import evaluate
from cmfsim.pipeline.outputs.results import REPORT_STAGE, WrittenResults, write_results
from cmfsim.pipeline.predicting import predict_models, prepare
from cmfsim.values.prediction import Prediction
from cmfsim.values.progress import expected_stages

DEMO_FOLDER = Path("cmfsim-demo")
# Without muscles or sliding, with muscles, with both.
DEMO_MODELS = ("H", "M", "M+S")


def demo(options: argparse.Namespace) -> int:
    """Predicts the face of the embedded case, writes its report and opens it."""
    models: tuple[str, ...] = options.models
    begun = time.perf_counter()
    notices = Notices(quiet=options.quiet)
    each = (f"{work} {model}" for work in ("solving", "writing") for model in models)
    expected = expected_stages(*each, "writing the comparison", REPORT_STAGE)
    with StageProgress(sys.stderr, quiet=options.quiet, expected=expected) as progress:
        progress.stage("making a head")
        made = write_demo_case(options.folder, edge_length=options.edge_length)
        prepare(made.case, report=True, evaluation=made.truth is not None)
        name = _work(made, models, progress, notices).report
    if name is None:
        return FAILED
    page = made.case.output / name
    seconds = time.perf_counter() - begun
    if options.json:
        answer = {
            "case": str(made.case.file),
            "report": str(page),
            "seconds": seconds,
            "findings": notices.as_dicts(),
        }
        print(json.dumps(answer, allow_nan=False))
        return DONE
    print(f"case    {escaped(str(made.case.file))}")
    for finding in notices.findings:
        if finding.code == "landmarks-proposed":
            print(f"note    {escaped(finding.what)}")
    print(f"report  {escaped(str(page))}")
    print(f"time    {seconds:.0f} s")
    notices.summarise(str(page))
    open_page(page, wanted=not options.no_open)
    return DONE


def _work(
    made: DemoCase, models: tuple[str, ...], progress: StageProgress, notices: Notices
) -> WrittenResults:
    """Predicts by each model, compares where the truth is known, and writes everything."""
    case, found = made.case, None
    predictions: Iterable[Prediction]
    asked: BuildKeywords = {
        "progress": progress.stage,
        "check": False,
        "anatomy": made.anatomy,
        "on_findings": notices.found,
    }
    if made.truth is None:
        predictions = predict_models(case, models, **asked)
    else:
        found = evaluate(case, models, **asked)
        predictions = found.predictions
    return write_results(
        case.output,
        predictions,
        models,
        stage=progress.stage,
        evaluation=None if found is None else lambda: found,
        # The report shows the pictures of the last model alone.
        pictures=lambda model: model == models[-1],
    )
