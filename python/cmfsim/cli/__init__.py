"""The command line: `cmfsim doctor`, `build`, `solve`, `info`, and synthetic heads to try them on.

Results and `--json` go to standard output, progress, warnings and errors to standard error.
Exit codes: 0 done, 1 failed, 2 bad input, 141 where standard output was closed.
"""

import argparse
import contextlib
import gc
import io
import json
import logging
import os
import select
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from cmfsim.errors import CmfsimError, error_text
from cmfsim.processes.memory import keep_freed_memory

__all__ = ["BAD_INPUT", "CLOSED", "DONE", "FAILED", "main"]

# The last is what shells report of a program that a closed pipe ended: 128 and the signal's number.
DONE, FAILED, BAD_INPUT, CLOSED = 0, 1, 2, 141


def main(arguments: Sequence[str] | None = None) -> int:
    """The exit code of one command: 0 done, 1 failed, 2 bad input.

    arguments: Arguments after the program's name; by default those of the process.

    Examples
    --------
    >>> from cmfsim.cli import main
    >>> main(["solve", "no-such-scene.npz", "-o", "out.npz"])
    2
    """
    words = sys.argv[1:] if arguments is None else list(arguments)
    if arguments is None:
        # The process is this command's; a caller's stays as it is.
        keep_freed_memory()
        # What a command loads first is no garbage: looking for some took a tenth of that time.
        gc.disable()
        # The products here are thin: numpy's own threads only wait for each other, and keep
        # processors from other work. It is read when numpy is loaded: below, by the commands.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from cmfsim.cli.terminal import print_error, spell_out  # noqa: PLC0415 (loads numpy)

    _open_closed_streams()
    if arguments is None:
        spell_out(sys.stdout, sys.stderr)
    try:
        code = _command(words, is_own=arguments is None)
        # Here, not at the end of the interpreter, where nobody would catch it.
        sys.stdout.flush()
    except OSError as error:
        if isinstance(error, BrokenPipeError) and _output_is_closed():
            _drop_output()
            return CLOSED
        # What was printed did not reach its file, as on a full disk.
        _drop_output()
        print_error(error)
        return FAILED
    return code


def _command(words: Sequence[str], *, is_own: bool) -> int:
    options = _parsed(words)
    if isinstance(options, int):
        return options
    if is_own:
        gc.freeze()
        gc.enable()
    from cmfsim.cli.terminal import ProgressHandler  # noqa: PLC0415 (loads numpy)

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


def _parsed(words: Sequence[str]) -> argparse.Namespace | int:
    """The options of a command line, or the exit code if it has none."""
    from cmfsim.cli.parsing import function_of, make_parser  # noqa: PLC0415 (loads numpy)

    parser = make_parser()
    if "--json" not in words:
        options = parser.parse_args(words)
    else:
        # Words that are wrong are an error like others to who reads JSON.
        said = io.StringIO()
        try:
            with contextlib.redirect_stderr(said):
                options = parser.parse_args(words)
        except SystemExit as error:
            print(said.getvalue(), end="", file=sys.stderr)
            if error.code == BAD_INPUT:
                lines = said.getvalue().strip().splitlines() or ["invalid arguments"]
                _print_json("UsageError", lines[-1], BAD_INPUT)
            raise
    if options.command is None:
        parser.print_help(sys.stderr)
        return BAD_INPUT
    options.run = function_of(options.run)
    return options


def _run(options: argparse.Namespace) -> int:
    from cmfsim.cli.terminal import FindingsError, print_findings, print_text  # noqa: PLC0415 (loads numpy)

    try:
        return int(options.run(options))
    except BrokenPipeError:
        raise
    except FindingsError as error:
        print_findings(error.findings, sys.stderr)
        if getattr(options, "json", False):
            more = {"findings": [vars(finding) for finding in error.findings]}
            _print_json("FindingsError", str(error), BAD_INPUT, more)
        return BAD_INPUT
    except (FileNotFoundError, ValueError) as error:
        return _ended(options, error, BAD_INPUT)
    except (CmfsimError, OSError, MemoryError) as error:
        return _ended(options, error, FAILED)
    except KeyboardInterrupt:
        text = "stopped; existing files are unchanged"
        print_text(f"cmfsim: {text}", file=sys.stderr)
        if getattr(options, "json", False):
            _print_json("KeyboardInterrupt", text, FAILED)
        return FAILED


def _ended(options: argparse.Namespace, error: BaseException, code: int) -> int:
    from cmfsim.cli.terminal import print_error  # noqa: PLC0415 (loads numpy)

    print_error(error)
    if getattr(options, "json", False):
        _print_json(type(error).__name__, error_text(error), code)
    return code


def _print_json(kind: str, text: str, code: int, more: Mapping[str, Any] | None = None) -> None:
    print(json.dumps({"error": {"kind": kind, "text": text, "exit": code}, **(more or {})}))


def _open_closed_streams() -> None:
    """Connects standard output and error to the null device if the process has none."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            stream = open(os.devnull, "w", encoding="utf-8")  # noqa: PTH123, SIM115 (kept open)
            setattr(sys, name, stream)


def _output_is_closed() -> bool:
    """Whether standard output is no longer read; true if the system does not report it."""
    try:
        poll = select.poll()
        poll.register(sys.stdout.fileno(), select.POLLOUT)
        return any(events & (select.POLLERR | select.POLLHUP) for _, events in poll.poll(0))
    except (AttributeError, OSError, ValueError):
        return True


def _drop_output() -> None:
    """Redirects a standard output that cannot be written to, to the null device."""
    with contextlib.suppress(OSError, ValueError):
        nothing = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, sys.stdout.fileno())
        os.close(nothing)
