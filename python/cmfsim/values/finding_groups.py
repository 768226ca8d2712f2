"""Findings of one kind as one line: how many, and the worst of them."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from cmfsim.values.finding import SEVERITIES, Finding

# What several findings of one code have in common. Others are stated by the worst of them.
TITLES: Mapping[str, str] = {
    "muscle-does-not-fit": "{n} muscles partly outside the tissue",
    "muscle-missed": "{n} muscles contain no sample of the tissue and do not affect it",
    "muscle-volume-changed": "{n} muscles changed in volume as they were moved into the tissue",
    "muscle-sheet": "{n} muscles are sheets, whose outline hardly determines their fibre direction",
    "landmark-far": "{n} landmarks are far from their surface",
    "surface-open": "{n} surfaces are open",
}
# A size within the text of a finding: the larger, the worse.
SIZE = re.compile(r"(\d+(?:[.,]\d+)?)\s?(%|mm\b|°)")
# What two findings of one wording may differ in.
FIGURES = re.compile(r"[\d.,−-]+")
# Findings of one code that state different facts, such as two parts that are cut off, in a line.
MOST_WORDINGS = 3
# Characters of a finding's text in a line.
MOST_TEXT = 300


@dataclass(frozen=True)
class FindingGroup:
    """Findings of one severity and code, in their order.

    Attributes
    ----------
    findings : tuple of Finding
        At least one.
    """

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
        worst = self.worst
        count = len(self.findings)
        if self.code not in TITLES or count == 1:
            stated = self._wordings()[:MOST_WORDINGS]
            line = "; ".join(_stated(finding) for finding in stated)
            more = count - len(stated)
            return f"{line}; and {more} more of this kind [{self.code}]" if more else line
        size = _size(worst)[1]
        title = TITLES[self.code].format(n=count)
        if size and worst.where:
            return f"{title} (largest: {worst.where} {size})"
        return f"{title} (such as: {_shortened(worst.what)})"

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


def _stated(finding: Finding) -> str:
    """The fact and its place, unless the fact names it."""
    what = _shortened(finding.what)
    place = f" ({finding.where})" if finding.where and finding.where not in what else ""
    return f"{what}{place}"


def _size(finding: Finding) -> tuple[float, str]:
    """The first size in a finding's text, as a number and as it is written."""
    found = SIZE.search(finding.what)
    if found is None:
        return 0.0, ""
    unit = found[2] if found[2] in "%°" else f"{found[2]}"
    return float(found[1].replace(",", ".")), f"{found[1]} {unit}"
