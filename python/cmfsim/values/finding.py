"""Findings: what a person should know before trusting a case."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import KW_ONLY, InitVar, dataclass, field
from types import MappingProxyType
from typing import Any

from cmfsim.values.checks import as_text, check_one_of
from cmfsim.values.finding_table import FINDING_KINDS, FORMER_CODES, filled

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
