"""`cmfsim plan`: the planning page of a case; `cmfsim desk`: from a scan to a plan."""

import argparse
import json
import socket
import sys
import time
import webbrowser
from pathlib import Path

import numpy as np

from cmfsim.cli.exit_codes import DONE
from cmfsim.cli.options import band_options
from cmfsim.cli.patients.case_commands import case_of, checked
from cmfsim.cli.terminal import Notices, StageProgress, can_open, escaped, open_page
from cmfsim.errors import CaseInputError
from cmfsim.pipeline.outputs.planning_page import PLAN_FILE
from cmfsim.pipeline.planning import TARGET_STD, PlanningPage, make_planning_page
from cmfsim.planning.face_planning import FacePlan
from cmfsim.planning.replanning import USUAL, ExpectedError, PlanCorrection
from cmfsim.planning.server import open_port, serve_planning
from cmfsim.values.progress import BUILDING, PLANNING


def plan(options: argparse.Namespace) -> int:
    """Builds a case and writes its planning page."""
    case = case_of(options)
    band = band_options(options, case)
    # Before the work: a port that is taken is not reported a minute later.
    listener = open_port(options.port) if options.serve else None
    begun = time.perf_counter()
    notices = Notices(quiet=options.quiet)
    models = (options.model,)
    findings = () if options.no_doctor else checked(case, notices, models, quiet=options.quiet)
    expected = {**BUILDING, **PLANNING}
    with StageProgress(sys.stderr, quiet=options.quiet, expected=expected) as progress:
        made = make_planning_page(
            case,
            model=options.model,
            trials=options.trials,
            corrections=options.corrections,
            towards=options.towards or (),
            keep_bite=options.keep_bite,
            band=band,
            check=False,
            findings=findings,
            observer=notices,
            progress=progress.stage,
        )
    seconds = time.perf_counter() - begun
    if listener is not None:
        _serve(options, made, case.file.name, listener)
        return DONE
    if options.json:
        found = {"findings": notices.as_dicts()}
        answer = {"case": case.name, "seconds": seconds, **made.as_dict(), **found}
        print(json.dumps(answer, allow_nan=False))
        return DONE
    print(f"page   {escaped(str(made.path))} ({made.path.stat().st_size / 1e6:.1f} MB)")
    print(f"error  {_error_text(made.errors)}")
    if made.planning.correction is not None:
        print(f"       {_correction_text(made.planning.correction)}")
    if made.found is not None:
        print(_towards_text(made.found, str(made.path.with_name(PLAN_FILE))))
    print(f"time   {seconds:.0f} s")
    # The page lists no findings.
    notices.summarise(None)
    open_page(made.path, wanted=not options.no_open)
    return DONE


def _serve(
    options: argparse.Namespace, made: PlanningPage, case_file: str, listener: socket.socket
) -> None:
    """Serves the page until it is interrupted."""
    serve_planning(
        made.planning,
        made.content,
        case_file=case_file,
        port=listener,
        on_start=lambda url: _show(options, "page", url),
    )


def _show(options: argparse.Namespace, what: str, url: str) -> None:
    """Prints the address of a page that is served, and opens it."""
    if options.json:
        print(json.dumps({"url": url}), flush=True)
    else:
        print(f"{what}   {url}\nOnly this machine can open it; stop with Ctrl-C.", flush=True)
    if not options.no_open and can_open():
        webbrowser.open(url)


def desk(options: argparse.Namespace) -> int:
    """Serves the desk of a folder until it is interrupted."""
    # Landmarks and procedures: other commands do not load them.
    from cmfsim.desk.server import desk_server  # noqa: PLC0415
    from cmfsim.desk.session import Session  # noqa: PLC0415

    folder: Path = options.folder
    if not folder.exists():
        raise FileNotFoundError(f"{folder}: no such folder")
    if folder.is_file() and folder.suffix != ".toml":
        raise CaseInputError(f"{folder.name}: name a folder, or a case.toml")
    session = Session(folder)
    server = desk_server(session, open_port(options.port))
    session.begin()
    _show(options, "desk", server.url)
    try:
        server.run()
    finally:
        session.end()
    return DONE


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


def _towards_text(found: FacePlan, path: str) -> str:
    """The plan that was found, its error, and what the desired face leaves undetermined."""
    lines = [f"wish   {name}: {motion.text}" for name, motion in found.motions.items()]
    lines.append(
        f"       the exact solution is off by {TARGET_STD * max(found.exact_rms):.2f} mm RMS"
    )
    if found.at_bounds:
        lines.append(f"       at its bound: {', '.join(found.at_bounds)}")
    if found.undetermined:
        lines.append(f"       the desired face does not determine: {', '.join(found.undetermined)}")
    if not found.converged:
        lines.append("       the search did not converge: use the result only as a first guess")
    return "\n".join(escaped(line) for line in [*lines, f"       saved as {path}"])
