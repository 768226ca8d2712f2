"""Findings: what a person should know before trusting a case, alone or many of a kind on a line."""

import logging
import re
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import KW_ONLY, InitVar, dataclass, field, replace
from types import MappingProxyType
from typing import Any

from cmfsim.values.checks import as_text, check_one_of
from cmfsim.values.finding_table import FINDING_KINDS, FORMER_CODES, filled
from cmfsim.values.language import translated

# A size within the text of a finding: the larger, the worse.
SIZE = re.compile(r"(\d+(?:[.,]\d+)?)\s?(%|mm\b|°)")
# What two findings of one wording may differ in.
FIGURES = re.compile(r"[\d.,−-]+")
# Findings of one code that state different facts, such as two parts that are cut off, in a line.
MOST_WORDINGS = 3
# Characters of a finding's text in a line.
MOST_TEXT = 300

SEVERITIES = ("error", "warning", "note")


@dataclass(frozen=True)
class Finding:
    """A fact to know before you trust a case.

    Severity, fact, reason and remedy that are not given are those of the code
    (`cmfsim.values.finding_table`).

    Parameters
    ----------
    facts : mapping of str to object, optional
        What is filled in where the texts of the code have names in braces.

    Attributes
    ----------
    severity : str
        "error" (the work cannot go on), "warning" (the result may be wrong), "note".
    code : str
        Short stable name, such as "ct-spacing-coarse".
    what : str
        The fact, with its figure.
    where : str
        File, table, place in mm.
    why : str
        Its effect on the result.
    fix : str
        What to do.

    Raises
    ------
    ValueError
        A code that is not in the table without severity or fact; a severity that is not one of
        `SEVERITIES`.

    Examples
    --------
    >>> import cmfsim
    >>> found = cmfsim.Finding("dicom-uneven", "slices are 1 to 5 mm apart", where="head/")
    >>> found.severity, found.where, found.fix
    ('warning', 'head/', 'use a reconstruction with evenly spaced slices if there is one')
    """

    severity: str = field(default="", kw_only=True)
    code: str
    what: str = ""
    _: KW_ONLY
    where: str = ""
    why: str = ""
    fix: str = ""
    facts: InitVar[Mapping[str, object]] = MappingProxyType({})

    def __post_init__(self, facts: Mapping[str, object]) -> None:
        as_text("finding code", self.code)
        if (kind := FINDING_KINDS.get(self.code)) is not None:
            texts = {"what": kind.meaning, "why": kind.why, "fix": kind.fix}
            for name, text in texts.items():
                if not getattr(self, name):
                    object.__setattr__(self, name, filled(text, facts))
            if not self.severity:
                object.__setattr__(self, "severity", kind.severity)
        check_one_of("severity", self.severity, SEVERITIES)
        as_text("finding", self.what)

    @classmethod
    def from_values(cls, values: Mapping[str, Any]) -> "Finding":
        """The finding stored in a file as plain values; other names in it are ignored.

        A former code becomes the one that is used now.
        """
        known = ("severity", "code", "what", "where", "why", "fix")
        given = {name: values[name] for name in known if name in values}
        return cls(**{**given, "code": FORMER_CODES.get(given["code"], given["code"])})


def findings_at(where: str, findings: Iterable[Finding]) -> Iterator[Finding]:
    """Findings about one place: each with it."""
    return (replace(finding, where=where) for finding in findings)


@dataclass(frozen=True)
class FindingGroup:
    """Findings of one severity and code, at least one, in their order."""

    findings: tuple[Finding, ...]

    @property
    def severity(self) -> str:
        """Of all of them: "error", "warning" or "note"."""
        return self.findings[0].severity

    @property
    def code(self) -> str:
        """The code of all of them."""
        return self.findings[0].code

    @property
    def worst(self) -> Finding:
        """The one with the largest size in its text; the first where none has any."""
        return max(self.findings, key=lambda finding: _size(finding)[0])

    @property
    def line(self) -> str:
        """What they state, as one line of text; names in it are those of files."""
        return self.text()

    def text(self, said: Callable[[str], str] = str) -> str:
        """The line, each of its texts as `said` gives it: in the reader's language, for one."""
        worst = self.worst
        count = len(self.findings)
        kind = FINDING_KINDS.get(self.code)
        if kind is None or not kind.several or count == 1:
            stated = self._wordings()[:MOST_WORDINGS]
            line = "; ".join(_stated(finding, said) for finding in stated)
            more = count - len(stated)
            rest = said(f"and {more} more of this kind")
            return f"{line}; {rest} [{self.code}]" if more else line
        size = _size(worst)[1]
        title = said(kind.several.format(n=count))
        if size and worst.where:
            return f"{title} ({said('largest:')} {worst.where} {size})"
        return f"{title} ({said('such as:')} {said(_shortened(worst.what))})"

    def _wordings(self) -> list[Finding]:
        """The worst finding of each wording, figures apart; the worst of all first."""
        kinds: dict[str, list[Finding]] = {}
        for finding in (self.worst, *self.findings):
            kinds.setdefault(FIGURES.sub("", finding.what), []).append(finding)
        return [FindingGroup(tuple(found)).worst for found in kinds.values()]


def grouped(findings: Iterable[Finding]) -> list[FindingGroup]:
    """The findings by kind, each once: errors first, then warnings and notes."""
    kinds: dict[tuple[str, str], list[Finding]] = {}
    for finding in dict.fromkeys(findings):
        kinds.setdefault((finding.severity, finding.code), []).append(finding)
    groups = [FindingGroup(tuple(found)) for found in kinds.values()]
    return sorted(groups, key=lambda group: SEVERITIES.index(group.severity))


def log_warnings(log: logging.Logger, findings: Iterable[Finding]) -> None:
    """Logs the warnings among findings, for callers who are not given these."""
    for finding in findings:
        if finding.severity == "warning":
            log.warning("%s: %s", finding.where, finding.what)


def counted(findings: Iterable[Finding]) -> str:
    """How many of each severity there are, as text: "1 warning, 61 notes"."""
    severities = [finding.severity for finding in dict.fromkeys(findings)]
    return ", ".join(
        f"{count} {severity}{'' if count == 1 else 's'}"
        for severity in SEVERITIES
        if (count := severities.count(severity))
    )


def _shortened(text: str) -> str:
    return text if len(text) <= MOST_TEXT else f"{text[:MOST_TEXT]}…"


def _stated(finding: Finding, said: Callable[[str], str]) -> str:
    """The fact and its place, unless the fact names it."""
    what = _shortened(finding.what)
    place = f" ({finding.where})" if finding.where and finding.where not in what else ""
    return f"{said(what)}{place}"


def _size(finding: Finding) -> tuple[float, str]:
    """The first size in a finding's text, as a number and as it is written."""
    found = SIZE.search(finding.what)
    if found is None:
        return 0.0, ""
    unit = found[2] if found[2] in "%°" else f"{found[2]}"
    return float(found[1].replace(",", ".")), f"{found[1]} {unit}"


def counted_findings(findings: Iterable[Finding]) -> str:
    """How many findings there are of each severity, and the codes of errors and warnings."""
    found = list(findings)
    parts = []
    for severity in SEVERITIES:
        codes = [finding.code for finding in found if finding.severity == severity]
        if codes:
            named = f" ({', '.join(dict.fromkeys(codes))})" if severity != "note" else ""
            parts.append(f"{len(codes)} {severity}{'s' if len(codes) > 1 else ''}{named}")
    return ", ".join(parts) or "none"


# What is called with new findings as a stage notices them.
OnFindings = Callable[[Iterable[Finding]], None]


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
                lines += _wrapped(translated(label), escape(translated(text)), width)
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
