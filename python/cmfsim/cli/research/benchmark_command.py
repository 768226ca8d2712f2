"""`cmfsim benchmark`: every method's predictions of a population, scored."""

import argparse
import sys

from cmfsim.cli.exit_codes import DONE
from cmfsim.lab.benchmark import run_benchmark


def benchmark(options: argparse.Namespace) -> int:
    """Makes the package's own entries, and scores all that are there."""

    def tell(line: str) -> None:
        if not options.quiet:
            print(line, file=sys.stderr, flush=True)

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
    print(found.table.markdown())
    for file in found.files:
        print(f"wrote {file}")
    return DONE
