"""`cmfsim phantom`, `virtual-patients`, `benchmark` and `bench frontier`: methods are tried."""

import argparse
import sys
from dataclasses import replace

from cmfsim.cli import DONE
from cmfsim.cli.terminal import StageProgress, argument, escaped, print_json, print_text
from cmfsim.errors import CaseInputError
from cmfsim.io import Case
from cmfsim.io.results.populations import FAILED, MADE, PARTS, PENDING
from cmfsim.lab.benchmark.running import run_benchmark
from cmfsim.lab.frontier.choice import FACTORS, case_choice, reference_choice, sweep_choices
from cmfsim.lab.frontier.files import GRID, base_verdict, write_frontier
from cmfsim.lab.frontier.frontier_run import frontier as run_frontier
from cmfsim.lab.frontier.rows import WHOLE, Frontier
from cmfsim.lab.virtual.demo import write_phantom_case
from cmfsim.lab.virtual.patient_folder import PATIENTS_WITH_JOINED_LIPS
from cmfsim.lab.virtual.patient_folder import virtual_patients as write_patients
from cmfsim.lab.virtual.population import OWN
from cmfsim.lab.virtual.population_folder import PatientOutcome, virtual_population
from cmfsim.phantom.model import make_head
from cmfsim.phantom.parameters import HeadParameters
from cmfsim.values.checks import as_positive

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
        words = {"edge_length": options.edge_length, "model": options.model}
        given = {name: value for name, value in words.items() if value is not None}
        base = replace(case_choice(case), **given)
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
        print_json(answer)
    else:
        print_text(_frontier_text(found))
        print_text(f"written  {escaped(str(options.output))}: {', '.join(names)}")
    return DONE


def _frontier_text(found: Frontier) -> str:
    """Base and front in a few lines; the rest is on the page."""
    lines = [
        f"{escaped(found.case)}: distance on the face from the reference, mm, and time",
        "  edge  element  kinematics      mean   P95   max   build s  solve s  peak MB",
    ]
    base = found.base
    for row in [base, *(row for row in found.front if row is not base), found.reference]:
        error = row.error.get(WHOLE)
        if error is None or row.solve_wall is None or row.build_wall is None:
            lines.append(f"  {row.choice.edge_length:4g}  base: {escaped(row.failure)}")
            continue
        changed = row.choice.changes(base.choice)
        others = [f"{name} {value}" for name, value in changed.items() if name not in GRID]
        role = "base" if row.is_base else "reference" if row.is_reference else ", ".join(others)
        peak = "–" if row.solve_peak is None else f"{row.solve_peak:.0f}"
        lines.append(
            f"  {row.choice.edge_length:4g}  {row.choice.element:<7}  {row.choice.kinematics:<12}  "
            f"{error.mean:6.3f} {error.p95:5.2f} {error.max:5.2f}  {row.build_wall:7.1f}  "
            f"{row.solve_wall.median:7.2f}  {peak:>7}  {role}"
        )
    failed = sum(bool(row.failure) for row in found.rows)
    if failed:
        lines.append(
            f"  {failed} of {len(found.rows)} choices were refused or failed: see frontier.md"
        )
    lines.append(f"  base {base_verdict(base)}")
    return "\n".join(lines)


def phantom(options: argparse.Namespace) -> int:
    """Writes the case of a synthetic head: CT, landmarks and case file."""
    spacing = as_positive("--spacing", options.spacing)
    parameters = HeadParameters()
    if options.person is not None:
        parameters = HeadParameters.random(options.person)
    with StageProgress(sys.stderr, quiet=options.quiet) as progress:
        progress.stage("making a head")
        head = make_head(parameters)
        progress.stage("imaging it")
        case = write_phantom_case(options.folder, head, spacing=spacing)
    if options.json:
        print_json({"case": str(case)})
    else:
        print_text(f"wrote {case}; build it with: cmfsim build {case}")
    return DONE


def virtual_patients(options: argparse.Namespace) -> int:
    """Writes virtual patients: the case before, the truth after the operation."""
    if options.count is not None:
        return _population(options)
    if options.workers != 1 or options.scheduler is not None or options.truth is not None:
        raise CaseInputError(
            "--workers, --scheduler and --truth are for drawn patients: give --count too"
        )
    with StageProgress(sys.stderr, quiet=options.quiet) as progress:
        cases = write_patients(
            options.folder,
            options.patients or PATIENTS_WITH_JOINED_LIPS,
            seed=options.seed,
            edge_length=options.edge_length,
            spacing=options.spacing,
            progress=progress.stage,
        )
    if options.json:
        print_json({"cases": [str(case) for case in cases]})
    else:
        for case in cases:
            print_text(f"wrote {case} (in silico); the truth is in {case.parent / 'truth'}")
        print_text(f"next: cmfsim study {argument(options.folder / 'cohort.toml')}")
    return DONE


def _population(options: argparse.Namespace) -> int:
    """Writes drawn patients."""
    if options.patients is not None:
        raise CaseInputError("--patients names patients, --count draws them: give one of the two")

    def tell(outcome: PatientOutcome) -> None:
        if not options.quiet:
            why = f": {outcome.reason}" if outcome.reason else ""
            counted = f"{outcome.done} of {outcome.count}"
            print_text(
                f"{counted}  {outcome.name} {outcome.status}{why}", file=sys.stderr, flush=True
            )

    found = virtual_population(
        options.folder,
        options.count,
        seed=options.seed,
        edge_length=options.edge_length,
        spacing=options.spacing,
        truth=options.truth or OWN,
        workers=options.workers,
        scheduler=options.scheduler,
        progress=tell,
    )
    if options.json:
        patients = {name: entry.as_dict() for name, entry in found.patients.items()}
        print_json({"settings": dict(found.settings), "patients": patients})
        return DONE
    counts = ", ".join(f"{len(found.named(MADE, part))} {part}" for part in PARTS)
    print_text(f"{len(found.patients)} patients drawn (in silico): {counts}")
    for state in (FAILED, PENDING):
        if found.named(state):
            print_text(f"{state}: {', '.join(found.named(state))} (population.json)")
    print_text(f"next: cmfsim benchmark {argument(options.folder)}")
    return DONE


def benchmark(options: argparse.Namespace) -> int:
    """Makes the package's own entries, and scores all that are there."""

    def tell(line: str) -> None:
        if not options.quiet:
            print_text(line, file=sys.stderr, flush=True)

    found = run_benchmark(
        options.folder,
        part=options.part,
        entries=options.entries,
        band=options.band,
        band_parts=options.band_parts,
        workers=options.workers,
        scheduler=options.scheduler,
        progress=tell,
    )
    if options.json:
        print(found.table.json(), end="")
        return DONE
    print_text(found.table.markdown())
    for path in found.files:
        print_text(f"wrote {path}")
    return DONE
