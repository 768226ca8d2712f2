"""The command line: `cmfsim doctor`, `build`, `solve`, `info`, and made heads to try them on.

Results and `--json` go to standard output, progress and errors to standard error.
Exit codes: 0 done, 1 failed, 2 bad input.
"""

import argparse
import logging
import sys
from collections.abc import Sequence

from cmfsim.cli.exit_codes import BAD_INPUT, DONE, FAILED
from cmfsim.cli.parsing import make_parser
from cmfsim.cli.terminal import ProgressHandler, say_error
from cmfsim.errors import CmfsimError

__all__ = ["BAD_INPUT", "DONE", "FAILED", "main"]


def main(arguments: Sequence[str] | None = None) -> int:
    """The exit code of one command: 0 done, 1 failed, 2 bad input.

    Parameters
    ----------
    arguments : sequence of str, optional
        Words after the program's name; those of the process if left out.

    Returns
    -------
    int

    Examples
    --------
    >>> from cmfsim.cli import main
    >>> main(["solve", "no-such-scene.npz", "-o", "out.npz"])
    2
    """
    parser = make_parser()
    options = parser.parse_args(arguments)
    if options.command is None:
        parser.print_help(sys.stderr)
        return BAD_INPUT
    handler = ProgressHandler()
    logger = logging.getLogger("cmfsim")
    previous = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.WARNING if options.quiet else logging.INFO)
    try:
        return _run(options)
    finally:
        logger.removeHandler(handler)
        logger.setLevel(previous)


def _run(options: argparse.Namespace) -> int:
    try:
        return int(options.run(options))
    except (FileNotFoundError, ValueError) as error:
        say_error(error)
        return BAD_INPUT
    except (CmfsimError, OSError, MemoryError) as error:
        say_error(error)
        return FAILED
    except KeyboardInterrupt:
        print("cmfsim: stopped; existing files are as they were", file=sys.stderr)
        return FAILED
