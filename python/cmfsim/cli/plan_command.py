"""`cmfsim plan`, `cmfsim splint` and `cmfsim bite` of a case; `cmfsim desk`: scan to plan."""

import argparse
import sys
import time
import webbrowser
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np

from cmfsim.cli import DONE
from cmfsim.cli.case_commands import band_options, case_of, checked
from cmfsim.cli.terminal import StageProgress, can_open, escaped, open_page, print_json, print_text
from cmfsim.errors import CaseInputError
from cmfsim.io import Case, read_surface, write_plan, write_surface
from cmfsim.pipeline.building.inputs import check_output, plan_key
from cmfsim.pipeline.planning import PLAN_FILE, TARGET_STD, make_planning_page
from cmfsim.planning.face_planning.planning import FacePlan
from cmfsim.planning.replanning.correction import PlanCorrection
from cmfsim.planning.replanning.expected_error import USUAL, ExpectedError
from cmfsim.planning.server import open_port, serve_planning
from cmfsim.values.progress import BUILDING, PLANNING


def plan(options: argparse.Namespace) -> int:
    """Builds a case and writes its planning page."""
    case = case_of(options)
    band = band_options(options, case)
    # Before the work: a port that is taken is not reported a minute later.
    listener = open_port(options.port) if options.serve else None
    begun = time.perf_counter()
    notices, asked = checked(options, case, (options.model,))
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
            progress=progress.stage,
            **asked,
        )
    seconds = time.perf_counter() - begun
    if listener is not None:
        serve_planning(
            made.planning,
            made.content,
            case_file=case.file.name,
            port=listener,
            on_start=lambda url: _show(options, "page", url),
        )
        return DONE
    if options.json:
        answer = {"case": case.name, "seconds": seconds, **made.as_dict()}
        print_json({**answer, "findings": notices.as_dicts()})
        return DONE
    print_text(f"page   {escaped(str(made.path))} ({made.path.stat().st_size / 1e6:.1f} MB)")
    print_text(f"error  {_error_text(made.errors)}")
    if made.planning.correction is not None:
        print_text(f"       {_correction_text(made.planning.correction)}")
    if made.found is not None:
        print_text(_towards_text(made.found, str(made.path.with_name(PLAN_FILE))))
    print_text(f"time   {seconds:.0f} s")
    # The page lists no findings.
    notices.summarise(None)
    open_page(made.path, wanted=not options.no_open)
    return DONE


def _show(options: argparse.Namespace, what: str, url: str) -> None:
    """Prints the address of a page that is served, and opens it."""
    if options.json:
        print_json({"url": url}, flush=True)
    else:
        print_text(f"{what}   {url}\nOnly this machine can open it; stop with Ctrl-C.", flush=True)
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
    if errors.is_exact:
        return "none: no tissue slides or is lifted, so the page is exact for every plan"
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


def _free_path(case: Case, out: Path | None, name: str) -> Path:
    """The file to write, by default among the results; it replaces no input of the case."""
    path: Path = out or case.output / name
    place = case if out is None else replace(case, output=path.parent)
    check_output(place, lambda name: name == path.name)
    return path


def splint_case(options: argparse.Namespace) -> int:
    """Makes a splint and writes it."""
    case = case_of(options)
    kind = "intermediate" if options.intermediate else "final"
    # The whole name is known when the plan is.
    _free_path(case, options.out, f"splint-{kind}.stl")
    _, asked = checked(options, case)
    more = {} if options.thickness is None else {"thickness": options.thickness}
    with StageProgress(sys.stderr, quiet=options.quiet) as progress:
        made = import_module("cmfsim.pipeline.planning").make_splint(
            case,
            intermediate=options.intermediate,
            opening=options.open,
            label=options.label,
            progress=progress.stage,
            **asked,
            **more,
        )
        which = "-".join(filter(None, (kind, made.first, made.plan_digits)))
        path = _free_path(case, options.out, f"splint-{which}.stl")
        path.parent.mkdir(parents=True, exist_ok=True)
        write_surface(path, made.surface)
    values = {
        "splint": kind,
        "first": made.first,
        "plan_digits": made.plan_digits,
        "file": str(path),
        "thickness_mm": made.thickness,
        "seat_mm": made.seat,
        "opening_degrees": made.opening,
    }
    if options.json:
        print_json({"case": case.name, **values})
        return DONE
    print_text(f"splint {kind}: {escaped(str(path))}")
    other = "mandible" if made.first == "maxilla" else "maxilla"
    held = f"{made.first} as planned, {other} as before the operation"
    print_text(f"       {held if made.first else 'both jaws as planned'}; plan {made.plan_digits}")
    print_text(
        f"       {made.thickness:.2f} mm thick between the teeth, which seat to {made.seat:.2f} mm"
    )
    if made.opening:
        print_text(f"       the lower jaw is opened by {made.opening:g}° about its joint heads")
    return DONE


def bite_case(options: argparse.Namespace) -> int:
    """Finds the final bite and writes the plan."""
    case = case_of(options)
    path = _free_path(case, options.out, "bite.toml")
    # One of each would be in two frames.
    given = case.bite if options.upper is options.lower is None else options
    if given is None or given.upper is None or given.lower is None:
        raise CaseInputError(
            "scans of both jaws are needed: give --upper and --lower, or name both in [bite] of "
            "the case file"
        )
    scans = read_surface(given.upper), read_surface(given.lower)
    _, asked = checked(options, case)
    with StageProgress(sys.stderr, quiet=options.quiet) as progress:
        bite, plan = import_module("cmfsim.pipeline.planning").plan_for_bite(
            case, *scans, progress=progress.stage, **asked
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        write_plan(path, plan, made_for=plan_key(case))
    if options.json:
        print_json({"case": case.name, "file": str(path), **bite.as_dict()})
        return DONE
    print_text(f"plan   {escaped(str(path))}: cmfsim predict --plan")
    print_text(
        f"       scans fit to {bite.upper_error:.2f} mm (upper) and {bite.lower_error:.2f} mm "
        f"(lower); rows overlap by {bite.overlap:.2f} mm, {bite.gap:.2f} mm apart"
    )
    return DONE
