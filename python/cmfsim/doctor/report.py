"""Findings as text: plain lines in a pipe, coloured on a terminal."""

import textwrap
from collections.abc import Callable, Iterable

from cmfsim.values.finding import Finding, counted

# ANSI colours of the severities: red, yellow, blue.
COLOURS = {"error": "31;1", "warning": "33;1", "note": "34"}
# Columns of a terminal, unless it reports its width.
WIDTH = 100


def findings_text(
    findings: Iterable[Finding],
    *,
    colour: bool = False,
    width: int = WIDTH,
    escape: Callable[[str], str] = str,
) -> str:
    """The findings as lines, with a count at the end.

    colour: Whether the severity is coloured, for a terminal.
    width: Columns at which lines wrap; 0 keeps each finding's parts on one line.
    escape: Makes a text from a file harmless for the terminal.
    """
    findings = list(findings)
    lines: list[str] = []
    for finding in findings:
        head = severity_text(finding.severity, colour=colour)
        lines.append(f"{head}: {escape(finding.where or 'case')}: [{finding.code}]")
        for label, text in (("", finding.what), ("why: ", finding.why), ("fix: ", finding.fix)):
            if text:
                lines += _wrapped(label, escape(text), width)
    return "\n".join([*lines, counted(findings) or "nothing found"])


def severity_text(severity: str, *, colour: bool) -> str:
    """A severity, in its colour if wanted."""
    return f"\x1b[{COLOURS[severity]}m{severity}\x1b[0m" if colour else severity


def _wrapped(label: str, text: str, width: int) -> list[str]:
    if not width:
        return [f"    {label}{text}"]
    return textwrap.wrap(
        text,
        max(width, 40),
        initial_indent=f"    {label}",
        subsequent_indent=" " * (4 + len(label)),
        break_long_words=False,
        break_on_hyphens=False,
    )
