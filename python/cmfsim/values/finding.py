"""Findings: what a person should know before trusting a case."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from cmfsim.values.checks import as_text, check_one_of

__all__ = ["SEVERITIES", "Finding", "OnFindings"]

SEVERITIES = ("error", "warning", "note")


@dataclass(frozen=True, kw_only=True)
class Finding:
    """A fact to know before you trust a case.

    `Finding.error`, `Finding.warning` and `Finding.note` make one.

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

    Examples
    --------
    >>> import cmfsim
    >>> found = cmfsim.Finding.warning("ct-spacing-coarse", "slices are 5 mm apart", where="head/")
    >>> found.severity, found.where
    ('warning', 'head/')
    """

    severity: str
    code: str
    what: str
    where: str = ""
    why: str = ""
    fix: str = ""

    def __post_init__(self) -> None:
        check_one_of("severity", self.severity, SEVERITIES)
        as_text("finding code", self.code)
        as_text("finding", self.what)

    @classmethod
    def error(
        cls, code: str, what: str, *, where: str = "", why: str = "", fix: str = ""
    ) -> "Finding":
        """A finding that ends the work."""
        return cls(severity="error", code=code, what=what, where=where, why=why, fix=fix)

    @classmethod
    def warning(
        cls, code: str, what: str, *, where: str = "", why: str = "", fix: str = ""
    ) -> "Finding":
        """A finding because of which the result may be wrong."""
        return cls(severity="warning", code=code, what=what, where=where, why=why, fix=fix)

    @classmethod
    def note(
        cls, code: str, what: str, *, where: str = "", why: str = "", fix: str = ""
    ) -> "Finding":
        """A finding for information."""
        return cls(severity="note", code=code, what=what, where=where, why=why, fix=fix)

    @classmethod
    def from_values(cls, values: Mapping[str, Any]) -> "Finding":
        """The finding stored in a file as plain values; other names in it are ignored."""
        known = ("severity", "code", "what", "where", "why", "fix")
        return cls(**{name: values[name] for name in known if name in values})


# What is called with new findings as a stage notices them.
OnFindings = Callable[[Iterable[Finding]], None]
