"""Text files: numbers from their words, and the line of each key of a TOML text, for errors.

A TOML text that `tomllib` has read is scanned once more for the lines, which it does not give: the
scan only has to tell keys from values.
"""

import re
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError
from cmfsim.values.checks import Floats

# Characters of a word that an error repeats.
SHOWN = 40


def real_numbers(words: Sequence[bytes], where: Callable[[int], str], kind: str = "f8") -> Floats:
    """Words as finite float64, (n,), one for one.

    where: The place of a word, by its index, as an error names it: "line 3".
    kind: "f4" where the file states single precision: numbers become those that it can hold.
    """
    try:
        values = np.fromiter(map(float, words), np.float64, len(words))
    except ValueError:
        bad = next(i for i, word in enumerate(words) if not _is_real(word))
        raise CaseInputError(f"{where(bad)}: {shown(words[bad])} is not a number") from None
    # Python takes 1_000 for a number; no file format does.
    if (spaced := _spaced(words)) is not None:
        raise CaseInputError(f"{where(spaced)}: {shown(words[spaced])} is not a number")
    if kind == "f4":
        with np.errstate(over="ignore"):
            values = values.astype(np.float32).astype(np.float64)
    if not np.isfinite(values).all():
        bad = int(np.flatnonzero(~np.isfinite(values))[0])
        raise CaseInputError(
            f"{where(bad)}: {shown(words[bad])} is not finite: every coordinate must be finite"
        )
    return values


def whole_numbers(words: Sequence[bytes], where: Callable[[int], str]) -> NDArray[np.int64]:
    """Words as int64, (n,), one for one; `where` as in `real_numbers`."""
    try:
        values = np.fromiter(map(int, words), np.int64, len(words))
    except (ValueError, OverflowError):
        bad = next(i for i, word in enumerate(words) if not _is_whole(word))
        raise CaseInputError(
            f"{where(bad)}: {shown(words[bad])} is not a whole number of at most 64 bits"
        ) from None
    if (spaced := _spaced(words)) is not None:
        raise CaseInputError(f"{where(spaced)}: {shown(words[spaced])} is not a whole number")
    return values


def shown(word: bytes) -> str:
    """A word as an error repeats it, cut where it is long."""
    text = word[:SHOWN].decode("ascii", "backslashreplace")
    return repr(text) + ("…" if len(word) > SHOWN else "")


def _spaced(words: Sequence[bytes]) -> int | None:
    """The index of the first word with an underscore; None if there is none, the usual case."""
    if b"_" not in b" ".join(words):
        return None
    return next(i for i, word in enumerate(words) if b"_" in word)


def _is_real(word: bytes) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _is_whole(word: bytes) -> bool:
    try:
        return abs(int(word)) < 2**63
    except ValueError:
        return False


# Names of tables and keys; the number of a table in an array of tables stands as a whole number.
KeyPath = tuple[str | int, ...]

KEY_PART = re.compile(r"""[ \t]*("(?:[^"\\\n]|\\.)*"|'[^'\n]*'|[A-Za-z0-9_-]+)[ \t]*""")
# Where a value can change how what follows is read: texts, comments and brackets.
VALUE_TOKEN = re.compile(r"\"\"\"|'''|\"|'|#|[\[\]{}]|\n")


def toml_lines(text: str) -> dict[KeyPath, int]:
    """The line, from 1 on, on which each table and key of a valid TOML text stands.

    Keys inside inline tables and arrays are not listed: they have the line of the key before them
    (`line_of`).
    """
    lines: dict[KeyPath, int] = {}
    counts: dict[KeyPath, int] = {}
    table: KeyPath = ()
    line, place = 1, 0
    while place < len(text):
        end_of_line = text.find("\n", place)
        end_of_line = len(text) if end_of_line < 0 else end_of_line
        start = text[place:end_of_line].lstrip(" \t")
        if not start.strip() or start.startswith("#"):
            place, line = end_of_line + 1, line + 1
            continue
        place = end_of_line - len(start)
        if start.startswith("["):
            in_array = start.startswith("[[")
            names, _ = _key(text, place + (2 if in_array else 1))
            table = _numbered(names[:-1], counts) + names[-1:]
            if in_array:
                counts[table] = counts.get(table, -1) + 1
                lines.setdefault(table, line)
                table = (*table, counts[table])
            lines.setdefault(table, line)
            place, line = end_of_line + 1, line + 1
            continue
        names, place = _key(text, place)
        for length in range(1, len(names) + 1):
            lines.setdefault(table + names[:length], line)
        after = _end_of_value(text, place)
        line += text.count("\n", place, after)
        place = after
    return lines


def line_of(lines: Mapping[KeyPath, int], path: KeyPath) -> int:
    """The line of a key, or of the nearest table round it; 1 for the whole text."""
    while path:
        if path in lines:
            return lines[path]
        path = path[:-1]
    return 1


def _numbered(names: tuple[str, ...], counts: Mapping[KeyPath, int]) -> KeyPath:
    """The path to a table, with the number of the last table where one of its parts is an array."""
    path: KeyPath = ()
    for name in names:
        path = (*path, name)
        if path in counts:
            path = (*path, counts[path])
    return path


def _key(text: str, place: int) -> tuple[tuple[str, ...], int]:
    """The parts of a dotted key and the place after it."""
    names: list[str] = []
    while match := KEY_PART.match(text, place):
        part, place = match[1], match.end()
        names.append(part[1:-1] if part[0] in "\"'" else part)
        if text[place : place + 1] != ".":
            break
        place += 1
    return tuple(names), place


def _end_of_value(text: str, place: int) -> int:
    """The place after the line on which a value ends."""
    depth = 0
    while match := VALUE_TOKEN.search(text, place):
        sign, place = match[0], match.end()
        if sign in {'"""', "'''", '"', "'"}:
            place = _end_of_text(text, place, sign)
        elif sign == "#":
            end = text.find("\n", place)
            place = len(text) if end < 0 else end
        elif sign in "[{":
            depth += 1
        elif sign in "]}":
            depth -= 1
        elif depth == 0:
            return place
    return len(text)


def _end_of_text(text: str, place: int, quote: str) -> int:
    """The place after the end of a text that began with these quotes."""
    escapes = quote[0] == '"'
    while place < len(text):
        if escapes and text[place] == "\\":
            place += 2
        elif text.startswith(quote, place):
            place += len(quote)
            # A text between three quotes may itself end with one or two of them.
            while len(quote) == 3 and text[place : place + 1] == quote[0]:
                place += 1
            return place
        else:
            place += 1
    return len(text)
