"""The line of each key of a TOML text, so that an error about a value can name it.

`tomllib` gives values without their places. This scan takes a text that `tomllib` has read already,
so it need not find what is wrong with one; it only has to tell keys from values.
"""

import re
from collections.abc import Mapping

# Names of tables and keys; the number of a table in an array of tables stands as a whole number.
KeyPath = tuple[str | int, ...]

KEY_PART = re.compile(r"""[ \t]*("(?:[^"\\\n]|\\.)*"|'[^'\n]*'|[A-Za-z0-9_-]+)[ \t]*""")
# Where a value can change how what follows is read: texts, comments and brackets.
VALUE_TOKEN = re.compile(r"\"\"\"|'''|\"|'|#|[\[\]{}]|\n")


def toml_lines(text: str) -> dict[KeyPath, int]:
    """The line, from 1 on, on which each table and key of a TOML text stands.

    Keys inside inline tables and arrays are not listed: they have the line of the key before them
    (`line_of`).

    text: A text that a TOML reader has accepted.
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
