"""`cmfsim phantom`: a synthetic head for trying things out."""

import argparse
import json
import sys

from cmfsim.cli.exit_codes import DONE
from cmfsim.cli.text.terminal import StageProgress
from cmfsim.lab.virtual.phantom_case import write_phantom_case
from cmfsim.phantom import HeadParameters, make_head
from cmfsim.values.checks import as_positive


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
        print(json.dumps({"case": str(case)}, allow_nan=False))
    else:
        print(f"wrote {case}; build it with: cmfsim build {case}")
    return DONE
