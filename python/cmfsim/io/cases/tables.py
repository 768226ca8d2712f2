"""Tables of a TOML text with checked values, as the file or its changes state them."""

import contextlib
import copy
import json
import math
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, Field, dataclass, field, fields
from pathlib import Path
from typing import Any, NoReturn, TypeVar, get_type_hints

import numpy as np

from cmfsim.errors import CaseInputError, CmfsimError
from cmfsim.io.files import reading_writing
from cmfsim.io.files.texts import KeyPath, line_of, toml_lines
from cmfsim.values.checks import Floats, keep, nearest

# A case file above this size is not what it says it is, bytes.
MAX_CASE_TEXT = 2**20
# What `cmfsim init` writes where it cannot tell what is meant.
UNDECIDED = "?"

# Characters below this one command a terminal and stand in no path.
BLANK = 0x20
# A drive or a share, of which only Windows knows.
WINDOWS_PATH = re.compile(r"[A-Za-z]:[\\/]|\\\\")


@dataclass(frozen=True)
class CaseChanges:
    """Keys of a case file with other values than the file has.

    Attributes
    ----------
    values : mapping of str to plain values
        Nested as in a case file. Tables are merged with the case's own; any other value, and any
        list, replaces the case's.
    without : tuple of str
        Dotted keys of the case file that are removed first, such as "tissue.preset".
    file : str
        The file that states the changes, for errors.
    lines : mapping of key path to int
        The line of each changed key in that file; if left out, 1 for all.

    Examples
    --------
    >>> import cmfsim
    >>> changes = cmfsim.CaseChanges({"muscles": {"blur": 0.0}})
    >>> case = cmfsim.Case.load("case.toml", changes=changes)
    """

    values: Mapping[str, Any]
    without: tuple[str, ...] = ()
    file: str = "changes"
    lines: Mapping[KeyPath, int] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        lines = self.lines or dict.fromkeys(_paths(self.values, ()), 1)
        keep(self, values=self.values, lines=lines)

    def as_json(self) -> str:
        """The changes as a text that travels to another process."""
        lines = [[list(path), line] for path, line in self.lines.items()]
        return json.dumps([dict(self.values), self.without, self.file, lines])

    @classmethod
    def from_json(cls, text: str) -> "CaseChanges":
        """The changes that `as_json` wrote."""
        values, without, file, lines = json.loads(text)
        places = {tuple(path): line for path, line in lines}
        return cls(values, tuple(without), file, places)


def _paths(values: Mapping[str, Any], above: KeyPath) -> Iterator[KeyPath]:
    """The path of every key, tables included."""
    for key, value in values.items():
        yield (*above, key)
        if isinstance(value, Mapping):
            yield from _paths(value, (*above, key))


def read_tables(path: Path, what: str = "case file", *, json_too: bool = False) -> "Table":
    """The whole of a TOML file as a table.

    what: What the file is, for errors.
    json_too: Whether the file may be JSON; then an error names its keys, but no line.
    """
    reading_writing.check_readable(path)
    endings = (".toml", ".json") if json_too else (".toml",)
    if path.suffix not in endings:
        allowed = " or ".join(endings)
        raise CaseInputError(f"{path.name}: a {what} ends in {allowed}, not {path.suffix!r}")
    if path.stat().st_size > MAX_CASE_TEXT:
        raise CaseInputError(
            f"{path.name}: has {path.stat().st_size} bytes, a {what} at most {MAX_CASE_TEXT}"
        )
    if path.suffix == ".json":
        with reading_writing.named(path):
            return Table(_json_tables(path), (), path.name, {})
    try:
        with reading_writing.named(path):
            text = reading_writing.utf8_text(path.read_bytes()).replace("\r\n", "\n")
            reading_writing.check_plain_toml(text)
        values = reading_writing.toml_module().loads(text)
        with reading_writing.named(path):
            reading_writing.check_numbers(values)
    except RecursionError as error:
        raise CaseInputError(f"{path.name}: is nested too deeply") from error
    except ValueError as error:
        if isinstance(error, CaseInputError):
            raise
        message = str(error)
        found = reading_writing.LINE_IN_MESSAGE.search(message)
        place = f":{found[1]}" if found else ""
        hint = reading_writing.toml_hint(text, message)
        raise CaseInputError(f"{path.name}{place}: is not TOML: {message}{hint}") from error
    lines = toml_lines(text)
    _refuse_undecided(values, lines, text, path.name)
    return Table(values, (), path.name, lines)


def _json_tables(path: Path) -> dict[str, Any]:
    try:
        values = reading_writing.parsed_json(reading_writing.utf8_text(path.read_bytes()))
    except (ValueError, RecursionError) as error:
        raise CaseInputError(f"cannot be read: {error}") from error
    if not isinstance(values, dict):
        raise CaseInputError("is not a table of names and values")
    reading_writing.check_numbers(values)
    return values


def _refuse_undecided(
    values: Mapping[str, Any], lines: Mapping[KeyPath, int], text: str, file: str
) -> None:
    """Refuses a file in which a value is "?": `cmfsim init` left it to a person to decide."""
    rows = text.split("\n")
    found: list[tuple[int, str]] = []
    left: list[tuple[KeyPath, Any]] = [((), values)]
    while left:
        path, value = left.pop()
        if isinstance(value, dict):
            left.extend(((*path, key), entry) for key, entry in value.items())
        elif isinstance(value, list):
            left.extend(((*path, number), entry) for number, entry in enumerate(value))
        elif value == UNDECIDED:
            line = line_of(lines, path)
            # What may stand there is in the comment, and in those right below it.
            _, _, question = rows[line - 1].partition('"  #')
            words = [question.strip(" }")]
            for row in rows[line:]:
                if not row.lstrip().startswith("#  "):
                    break
                words.append(row.strip().lstrip("#").strip())
            name = ".".join(str(part) for part in path)
            found.append((line, f'{name} is "{UNDECIDED}": {" ".join(filter(None, words))}'))
    if not found:
        return
    found.sort()
    line, first = found[0]
    others = ", ".join(str(number) for number, _ in found[1:])
    more = f" (also undecided: line{'s' if len(found) > 2 else ''} {others})" if others else ""
    raise CaseInputError(f"{file}:{line}: {first or 'decide it'}{more}")


def _known(lines: Mapping[KeyPath, int], path: KeyPath) -> int:
    """How many parts of a path the longest of its beginnings has that is listed."""
    return next((n for n in range(len(path), 0, -1) if path[:n] in lines), 0)


def _forget(lines: dict[KeyPath, int], path: KeyPath) -> None:
    """Removes the lines of a key and of everything below it."""
    for other in [other for other in lines if other[: len(path)] == path]:
        del lines[other]


def _merge(
    into: dict[str, Any], values: Mapping[str, Any], path: KeyPath, lines: dict[KeyPath, int]
) -> None:
    """Puts values into a table; what they replace loses its line."""
    for key, value in values.items():
        place = (*path, key)
        if isinstance(value, Mapping) and isinstance(into.get(key), dict):
            _merge(into[key], value, place, lines)
            continue
        _forget(lines, place)
        into[key] = copy.deepcopy(dict(value)) if isinstance(value, Mapping) else value


Part = TypeVar("Part")


class Table:
    """A table of a TOML file that knows where its keys stand."""

    def __init__(
        self,
        values: Mapping[str, Any],
        path: KeyPath,
        file: str,
        lines: Mapping[KeyPath, int],
        changes: CaseChanges | None = None,
    ) -> None:
        self._values = values
        self._path = path
        self._file = file
        self._lines = lines
        self._changes = changes

    def __contains__(self, key: str) -> bool:
        return key in self._values

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def line(self, key: str | None = None) -> int:
        """The line of a key, or of the table."""
        return line_of(self._lines, self._path if key is None else (*self._path, key))

    def fail(self, key: str | None, message: str) -> NoReturn:
        """Raises an error about a key, or about the table."""
        path = self._path if key is None else (*self._path, key)
        label = "".join(f"[{p}]" if isinstance(p, int) else f".{p}" for p in path).lstrip(".")
        text = f"{label} {message}" if label else message
        raise CaseInputError(f"{self._place(path)}: {text}")

    def _place(self, path: KeyPath) -> str:
        """File and line of a key: in the file of changes, where that is the closer of the two."""
        changes = self._changes
        if changes is not None:
            theirs, ours = (_known(lines, path) for lines in (changes.lines, self._lines))
            if theirs and theirs >= ours:
                return f"{changes.file}:{line_of(changes.lines, path)}"
        # JSON has no lines.
        return f"{self._file}:{line_of(self._lines, path)}" if self._lines else self._file

    def changed(self, changes: CaseChanges) -> "Table":
        """The whole file with changes; an error names the file in which its key stands."""
        values, lines = copy.deepcopy(dict(self._values)), dict(self._lines)
        for name in changes.without:
            *tables, key = name.split(".")
            table: Any = values
            for part in tables:
                table = table.get(part) if isinstance(table, dict) else None
            if not isinstance(table, dict) or key not in table:
                raise CaseInputError(
                    f"{changes.file}: without {name!r}: {self._file} has no such key"
                )
            del table[key]
            _forget(lines, (*tables, key))
        _merge(values, changes.values, (), lines)
        return Table(values, self._path, self._file, lines, changes)

    @contextlib.contextmanager
    def at(self, key: str | None) -> Iterator[None]:
        """Puts file, line and key before the text of an error about a value."""
        try:
            yield
        except CmfsimError as error:
            self.fail(key, f"is invalid: {error}")

    def all_paths(self) -> Mapping[KeyPath, int]:
        """The line of each key of the file, by its path."""
        return self._lines

    def all_places(self) -> dict[str, str]:
        """File and line of each dotted key."""
        changed = () if self._changes is None else self._changes.lines
        return {".".join(map(str, path)): self._place(path) for path in (*self._lines, *changed)}

    def values(self) -> dict[str, Any]:
        """All that the table holds, as plain values."""
        return copy.deepcopy(dict(self._values))

    def only(self, *known: str) -> "Table":
        """The table, if it has no other keys."""
        for key in self._values:
            if key not in known:
                self.fail(
                    key, f"is unknown{nearest(key, known)} (known here: {', '.join(sorted(known))})"
                )
        return self

    def need(self, key: str, why: str = "") -> Any:
        """The value of a key that must be there."""
        if key not in self._values:
            self.fail(None, f"lacks {key!r}{why}")
        return self._values[key]

    def check_format(self, name: str) -> None:
        """Refuses another format than this, or another version of it."""
        found = self.text("format")
        if found != name:
            self.fail("format", f"is {found!r}: {name!r} is needed")
        version = self.need("version", f": write version = {reading_writing.FORMAT_VERSION}")
        if isinstance(version, bool) or version != reading_writing.FORMAT_VERSION:
            self.fail(
                "version", f"is {version!r}: this cmfsim reads {reading_writing.FORMAT_VERSION}"
            )

    def text(self, key: str, default: str | None = None, choices: tuple[str, ...] = ()) -> str:
        """A text that is not empty, among the choices if there are any."""
        value = self.need(key) if default is None else self._values.get(key, default)
        if not isinstance(value, str) or not value.strip():
            self.fail(key, f"is {value!r}: a text is needed")
        if choices and value not in choices:
            hint = nearest(value, choices)
            self.fail(key, f"is {value!r}{hint} (use one of: {', '.join(choices)})")
        return value

    def flag(self, key: str, *, default: bool) -> bool:
        """True or false."""
        value = self._values.get(key, default)
        if not isinstance(value, bool):
            self.fail(key, f"is {value!r}: true or false is needed")
        return value

    def number(
        self,
        key: str,
        unit: str = "",
        low: float | None = None,
        high: float | None = None,
        *,
        above: float | None = None,
    ) -> float | None:
        """A finite number within its range; None where it is absent."""
        if key not in self._values:
            return None
        value = self._checked_number(key, self._values[key])
        limits = {"above": above, "at least": low, "at most": high}
        allowed = [f"{words} {limit:g}" for words, limit in limits.items() if limit is not None]
        inside = (
            (above is None or value > above)
            and (low is None or value >= low)
            and (high is None or value <= high)
        )
        if not inside:
            needed = f"{' and '.join(allowed)} {unit}".rstrip()
            self.fail(key, f"is {value:g}: must be {needed}")
        return value

    def whole(self, key: str, default: int, low: int, high: int) -> int:
        """A whole number from low to high."""
        value = self._values.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int):
            self.fail(key, f"is {value!r}: a whole number is needed")
        if not low <= value <= high:
            self.fail(key, f"is {value}: must be from {low} to {high}")
        return value

    def vector(self, key: str) -> Floats | None:
        """Three finite numbers; None where they are absent."""
        if key not in self._values:
            return None
        value = self._values[key]
        if not isinstance(value, list) or len(value) != 3:
            self.fail(key, f"is {value!r}: three numbers [x, y, z] are needed")
        return np.array([self._checked_number(key, entry) for entry in value])

    def matrix(self, key: str) -> Floats:
        """A 4 × 4 matrix of finite numbers."""
        rows = self.need(key)
        if not isinstance(rows, list) or len(rows) != 4:
            self.fail(key, "is not a 4 × 4 matrix: four rows of four numbers are needed")
        for row in rows:
            if not isinstance(row, list) or len(row) != 4:
                self.fail(key, f"has the row {row!r}: four numbers are needed")
        return np.array([[self._checked_number(key, entry) for entry in row] for row in rows])

    def plain(self, key: str) -> Any:
        """A text, a flag, a number, or a list of numbers or texts, as it stands."""
        value = self.need(key)
        entries = value if isinstance(value, list) else [value]
        for entry in entries:
            if isinstance(entry, str | bool):
                continue
            self._checked_number(key, entry)
        return value

    def units(self) -> None:
        """Refuses other units than mm, MPa and N, if the table states any."""
        with self.at(None):
            reading_writing.check_units(self._values.get("units"))

    def beside(self, key: str, folder: Path) -> Path:
        """A path to read that does not lead out of a folder, of a file that is not the user's."""
        with self.at(key):
            return reading_writing.beside(folder, "it", self.need(key))

    def path(self, key: str, folder: Path) -> Path:
        """A path to read, against a folder unless it is absolute; `~` is the home folder.

        A case is its owner's, so that it may lead to images kept elsewhere.
        """
        name = self.text(key)
        if "\0" in name:
            self.fail(key, "contains a zero character, which no file name can have")
        if os.name != "nt" and WINDOWS_PATH.match(name):
            self.fail(
                key,
                f"is {name!r}, a path of Windows: write where this system has the file, such as "
                '"/mnt/c/Users/me/ct.nrrd", or copy it into the folder of the case',
            )
        try:
            path = folder / Path(name).expanduser()
            if os.name != "nt" and "\\" in name and not os.path.lexists(path):
                # A relative path, as Windows writes it.
                path = folder / Path(name.replace("\\", "/"))
        except RuntimeError:
            self.fail(key, f"is {name!r}: no user has this name; write the full path")
        try:
            found = reading_writing.is_there(path)
        except CaseInputError as error:
            self.fail(key, f"names {error}")
        if not found and any(ord(c) < BLANK for c in name):
            # "C:\new\table.nrrd": TOML takes \n and \t for a line end and a tab.
            self.fail(
                key,
                f"is {name!r}, with a control character: between double quotes a backslash begins "
                "a code for one; write the path with slashes, or in single quotes",
            )
        return path

    def part(
        self,
        kind: type[Part],
        folder: Path,
        also: tuple[str, ...] = (),
        at: str | None = None,
        **given: Any,
    ) -> Part:
        """A value of a class whose fields are `stated` by the keys of the table, and no others.

        also: Keys of the table that are read otherwise.
        at: The key that an error of the value as a whole is about.
        given: Fields that are read otherwise; None leaves the default.
        """
        hints = get_type_hints(kind)
        found = {f.name: f for f in fields(kind) if f.metadata}  # type: ignore[arg-type]
        self.only(*found, *given, *also)
        values = {name: value for name, value in given.items() if value is not None}
        for name, one in found.items():
            if name in self or one.default is MISSING:
                values[name] = self._stated(one, hints[name], folder)
        with self.at(at):
            return kind(**values)

    def _stated(self, one: "Field[Any]", hint: Any, folder: Path) -> Any:
        """The value of a field, by its type and what it may be."""
        low, high = one.metadata["range"]
        if hint in {Path, Path | None}:
            return self.path(one.name, folder)
        if hint is bool:
            return self.flag(one.name, default=False)
        if hint is int:
            return self.whole(one.name, 0, low, high)
        if hint in {float, float | None}:
            return self.number(one.name, one.metadata["unit"], low, high)
        return self.text(one.name, choices=one.metadata["choices"])

    def table(self, key: str) -> "Table":
        """A table below this one; empty where it is absent."""
        value = self._values.get(key, {})
        if not isinstance(value, dict):
            self.fail(key, f"is {value!r}: a table of names and values is needed")
        return Table(value, (*self._path, key), self._file, self._lines, self._changes)

    def tables(self, key: str) -> list["Table"]:
        """The tables of an array of tables; none where it is absent."""
        value = self._values.get(key, [])
        if not isinstance(value, list) or any(not isinstance(entry, dict) for entry in value):
            self.fail(key, f"is not a list of tables: write [[{key}]] before each")
        return [
            Table(entry, (*self._path, key, number), self._file, self._lines, self._changes)
            for number, entry in enumerate(value)
        ]

    def _checked_number(self, key: str, value: object) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            self.fail(key, f"holds {value!r}: a number is needed")
        try:
            number = float(value)
        except OverflowError:
            self.fail(key, "holds a whole number that is too large")
        if not math.isfinite(number):
            self.fail(key, f"holds {number}: every number must be finite")
        return number
