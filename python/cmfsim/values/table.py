"""A table of text: as plain text, in Markdown and as comma-separated values."""

import csv
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from cmfsim.errors import CaseInputError

# Stands where there is no figure.
NOTHING = "–"
# What Markdown would take for markup.
MARKUP = re.compile(r"[\\`*_\[\]>#|!]|<(?=\S)")


def number(value: object, digits: int = 2) -> str:
    """A number as a table shows it; a dash where there is none."""
    if value is None:
        return NOTHING
    if isinstance(value, bool):
        return "yes" if value else "no"
    if not isinstance(value, int | float):
        return str(value)
    if isinstance(value, int):
        return f"{value:,}".replace(",", "\u202f")
    small = value != 0.0 and abs(value) < 0.5 * 10.0**-digits
    return f"{value:.1e}" if small else f"{value:.{digits}f}"


def plain_line(text: str) -> str:
    """Words of a user as one line in which Markdown finds nothing to mark up."""
    return MARKUP.sub(r"\\\g<0>", " ".join(text.splitlines()).strip())


@dataclass(frozen=True)
class Table:
    """Rows of text under a heading; set right if all columns but the first are `numeric`."""

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    numeric: bool = True
    gap: str = "  "

    def __post_init__(self) -> None:
        for i, row in enumerate(self.rows):
            if len(row) != len(self.columns):
                raise CaseInputError(
                    f"row {i} of a table has {len(row)} cells, its head {len(self.columns)}"
                )

    @classmethod
    def of_pairs(cls, pairs: Mapping[str, object], caption: str = "") -> "Table":
        """Names and values in two columns."""
        rows = tuple((name, number(value)) for name, value in pairs.items())
        return cls(("", ""), rows, caption, numeric=False)

    @property
    def text(self) -> str:
        """The columns as plain text, below the caption and indented if there is one."""
        rows = [self.columns, *self.rows]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = [self.caption] if self.caption else []
        for first, *others in rows:
            align = str.rjust if self.numeric else str.ljust
            cells = [align(c, w) for c, w in zip(others, widths[1:], strict=True)]
            margin = [""] if self.caption else []
            lines.append(self.gap.join([*margin, first.ljust(widths[0]), *cells]).rstrip())
        return "\n".join(lines)

    @property
    def markdown(self) -> str:
        """The columns in Markdown, without the caption."""
        others = ["---:" if self.numeric else "---"] * (len(self.columns) - 1)
        head, *rows = [map(plain_line, row) for row in (self.columns, *self.rows)]
        return "\n".join(f"| {' | '.join(row)} |" for row in (head, ("---", *others), *rows))


def csv_of(rows: Sequence[Mapping[str, Any]]) -> str:
    """Rows of the same names as comma-separated values, with a header."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _plain(value) for name, value in row.items()} for row in rows)
    return text.getvalue()


def _plain(value: Any) -> Any:
    """A value that no spreadsheet takes for a formula."""
    formula = isinstance(value, str) and value[:1] in {"=", "+", "-", "@", "\t", "\r"}
    return f"'{value}" if formula else value
