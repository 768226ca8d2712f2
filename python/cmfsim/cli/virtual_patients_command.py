"""`cmfsim virtual-patients`: synthetic heads with their postoperative faces, to test models."""

import argparse
import json
import sys

from cmfsim.cli.exit_codes import DONE
from cmfsim.cli.terminal import StageProgress
from cmfsim.virtual import virtual_patients as write_patients

__all__ = ["virtual_patients"]


def virtual_patients(options: argparse.Namespace) -> int:
    """Writes virtual patients: the case before, the truth after the operation."""
    with StageProgress(sys.stderr, quiet=options.quiet) as progress:
        cases = write_patients(
            options.folder,
            options.patients,
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
