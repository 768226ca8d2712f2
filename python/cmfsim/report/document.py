"""The content of a report without its layout: sections of notes, tables and figures."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from cmfsim.values.table import Table


@dataclass(frozen=True)
class Note:
    """Paragraphs of text; `kind` is "plain", "warning" or "error"."""

    text: str
    kind: str = "plain"


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
    """A message, "error", "warning" or "note", at the top of a report: one line, and its details.

    The details are shown when the line is opened, and on paper.
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
    """A whole report: the few figures that a reader looks for first, and sections; alerts on top.

    facts_title: Whose figures the facts are.
    links: Names of files in the same folder that belong to it, by what they are.
    """

    title: str
    subtitle: str
    facts: Mapping[str, str] = field(default_factory=dict)
    sections: Sequence[Section] = ()
    footer: str = ""
    alerts: Sequence[Alert] = ()
    facts_title: str = ""
    links: Mapping[str, str] = field(default_factory=dict)
