"""Options of the command line: short forms of argparse's, and those for a band."""

import argparse
from pathlib import Path
from typing import Any

from cmfsim.io import Case
from cmfsim.io.results.calibrations import read_calibration
from cmfsim.values.skin_band import BandOptions


def switch(command: argparse.ArgumentParser, names: str, words: str) -> None:
    """Adds an option without a value; `names` are separated by blanks, `words` are the help."""
    command.add_argument(*names.split(), action="store_true", help=words)


def file(
    command: argparse.ArgumentParser, names: str, metavar: str, words: str, **more: Any
) -> None:
    """Adds a file or a folder: an option, or an argument whose name has no dash."""
    command.add_argument(*names.split(), metavar=metavar, type=Path, help=words, **more)


def number(
    command: argparse.ArgumentParser, names: str, metavar: str, words: str, **more: Any
) -> None:
    """Adds a real number."""
    command.add_argument(*names.split(), metavar=metavar, type=float, help=words, **more)


def whole(
    command: argparse.ArgumentParser, names: str, metavar: str, words: str, **more: Any
) -> None:
    """Adds a whole number."""
    command.add_argument(*names.split(), metavar=metavar, type=int, help=words, **more)


def add_band_options(command: argparse.ArgumentParser) -> None:
    """Adds them to a command."""
    switch(
        command,
        "--band",
        "add an uncertainty band of the face to the report, the files and the terminal output",
    )
    file(
        command,
        "--calibration",
        "FILE",
        "calibration of the band, from cases whose outcome is known; without one, the band "
        "is marked as uncalibrated",
    )
    number(command, "--coverage", "SHARE", "coverage of the band (default 0.9, that is 90 %%)")
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
