"""`cmfsim plan`: the planning page of a case."""

import argparse
import json
import os
import sys
import time
import webbrowser

from cmfsim.cli.case_commands import case_of, checked
from cmfsim.cli.exit_codes import DONE
from cmfsim.cli.notices import Notices
from cmfsim.cli.preparation import prepare
from cmfsim.cli.terminal import StageProgress, escaped
from cmfsim.pictures import has_screen
from cmfsim.planning_page import PAGE_FILE, PageContent, page_content, write_planning_page
from cmfsim.planning_server import check_serving, serve_planning
from cmfsim.replanning import ExpectedError, PlanningModel, expected_error, planning_model
from cmfsim.study.prediction import build_patient

__all__ = ["TRIALS", "plan"]

# Plans that are solved exactly to measure the error of the page.
TRIALS = 6


def plan(options: argparse.Namespace) -> int:
    """Builds a case and writes its planning page."""
    case = case_of(options)
    prepare(case, PAGE_FILE.__eq__)
    if options.serve:
        check_serving()
    begun = time.perf_counter()
    notices = Notices(quiet=options.quiet)
    findings = (
        () if options.no_doctor else checked(case, notices, (options.model,), quiet=options.quiet)
    )
    with StageProgress(sys.stderr, quiet=options.quiet) as progress:
        patient = build_patient(
            case,
            (options.model,),
            progress=progress.stage,
            check=False,
            findings=findings,
            on_findings=notices.add,
        )
        progress.stage("computing the plan operator")
        planning = planning_model(patient, options.model)
        progress.stage("solving the case's plan")
        reference = planning.solve(planning.reference)
        errors = expected_error(planning, trials=options.trials, progress=progress.stage)
        progress.stage("writing the page")
        content = page_content(planning, reference, errors)
        notices.add(content.findings)
        case.output.mkdir(parents=True, exist_ok=True)
        path = case.output / PAGE_FILE
        size = write_planning_page(path, content, case_file=case.file.name)
    seconds = time.perf_counter() - begun
    if options.serve:
        _serve(options, planning, content)
        return DONE
    if options.json:
        answer = {
            "case": case.name,
            "page": str(path),
            "bytes": size,
            "seconds": seconds,
            "expected_error": errors.as_dict(),
            "findings": notices.as_dicts(),
        }
        print(json.dumps(answer, allow_nan=False))
        return DONE
    print(f"page   {escaped(str(path))} ({size / 1e6:.1f} MB)")
    print(f"error  {_error_text(errors)}")
    print(f"time   {seconds:.0f} s")
    notices.summarise(str(path))
    if not options.no_open and sys.stdout.isatty() and not os.environ.get("CI") and has_screen():
        webbrowser.open(path.resolve().as_uri())
    return DONE


def _serve(options: argparse.Namespace, planning: PlanningModel, content: PageContent) -> None:
    """Serves the page until it is interrupted; its address is printed first."""

    def started(url: str) -> None:
        if options.json:
            print(json.dumps({"url": url}), flush=True)
        else:
            print(f"page   {url}\nOn this machine alone; Ctrl-C ends it.", flush=True)
        if not options.no_open and has_screen() and sys.stdout.isatty():
            webbrowser.open(url)

    serve_planning(
        planning, content, case_file=options.case.name, port=options.port, on_start=started
    )


def _error_text(errors: ExpectedError) -> str:
    """What exact solutions say about the page, in a line."""
    solved = [trial for trial in errors.trials if not trial.failed]
    failed = len(errors.trials) - len(solved)
    if not solved:
        return f"not measured: none of {failed} plans nearby could be solved"
    mean = max(trial.mean or 0.0 for trial in solved)
    largest = max(trial.largest or 0.0 for trial in solved)
    text = (
        f"at most {mean:.3f} mm on average and {largest:.2f} mm anywhere, at {len(solved)} plans "
        f"up to {errors.reach:.1f} mm from the case's own"
    )
    return f"{text}; {failed} could not be solved" if failed else text
