"""The command-line options for a band."""

import argparse
from pathlib import Path

from cmfsim.io import Case
from cmfsim.io.results.calibrations import read_calibration
from cmfsim.values.band_options import BandOptions


def add_band_options(command: argparse.ArgumentParser) -> None:
    """Adds them to a command."""
    command.add_argument(
        "--band",
        action="store_true",
        help="add an uncertainty band of the face to the report, the files and the terminal output",
    )
    command.add_argument(
        "--calibration",
        metavar="FILE",
        type=Path,
        help="calibration of the band, from cases whose outcome is known; without one, the band "
        "is marked as uncalibrated",
    )
    command.add_argument(
        "--coverage",
        metavar="SHARE",
        type=float,
        help="coverage of the band (default 0.9, that is 90 %%)",
    )
    command.add_argument(
        "--group", metavar="NAME", help="use only the calibration cases of this group"
    )


def band_options(options: argparse.Namespace, case: Case) -> BandOptions | None:
    """The band that the command line or the case asks for; the command line comes first."""
    given = (options.calibration, options.coverage, options.group)
    if not (options.band or case.band.asked or any(value is not None for value in given)):
        return None
    file = case.band.calibration if options.calibration is None else options.calibration
    return BandOptions(
        coverage=case.band.coverage if options.coverage is None else options.coverage,
        calibration=None if file is None else read_calibration(file),
        group=case.band.group if options.group is None else options.group,
        source="" if file is None else file.name,
    )
