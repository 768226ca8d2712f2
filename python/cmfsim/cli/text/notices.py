"""Findings of a command on the terminal: as they arise, and again at its end."""

import sys
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import Any

from cmfsim.cli.text.terminal import CLEAR_LINE, escaped, in_colour
from cmfsim.doctor.report import severity_text
from cmfsim.errors import CmfsimError
from cmfsim.values.finding import Finding, FindingGroup, counted, grouped
from cmfsim.values.progress import Observer


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
                _print(f"cmfsim: {_head(group)}: {escaped(group.line)}")

    def failed(self, model: str, error: CmfsimError) -> None:
        """Records the error: the other models continue."""
        self.failures[model] = error

    def summarise(self, where: str | None) -> None:
        """Prints the list at the end: nothing if there are no findings.

        where: The file that lists all findings in full, for the first line; None lists notes as
            well.
        """
        groups = grouped(self._found)
        if where is not None or self._quiet:
            groups = [group for group in groups if group.severity != "note"]
        if not groups and (self._quiet or not self._found):
            return
        full = "" if where is None else f"; in full: {escaped(where)}"
        _print(f"cmfsim: {counted(self._found)}{full}")
        for group in groups:
            _print(f"  {_head(group)}: {escaped(group.line)}")
            if group.worst.fix:
                _print(f"    fix: {escaped(group.worst.fix)}")

    def as_dicts(self) -> list[dict[str, Any]]:
        """Plain values, ready for JSON."""
        return [asdict(finding) for finding in self._found]


def _head(group: FindingGroup) -> str:
    return severity_text(group.severity, colour=in_colour(sys.stderr))


def _print(line: str) -> None:
    # Over the line of the stage, where there is one.
    clear = CLEAR_LINE if sys.stderr.isatty() else ""
    print(f"{clear}{line}", file=sys.stderr, flush=True)
