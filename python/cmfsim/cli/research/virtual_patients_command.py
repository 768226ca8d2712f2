"""`cmfsim virtual-patients`: synthetic heads with their postoperative faces, to test models."""

import argparse
import json
import sys

from cmfsim.cli.exit_codes import DONE
from cmfsim.cli.text.terminal import StageProgress
from cmfsim.errors import CaseInputError
from cmfsim.io.results.populations import FAILED, MADE, PARTS, PENDING
from cmfsim.lab.virtual import PatientOutcome, virtual_population
from cmfsim.lab.virtual import virtual_patients as write_patients
from cmfsim.lab.virtual.patient_folder import PATIENTS_WITH_JOINED_LIPS
from cmfsim.lab.virtual.population import OWN


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
        print(json.dumps({"cases": [str(case) for case in cases]}, allow_nan=False))
    else:
        for case in cases:
            print(f"wrote {case} (in silico); the truth is in {case.parent / 'truth'}")
        print(f"next: cmfsim study {options.folder / 'cohort.toml'}")
    return DONE


def _population(options: argparse.Namespace) -> int:
    """Writes drawn patients."""
    if options.patients is not None:
        raise CaseInputError("--patients names patients, --count draws them: give one of the two")

    def tell(outcome: PatientOutcome) -> None:
        if not options.quiet:
            why = f": {outcome.reason}" if outcome.reason else ""
            counted = f"{outcome.done} of {outcome.count}"
            print(f"{counted}  {outcome.name} {outcome.status}{why}", file=sys.stderr, flush=True)

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
        print(json.dumps({"settings": dict(found.settings), "patients": patients}))
        return DONE
    counts = ", ".join(f"{len(found.named(MADE, part))} {part}" for part in PARTS)
    print(f"{len(found.patients)} patients drawn (in silico): {counts}")
    for state in (FAILED, PENDING):
        if found.named(state):
            print(f"{state}: {', '.join(found.named(state))} (population.json)")
    print(f"next: cmfsim benchmark {options.folder}")
    return DONE
