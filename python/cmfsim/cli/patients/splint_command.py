"""`cmfsim splint`: a splint between the tooth rows of a case, as a closed surface."""

import argparse
import json
import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

from cmfsim.cli.exit_codes import DONE
from cmfsim.cli.patients.case_commands import case_of, checked
from cmfsim.cli.terminal import Notices, StageProgress, escaped
from cmfsim.io import write_surface
from cmfsim.pipeline.building.inputs import check_output

# Jaws that may be operated on first.
FIRST = ("maxilla", "mandible")


def add_splint(commands: Any, named: argparse.ArgumentParser) -> None:
    """Adds the command and its options."""
    splint = commands.add_parser(
        "splint",
        parents=[named],
        help="write a surgical splint between the planned tooth rows, as STL",
        epilog="The teeth must be in the bones of the case. A splint for a closed bite needs room: "
        "the error states by how many degrees the lower jaw has to be opened.",
    )
    splint.add_argument(
        "--intermediate",
        metavar="FIRST",
        nargs="?",
        const=FIRST[0],
        choices=FIRST,
        help="the splint after one jaw: maxilla (default) or mandible first; without it, the final "
        "splint with both jaws as planned",
    )
    splint.add_argument(
        "--thickness", metavar="MM", type=float, help="least thickness of walls (default 2)"
    )
    splint.add_argument(
        "--open",
        metavar="DEGREES",
        type=float,
        default=0.0,
        help="open the lower jaw about its joint heads (default 0)",
    )
    splint.add_argument("--label", metavar="TEXT", default="", help="raised letters on the front")
    splint.add_argument(
        "--plan", metavar="PLAN", type=Path, help="plan.toml to use instead of the case's plan"
    )
    splint.add_argument(
        "-o",
        "--out",
        metavar="FILE",
        type=Path,
        help="file to write (default: splint-final.stl or splint-intermediate.stl among the "
        "results of the case)",
    )
    splint.add_argument("--no-doctor", action="store_true", help="skip the checks of the case")
    splint.set_defaults(run=splint_case, edge_length=None, output=None)


def splint_case(options: argparse.Namespace) -> int:
    """Makes a splint and writes it."""
    case = case_of(options)
    kind = "intermediate" if options.intermediate else "final"
    path = options.out or case.output / f"splint-{kind}.stl"
    if options.out is None:
        check_output(case, lambda name: name == path.name)
    else:
        check_output(replace(case, output=path.parent), lambda name: name == path.name)
    notices = Notices(quiet=options.quiet)
    findings = () if options.no_doctor else checked(case, notices, quiet=options.quiet)
    more = {} if options.thickness is None else {"thickness": options.thickness}
    with StageProgress(sys.stderr, quiet=options.quiet) as progress:
        made = import_module("cmfsim.pipeline.outputs.splint").make_splint(
            case,
            intermediate=options.intermediate,
            opening=options.open,
            label=options.label,
            progress=progress.stage,
            check=False,
            findings=findings,
            observer=notices,
            **more,
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        write_surface(path, made.surface)
    values = {
        "splint": kind,
        "file": str(path),
        "thickness_mm": made.thickness,
        "seat_mm": made.seat,
        "opening_degrees": made.opening,
    }
    if options.json:
        print(json.dumps({"case": case.name, **values}, allow_nan=False))
        return DONE
    print(f"splint {kind}: {escaped(str(path))}")
    print(
        f"       {made.thickness:.2f} mm thick between the teeth, which seat to {made.seat:.2f} mm"
    )
    if made.opening:
        print(f"       the lower jaw is opened by {made.opening:g}° about its joint heads")
    return DONE
