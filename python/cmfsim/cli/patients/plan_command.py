"""`cmfsim plan`: the planning page of a case."""

import argparse
import json
import socket
import sys
import time
import webbrowser
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cmfsim.cli.band_options import band_options
from cmfsim.cli.exit_codes import DONE
from cmfsim.cli.opening import can_open, open_page
from cmfsim.cli.patients.case_commands import case_of, checked
from cmfsim.cli.patients.desired_faces import TARGET_STD, read_targets
from cmfsim.cli.text.notices import Notices
from cmfsim.cli.text.terminal import StageProgress, escaped
from cmfsim.errors import CaseInputError
from cmfsim.io import Case, write_plan
from cmfsim.pipeline.building.stages import BuildOptions
from cmfsim.pipeline.outputs.planning_page import PAGE_FILE, write_planning_page
from cmfsim.pipeline.predicting import build_patient
from cmfsim.pipeline.preparation import prepare
from cmfsim.planning.face_planning import FacePlan, FaceSearch, plan_for_face
from cmfsim.planning.page import PageContent, page_content
from cmfsim.planning.replanning import (
    USUAL,
    ExpectedError,
    PlanCorrection,
    PlanningModel,
    corrected_planning,
    expected_error,
    plan_band,
    planning_model,
)
from cmfsim.planning.server import open_port, serve_planning
from cmfsim.values.progress import BUILDING, PLANNING

# Name of the plan for a desired face, and the file to which it is saved.
TOWARDS, PLAN_FILE = "Towards", "towards.toml"
# Plans that are solved exactly to measure the error of the page.
TRIALS = 6


@dataclass(frozen=True, eq=False)
class _Made:
    """The results of the command."""

    planning: PlanningModel
    content: PageContent
    errors: ExpectedError
    found: FacePlan | None


def plan(options: argparse.Namespace) -> int:
    """Builds a case and writes its planning page."""
    case = case_of(options)
    prepare(case, {PAGE_FILE, PLAN_FILE}.__contains__)
    for name, least in (("trials", 1), ("corrections", 0)):
        if getattr(options, name) < least:
            raise CaseInputError(
                f"--{name} is {getattr(options, name)}: a whole number of {least} or more is needed"
            )
    # Before the work: a port that is taken is not reported a minute later.
    listener = open_port(options.port) if options.serve else None
    begun = time.perf_counter()
    notices = Notices(quiet=options.quiet)
    made = _made(options, case, notices)
    case.output.mkdir(parents=True, exist_ok=True)
    path = case.output / PAGE_FILE
    size = write_planning_page(path, made.content, case_file=case.file.name)
    if made.found is not None:
        made_for = str(made.planning.patient.summary.get("plan_key", ""))
        write_plan(case.output / PLAN_FILE, made.found.plan, made_for=made_for)
    seconds = time.perf_counter() - begun
    if listener is not None:
        _serve(options, made, case.file.name, listener)
        return DONE
    if options.json:
        answer = {
            "case": case.name,
            "page": str(path),
            "bytes": size,
            "seconds": seconds,
            "expected_error": made.errors.as_dict(),
            "correction": _correction_values(made.planning.correction),
            "towards": None if made.found is None else _towards_values(made.found),
            "findings": notices.as_dicts(),
        }
        print(json.dumps(answer, allow_nan=False))
        return DONE
    print(f"page   {escaped(str(path))} ({size / 1e6:.1f} MB)")
    print(f"error  {_error_text(made.errors)}")
    if made.planning.correction is not None:
        print(f"       {_correction_text(made.planning.correction)}")
    if made.found is not None:
        print(_towards_text(made.found, case.output / PLAN_FILE))
    print(f"time   {seconds:.0f} s")
    # The page lists no findings.
    notices.summarise(None)
    open_page(path, wanted=not options.no_open)
    return DONE


def _made(options: argparse.Namespace, case: Case, notices: Notices) -> _Made:
    """Everything that the page contains."""
    # Before any work, so that an invalid file is not reported a minute later.
    targets = None if options.towards is None else read_targets(options.towards)
    models = (options.model,)
    wanted = band_options(options, case)
    if wanted is not None:
        wanted.check(models)
    findings = () if options.no_doctor else checked(case, notices, models, quiet=options.quiet)
    expected = {**BUILDING, **PLANNING}
    with StageProgress(sys.stderr, quiet=options.quiet, expected=expected) as progress:
        asked = BuildOptions(
            progress=progress.stage, check=False, findings=findings, observer=notices
        )
        patient = build_patient(case, models, asked)
        progress.stage("computing the plan operator")
        planning = planning_model(patient, options.model)
        progress.stage("solving the case's plan")
        band = None
        if wanted is None:
            reference = planning.solve(planning.reference)
        else:
            # Regions and proposed landmarks: a page without a band does not load them.
            from cmfsim.pipeline.banding import predict_with_band  # noqa: PLC0415

            reference = predict_with_band(
                planning.patient, planning.model, wanted, solver=planning.solver
            )
            progress.stage("computing how far to trust the face")
            band = plan_band(planning, reference)
        planning = corrected_planning(planning, options.corrections, progress=progress.stage)
        errors = expected_error(planning, trials=options.trials, progress=progress.stage)
        found = None
        if targets is not None:
            progress.stage("searching for the plan of the desired face")
            found = plan_for_face(planning, targets(planning), _search(options, planning))
        progress.stage("making the page")
        wished = {} if found is None else {TOWARDS: found.plan}
        content = page_content(planning, reference, errors, variants=wished, band=band)
    notices.found(content.findings)
    return _Made(planning, content, errors, found)


def _serve(
    options: argparse.Namespace, made: _Made, case_file: str, listener: socket.socket
) -> None:
    """Serves the page until it is interrupted; its address is printed first."""

    def started(url: str) -> None:
        if options.json:
            print(json.dumps({"url": url}), flush=True)
        else:
            print(f"page   {url}\nOnly this machine can open it; stop with Ctrl-C.", flush=True)
        if not options.no_open and can_open():
            webbrowser.open(url)

    serve_planning(
        made.planning, made.content, case_file=case_file, port=listener, on_start=started
    )


def _error_text(errors: ExpectedError) -> str:
    """The error of the page as measured by exact solutions, in one line."""
    if not errors.slides:
        return "none: no tissue slides, so the page is exact for every plan"
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


def _correction_text(correction: PlanCorrection) -> str:
    before, after = float(correction.before.max()), float(correction.left_out.max())
    usual = float(np.percentile(correction.left_out, USUAL))
    return (
        f"corrected by {len(correction.plans)} other plans: {before:.2f} mm at most before, "
        f"{after:.2f} mm when each is predicted from the others (nine of ten: {usual:.2f} mm)"
    )


def _correction_values(correction: PlanCorrection | None) -> dict[str, Any] | None:
    """The figures of the correction; None if there is none."""
    if correction is None:
        return None
    return {
        "plans": len(correction.plans),
        "shapes": correction.weights.shape[1],
        "length_mm": correction.length,
        "largest_before_mm": correction.before.tolist(),
        "largest_left_out_mm": correction.left_out.tolist(),
    }


def _search(options: argparse.Namespace, planning: PlanningModel) -> FaceSearch:
    """The options of the search for the plan of a desired face."""
    if not options.keep_bite:
        return FaceSearch()
    upper = next((n for n in ("maxilla", "midface") if n in planning.segments), None)
    lower = next((n for n in ("mandible_body", "mandible") if n in planning.segments), None)
    if upper is None or lower is None:
        raise CaseInputError(
            "--keep-bite needs a maxilla and a mandible that move; segments are: "
            + ", ".join(planning.segments)
        )
    return FaceSearch(follows={lower: upper})


def _towards_values(found: FacePlan) -> dict[str, Any]:
    return {
        "plan": {name: motion.as_dict() for name, motion in found.motions.items()},
        "std": {name: row.tolist() for name, row in found.std.items()},
        "undetermined": list(found.undetermined),
        "at_bounds": list(found.at_bounds),
        "rms": [float(np.sqrt((row**2).mean())) for row in found.exact_residuals],
        "converged": found.converged,
    }


def _towards_text(found: FacePlan, path: Path) -> str:
    """The plan that was found, its error, and what the desired face leaves undetermined."""
    lines = [f"wish   {name}: {motion.text}" for name, motion in found.motions.items()]
    rms = [float(np.sqrt((row**2).mean())) for row in found.exact_residuals]
    lines.append(f"       the exact solution is off by {TARGET_STD * max(rms):.2f} mm RMS")
    if found.at_bounds:
        lines.append(f"       at its bound: {', '.join(found.at_bounds)}")
    if found.undetermined:
        lines.append(f"       the desired face does not determine: {', '.join(found.undetermined)}")
    if not found.converged:
        lines.append("       the search did not converge: use the result only as a first guess")
    return "\n".join(escaped(line) for line in [*lines, f"       saved as {path}"])
