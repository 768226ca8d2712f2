"""What commands print: progress, tables, and findings as they arise and at the end."""

import codecs
import json
import logging
import os
import shlex
import shutil
import sys
import threading
import time
import webbrowser
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, TextIO

from cmfsim.errors import CmfsimError, error_text
from cmfsim.pictures import has_screen
from cmfsim.values.finding import (
    Finding,
    FindingGroup,
    counted,
    findings_text,
    grouped,
    severity_text,
)
from cmfsim.values.language import translated
from cmfsim.values.progress import COUNT, Observer, TimeLeft

# Back to the start of the line and erase it.
CLEAR_LINE = "\r\x1b[K"
# Time between two updates of the line that shows the stage, s.
TICK = 0.2
# What stands for characters of our texts where a terminal or file has another encoding.
SPELLED = {
    "\N{MINUS SIGN}": "-", "\N{EN DASH}": "-", "\N{EM DASH}": "-", "\N{MULTIPLICATION SIGN}": "x",
    "\N{DEGREE SIGN}": " deg", "\N{PLUS-MINUS SIGN}": "+/-", "\N{MIDDLE DOT}": "*",
    "\N{HORIZONTAL ELLIPSIS}": "...", "\N{RIGHTWARDS ARROW}": "->", "\N{SUPERSCRIPT TWO}": "2",
    "\N{SUPERSCRIPT THREE}": "3", "\N{LESS-THAN OR EQUAL TO}": "<=", "\N{MICRO SIGN}": "u",
    "\N{GREATER-THAN OR EQUAL TO}": ">=", "\N{GREEK SMALL LETTER NU}": "nu",
    "\N{GREEK SMALL LETTER MU}": "u", "\N{ALMOST EQUAL TO}": "~",
}  # fmt: skip


def can_open() -> bool:
    """Whether a person works at a screen."""
    return sys.stdout.isatty() and not os.environ.get("CI") and has_screen()


def open_page(path: Path, *, wanted: bool = True) -> None:
    """Opens a file in the browser if it is wanted and somebody is there."""
    if wanted and can_open():
        webbrowser.open(path.resolve().as_uri())


class ProgressHandler(logging.Handler):
    """Log lines on the standard error of the moment."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Drops what is printed elsewhere: findings, and the stages of imaging."""
        shown = record.name.startswith("cmfsim.imaging") and record.levelno <= logging.INFO
        shown = shown or getattr(record, "is_finding", False)
        return not shown and bool(super().filter(record))

    def emit(self, record: logging.LogRecord) -> None:
        """Prints one line, over the line of the stage where there is one."""
        _print(f"cmfsim: {escaped(record.getMessage())}")


class StageProgress:
    """The stage of a long command: one line that counts seconds, or in a pipe a line per stage.

    Use it as a context; `stage` names what begins. Its own thread counts, so that a stage that
    takes a minute is seen to be alive. Where the stages to come are known, the line begins with the
    share that is done and the time left. Log lines of what the stages do are not shown meanwhile.
    """

    def __init__(
        self, stream: TextIO, *, quiet: bool = False, expected: Mapping[str, float] | None = None
    ) -> None:
        self._stream = stream
        self._quiet = quiet
        self._live = not quiet and stream.isatty()
        self._stage = ""
        self._left = TimeLeft(expected or {})
        self._logger = logging.getLogger("cmfsim")
        self._level = self._logger.level
        self._begun = time.perf_counter()
        self._stopped = threading.Event()
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._tick, daemon=True)

    def __enter__(self) -> "StageProgress":
        self._logger.setLevel(logging.WARNING)
        if self._live:
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped.set()
        self._logger.setLevel(self._level)
        if self._live:
            self._thread.join()
            self._write(CLEAR_LINE)

    def stage(self, name: str) -> None:
        """Reports the start of a stage, or of another step of it."""
        plain = COUNT.sub("", name)
        with self._lock:
            is_new = plain != COUNT.sub("", self._stage)
            self._stage, self._begun = name, time.perf_counter()
            self._left.begin(name)
        if self._live:
            self._show()
        elif is_new and not self._quiet:
            self._write(f"cmfsim: {escaped(translated(plain))}\n")

    def _tick(self) -> None:
        while not self._stopped.wait(TICK):
            self._show()

    def _show(self) -> None:
        with self._lock:
            name, seconds = self._stage, time.perf_counter() - self._begun
            left = self._left.text()
        if name:
            text = f"cmfsim: {translated(left)}{escaped(translated(name))} {seconds:.1f} s"
            # A line that wraps could not be erased.
            self._write(f"{CLEAR_LINE}{text[: columns() - 1]}")

    def _write(self, text: str) -> None:
        self._stream.write(text)
        self._stream.flush()


def spell_out(*streams: TextIO) -> None:
    """Makes streams write what their encoding lacks in other characters: "-" for a minus sign.

    Output that goes to a file or pipe has the encoding of the system, such as cp1252, and an error
    there would end a command whose work is done.
    """
    codecs.register_error("cmfsim-spelled", _spelled)
    for stream in streams:
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="cmfsim-spelled")


def _spelled(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    bad = error.object[error.start : error.end]
    text = (SPELLED.get(c) or c.encode("ascii", "backslashreplace").decode() for c in bad)
    return "".join(text), error.end


def print_text(
    text: str, *, file: TextIO | None = None, flush: bool = False, end: str = "\n"
) -> None:
    """Prints lines in the reader's language."""
    lines = "\n".join(map(translated, text.split("\n")))
    print(lines, file=file, flush=flush, end=end)


def print_json(values: Mapping[str, Any], *, flush: bool = False) -> None:
    """Prints values as a line that programs read: NaN and infinity are an error, not JSON."""
    print(json.dumps(values, allow_nan=False), flush=flush)


def print_error(error: BaseException) -> None:
    """Prints an error as one line on standard error."""
    print_text(f"cmfsim: error: {escaped(error_text(error))}", file=sys.stderr)


def escaped(text: str) -> str:
    """A text without terminal control characters, since names in files are untrusted."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def argument(path: Path) -> str:
    """A path as it is typed after a command: in quotes where it has spaces."""
    return shlex.quote(escaped(str(path)))


def in_colour(stream: TextIO) -> bool:
    """Whether colours are shown and wanted (https://no-color.org)."""
    return stream.isatty() and not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"


def columns() -> int:
    """The width of the terminal, in characters."""
    return shutil.get_terminal_size().columns


def print_findings(findings: Sequence[Finding], stream: TextIO) -> None:
    """Wrapped and coloured on a terminal; one line per part in a pipe."""
    width = columns() if stream.isatty() else 0
    text = findings_text(findings, colour=in_colour(stream), width=width, escape=escaped)
    print_text(text, file=stream)


class FindingsError(Exception):
    """The doctor found errors, so the command did nothing else."""

    def __init__(self, findings: Sequence[Finding]) -> None:
        errors = [finding for finding in findings if finding.severity == "error"]
        first = errors[0]
        more = f" (and {len(errors) - 1} more errors)" if len(errors) > 1 else ""
        super().__init__(f"{first.where}: {first.what}{more}")
        self.findings = tuple(findings)


class Notices(Observer):
    """The findings of a command, without duplicates.

    Warnings and errors are printed on standard error as they come, grouped by kind, and again by
    `summarise`; notes are counted there. Use it
    as the observer of the work: models that cannot be solved are recorded in `failures`.
    """

    def __init__(self, *, quiet: bool = False) -> None:
        self._quiet = quiet
        self._found: dict[Finding, None] = {}
        self.failures: dict[str, CmfsimError] = {}

    @property
    def findings(self) -> tuple[Finding, ...]:
        """All so far, in the order in which they came."""
        return tuple(self._found)

    def found(self, findings: Iterable[Finding]) -> None:
        """Adds findings, and prints the new ones except notes."""
        new = [finding for finding in dict.fromkeys(findings) if finding not in self._found]
        self._found.update(dict.fromkeys(new))
        for group in grouped(new):
            if group.severity != "note":
                _print(f"cmfsim: {_head(group)}: {escaped(group.text(translated))}")

    def failed(self, model: str, error: CmfsimError) -> None:
        """Records the error: the other models continue."""
        self.failures[model] = error

    def summarise(self, where: str | None) -> None:
        """Prints the list at the end: nothing if there are no findings.

        where: The file that lists all findings in full; None lists notes here as well.
        """
        groups = grouped(self._found)
        if where is not None or self._quiet:
            groups = [group for group in groups if group.severity != "note"]
        if not groups and (self._quiet or not self._found):
            return
        full = "" if where is None else f"; {translated('in full:')} {escaped(where)}"
        _print(f"cmfsim: {counted(self._found)}{full}")
        for group in groups:
            _print(f"  {_head(group)}: {escaped(group.text(translated))}")
            if group.worst.fix:
                _print(f"    {translated('fix:')} {escaped(translated(group.worst.fix))}")

    def as_dicts(self) -> list[dict[str, Any]]:
        """Plain values, ready for JSON."""
        return [asdict(finding) for finding in self._found]


def _head(group: FindingGroup) -> str:
    return severity_text(group.severity, colour=in_colour(sys.stderr))


def _print(line: str) -> None:
    # Over the line of the stage, where there is one.
    clear = CLEAR_LINE if sys.stderr.isatty() else ""
    print_text(f"{clear}{line}", file=sys.stderr, flush=True)
