"""Lines of a case file with their reasons, and questions where nobody but a person can decide."""

import os
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

# Characters of a line before its comment goes to lines of its own.
WIDTH = 100


@dataclass(frozen=True)
class Taken:
    """How a file, or a node of a scene, was interpreted.

    Attributes
    ----------
    label : str
        Its path, or its scene and node.
    taken_for : str
        Such as "skin" or "motion of maxilla"; "not used"; empty if this is undecided.
    why : str
    unit, frame : str
        If they apply.
    question : bool
        Whether a person has to decide something about it.
    paths : tuple of Path
        The files that it is about, where its label does not name each.
    """

    label: str
    taken_for: str
    why: str
    unit: str = ""
    frame: str = ""
    question: bool = False
    paths: tuple[Path, ...] = ()

    def as_dict(self) -> dict[str, object]:
        """Plain values, ready for JSON."""
        return {
            "file": self.label,
            "taken_for": self.taken_for,
            "unit": self.unit,
            "frame": self.frame,
            "why": self.why,
            "question": self.question,
            **({"files": [path.name for path in self.paths]} if self.paths else {}),
        }


def clean(text: str) -> str:
    """A text from a file on one line, without what ends a comment or commands a terminal."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)


def legible(name: str) -> str:
    """The name of a file as text: bytes that are not UTF-8 are read as Latin-1."""
    try:
        name.encode()
    except UnicodeEncodeError:
        return os.fsencode(name).decode("latin-1")
    return name


def quoted(text: str) -> str:
    """A TOML string.

    Raises `UnicodeEncodeError`: The text is the name of a file that is not UTF-8: no case can name
        it.
    """
    text.encode()
    kept = (c if c.isprintable() and c not in '"\\' else f"\\U{ord(c):08x}" for c in text)
    return f'"{"".join(kept)}"'


@dataclass
class Text:
    """A case file as it is written, line by line, and the questions in it.

    questions: The key and the question of each line that a person has to decide.
    """

    lines: list[str] = field(default_factory=list)
    questions: list[str] = field(default_factory=list)
    _table: str = ""

    def comment(self, text: str = "", hang: int = 0) -> None:
        """A comment, wrapped; lines after the first begin farther right by `hang`."""
        lines = textwrap.wrap(
            clean(text),
            WIDTH - 2,
            subsequent_indent=" " * hang,
            break_long_words=False,
            break_on_hyphens=False,
        )
        self.lines += [f"# {line}".rstrip() for line in lines or [""]]

    def table(self, name: str, why: str = "") -> None:
        """The head of a table."""
        self._table = name.strip("[]")
        head = f"[{name}]"
        self.lines += ["", f"{head}  # {clean(why)}" if why else head]

    def value(self, key: str, value: str, why: str = "") -> None:
        """A key with its value in TOML, and the reason for it."""
        line = f"{key} = {value}"
        reason = clean(why)
        if reason and len(line) + len(reason) + 4 > WIDTH:
            self.comment(reason)
            reason = ""
        self.lines.append(f"{line}  # {reason}" if reason else line)

    def ask(self, key: str, question: str, choices: Sequence[str], value: str = '"?"') -> None:
        """A key that a person decides: `doctor` refuses the file and repeats question and choices.

        choices: What may be written instead.
        value: TOML that holds "?".
        """
        place = f"{self._table}.{key}".lstrip(".")
        self.questions.append(f"{place}: {question}")
        self.lines.append(f"{key} = {value}  # {clean(question)}")
        self.lines += [f"#   {clean(choice)}" for choice in choices]

    def matrix(self, rows: Sequence[Sequence[float]], lead: str = "") -> None:
        """A 4 × 4 matrix with every digit; `lead` makes it a comment."""
        self.lines.append(f"{lead}matrix = [")
        self.lines += [f"{lead}  [{', '.join(repr(float(v)) for v in row)}]," for row in rows]
        self.lines.append(f"{lead}]")

    def __str__(self) -> str:
        """The text of the file."""
        return "\n".join(self.lines) + "\n"
