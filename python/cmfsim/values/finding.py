"""Findings: what a person should know before trusting a case."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from cmfsim.checks import (
    as_text,
    check_one_of,
)

__all__ = ["SEVERITIES", "Finding", "OnFindings"]

SEVERITIES = ("error", "warning", "note")


@dataclass(frozen=True)
class Finding:
    """Something that a person should know before trusting a case.

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
        What it does to the result.
    mend : str
        What to do.
    """

    severity: str
    code: str
    what: str
    where: str = ""
    why: str = ""
    mend: str = ""

    def __post_init__(self) -> None:
        check_one_of("severity", self.severity, SEVERITIES)
        as_text("finding code", self.code)
        as_text("finding", self.what)


# What is called with new findings as a stage notices them.
OnFindings = Callable[[Iterable[Finding]], None]
