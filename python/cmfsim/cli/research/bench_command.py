"""`cmfsim bench`: the cost of accuracy."""

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path

from cmfsim.cli.exit_codes import DONE
from cmfsim.cli.text.terminal import StageProgress, escaped
from cmfsim.io import Case
from cmfsim.lab.frontier import (
    FACTORS,
    WHOLE,
    Choice,
    Frontier,
    case_choice,
    reference_choice,
    sweep_choices,
)
from cmfsim.lab.frontier import frontier as run_frontier
from cmfsim.lab.frontier.files import write_frontier
from cmfsim.lab.frontier.table import GRID, base_verdict
from cmfsim.lab.virtual.phantom_case import write_phantom_case
from cmfsim.phantom import make_head

FRONTIER_FOLDER = Path("cmfsim-frontier")
# Voxel size of the synthetic head's CT, mm.
PHANTOM_SPACING = 1.0


def frontier(options: argparse.Namespace) -> int:
    """Sweeps a case, or the synthetic head, and writes table, page and picture."""
    with StageProgress(sys.stderr, quiet=options.quiet) as progress:
        path = options.case
        if path is None:
            path = options.output / "head" / "case.toml"
            if not path.exists():
                progress.stage("making a head and imaging it")
                write_phantom_case(path.parent, make_head(), spacing=PHANTOM_SPACING)
        case = Case.load(path)
        base = _base(case, options)
        choices = sweep_choices(
            base,
            edges=options.edges,
            elements=options.elements,
            kinematics=options.kinematics,
            factors={name: FACTORS[name] for name in options.factors},
        )
        finest = min(choice.edge_length for choice in choices)
        reference = reference_choice(
            base,
            finest if options.reference_edge is None else options.reference_edge,
            kinematics=options.reference_kinematics,
        )
        found = run_frontier(
            case,
            options.output,
            choices,
            reference=reference,
            repeats=options.repeats,
            threads=options.threads,
            time_limit=options.time_limit,
            fresh=options.fresh,
            progress=progress.stage,
        )
        progress.stage("writing tables and picture")
        names = write_frontier(options.output, found)
    if options.json:
        answer = {**found.as_dict(), "output": str(options.output), "files": names}
        print(json.dumps(answer, allow_nan=False))
    else:
        print(_text(found))
        print(f"written  {escaped(str(options.output))}: {', '.join(names)}")
    return DONE


def _base(case: Case, options: argparse.Namespace) -> Choice:
    """The case's own choice, with the changes given on the command line."""
    own = case_choice(case)
    words = {"edge_length": options.edge_length, "model": options.model}
    return replace(own, **{name: value for name, value in words.items() if value is not None})


def _text(found: Frontier) -> str:
    """Base and front in a few lines; the rest is on the page."""
    lines = [
        f"{escaped(found.case)}: distance on the face from the reference, mm, and time",
        "  edge  element  kinematics      mean   P95   max   build s  solve s  peak MB",
    ]
    base = found.base
    for row in [base, *(row for row in found.front if row is not base), found.reference]:
        whole = row.error.get(WHOLE)
        if whole is None or row.solve_wall is None or row.build_wall is None:
            lines.append(f"  {row.choice.edge_length:4g}  base: {escaped(row.failure)}")
            continue
        changed = row.choice.changes(base.choice)
        others = [f"{name} {value}" for name, value in changed.items() if name not in GRID]
        role = "base" if row.is_base else "reference" if row.is_reference else ", ".join(others)
        peak = "–" if row.solve_peak is None else f"{row.solve_peak:.0f}"
        lines.append(
            f"  {row.choice.edge_length:4g}  {row.choice.element:<7}  {row.choice.kinematics:<12}  "
            f"{whole.mean:6.3f} {whole.p95:5.2f} {whole.max:5.2f}  {row.build_wall:7.1f}  "
            f"{row.solve_wall.median:7.2f}  {peak:>7}  {role}"
        )
    failed = sum(bool(row.failure) for row in found.rows)
    if failed:
        lines.append(
            f"  {failed} of {len(found.rows)} choices were refused or failed: see frontier.md"
        )
    lines.append(f"  base {base_verdict(base)}")
    return "\n".join(lines)
