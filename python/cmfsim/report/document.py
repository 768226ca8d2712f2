"""The content of a report without its layout: sections of notes, tables and figures."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from cmfsim.errors import CaseInputError

# Stands where there is no figure.
NOTHING = "–"


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
    line = " ".join(text.split())
    return "".join(f"\\{c}" if c in "\\`*_[]<>#|!" else c for c in line)


@dataclass(frozen=True)
class Note:
    """Paragraphs of text; `kind` is "plain", "warning" or "error"."""

    text: str
    kind: str = "plain"


@dataclass(frozen=True)
class Table:
    """Rows of text under a heading; columns of numbers are set right.

    Attributes
    ----------
    columns : tuple of str
    rows : tuple of tuple of str
    caption : str
    numeric : bool
        Whether all columns but the first hold numbers.
    """

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    caption: str = ""
    numeric: bool = True

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
        """Caption and columns as plain text."""
        rows = [self.columns, *self.rows]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = [self.caption]
        for first, *others in rows:
            cells = [c.rjust(w) for c, w in zip(others, widths[1:], strict=True)]
            lines.append("  ".join(["", first.ljust(widths[0]), *cells]))
        return "\n".join(lines)

    @property
    def markdown(self) -> str:
        """The columns in Markdown, without the caption."""
        others = ["---:" if self.numeric else "---"] * (len(self.columns) - 1)
        head, *rows = [map(plain_line, row) for row in (self.columns, *self.rows)]
        return "\n".join(f"| {' | '.join(row)} |" for row in (head, ("---", *others), *rows))


@dataclass(frozen=True)
class Figure:
    """A picture with what it shows: the bytes of a PNG, or the text of an SVG."""

    image: bytes | str
    caption: str


@dataclass(frozen=True)
class View:
    """A picture to turn: markup that is trusted, and the source of its script as a policy has it.

    A document has one at most.
    """

    markup: str
    script: str
    caption: str


@dataclass(frozen=True)
class Alert:
    """A message at the top of a report: one line, with the details collapsed below it.

    Attributes
    ----------
    kind : str
        "error", "warning" or "note".
    line : str
    details : tuple of str
        Shown when the line is opened, and on paper.
    """

    kind: str
    line: str
    details: tuple[str, ...] = ()


@dataclass(frozen=True)
class Section:
    """A part of a report under its heading."""

    title: str
    blocks: tuple[Note | Table | Figure | View, ...]


@dataclass(frozen=True)
class Document:
    """A whole report.

    Attributes
    ----------
    title, subtitle : str
    alerts : sequence of Alert
        Above everything else.
    facts_title : str
        Whose figures the facts are.
    links : mapping of str to str
        Names of files in the same folder that belong to it, by what they are.
    facts : mapping of str to str
        The few figures that a reader looks for first.
    sections : sequence of Section
    footer : str
    """

    title: str
    subtitle: str
    facts: Mapping[str, str] = field(default_factory=dict)
    sections: Sequence[Section] = ()
    footer: str = ""
    alerts: Sequence[Alert] = ()
    facts_title: str = ""
    links: Mapping[str, str] = field(default_factory=dict)
