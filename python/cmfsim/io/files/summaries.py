"""Summaries of results as JSON that is read as it was written: with a digest, and checked values.

A summary states what other files are, so it is not believed where it, or one of them, was changed:
it holds the SHA-256 of its own content and of each file that it lists. Whoever computes these again
can write what they like; the checks of types and ranges hold then as well.
"""

import hashlib
import json
import math
import os
import re
import stat
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, NoReturn, TypeAlias

from cmfsim.errors import CaseInputError
from cmfsim.io.files.reading_writing import parsed_json, replace_text
from cmfsim.values.finding import SEVERITIES

# Above these a summary is not what it says it is: bytes, characters of a text, entries of a list.
MOST_BYTES = 16 * 2**20
MOST_TEXT = 20_000
MOST_ENTRIES = 100_000
# Larger numbers are no lengths, counts, times or seeds of anything here.
LARGEST = 1e19
# Tables and lists in one another.
DEEPEST = 12
CHUNK = 1 << 20

# What a value must be: see `check`.
Shape: TypeAlias = Any
# A text that is not empty.
SOME = re.compile(r"(?s).+")


class Span(NamedTuple):
    """Finite numbers within a range."""

    low: float = -LARGEST
    high: float = LARGEST
    whole: bool = False


class Maybe(NamedTuple):
    """A shape, or nothing."""

    shape: Shape


class Closed(NamedTuple):
    """A table that has no other names."""

    shape: Mapping[str, Shape]


COUNT = Span(0, LARGEST, whole=True)
# The values of a `Finding`.
FINDING: Shape = {
    "severity": frozenset(SEVERITIES),
    **dict.fromkeys(("code", "what"), SOME),
    **dict.fromkeys(("where", "why", "fix"), str),
}


def write_summary(
    path: Path, values: Mapping[str, Any], sealed: Mapping[str, str] | None = None
) -> None:
    """Writes a summary with its own hash, and those of the files next to it that it answers for."""
    content = {**values, "sha256": dict(sealed or {})}
    # As a reader will have it: tuples are lists, keys are texts.
    content = json.loads(json.dumps(content, allow_nan=False))
    content["digest"] = _digest(content)
    path.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def read_summary(path: Path, shape: Shape, again: str) -> dict[str, Any]:
    """The content of a summary that is whole, unchanged and of a shape, as `check` takes it.

    again: What makes the file again, for the error.
    """
    try:
        content = plain_json(path)
        if "digest" not in content:
            raise CaseInputError("has no digest: an older version or another program wrote it")
        if content.pop("digest") != _digest(content):
            raise CaseInputError("was changed after it was written")
        check("", content, object)
        check("", content, {"sha256": {str: str}})
        check("", content, shape)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise FileNotFoundError(f"{path}: no such file") from error
    except OSError as error:
        raise CaseInputError(f"{path}: cannot be opened ({error.strerror}); {again}") from error
    except ValueError as error:
        raise CaseInputError(f"{path}: {error}; {again}") from error
    return content


def checked_file(folder: Path, summary: Mapping[str, Any], name: str, again: str) -> Path:
    """The path of a file next to a summary that is the one it was written with."""
    path = folder / name
    known = summary["sha256"].get(name)
    if known is None or "/" in name or "\\" in name or name in {"", ".", ".."}:
        raise CaseInputError(f"{path}: does not belong to the results in its folder; {again}")
    try:
        regular = stat.S_ISREG(path.lstat().st_mode)
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{path}: no such file; {again}") from error
    if not regular or _hash_of(path) != known:
        raise CaseInputError(
            f"{path}: is not the file written with the results in its folder; {again}"
        )
    return path


def write_record(path: Path, values: Mapping[str, Any]) -> None:
    """Writes the record of a finished job, in one step, for `kept_record`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_text(path, json.dumps(values, indent=1, allow_nan=False))


def kept_record(path: Path, **made_from: object) -> dict[str, Any] | None:
    """The record of an earlier job that states these inputs; None if it is to be done again."""
    try:
        found = plain_json(path)
    except (OSError, ValueError):
        return None
    return found if all(found.get(name) == value for name, value in made_from.items()) else None


def plain_json(path: Path) -> dict[str, Any]:
    """The table of names and values in a JSON file that is no link and not too large.

    Raises `CaseError`: Anything else, without the file's name; `OSError` where it cannot be opened.
    """
    mode = path.lstat().st_mode
    if not stat.S_ISREG(mode):
        raise CaseInputError("is no file" if not stat.S_ISLNK(mode) else "is a link")
    handle = os.open(path, os.O_RDONLY)
    with os.fdopen(handle, "rb") as file:
        data = file.read(MOST_BYTES + 1)
    if len(data) > MOST_BYTES:
        raise CaseInputError(f"is larger than {MOST_BYTES} bytes")
    try:
        found = parsed_json(data.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise CaseInputError(f"is not JSON ({error})") from error
    if not isinstance(found, dict):
        raise CaseInputError("is not a table of names and values")
    return found


def _digest(content: Mapping[str, Any]) -> str:
    try:
        plain = json.dumps(content, sort_keys=True, allow_nan=False)
    except (ValueError, RecursionError) as error:  # 1e400 is read as infinity
        raise CaseInputError(f"contains a value that no summary contains ({error})") from error
    return hashlib.sha256(plain.encode()).hexdigest()


def hashes_of(folder: Path, names: Iterable[str]) -> dict[str, str]:
    """The SHA-256 of files in a folder, by their names."""
    return {name: _hash_of(folder / name) for name in names}


def _hash_of(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(CHUNK):
            digest.update(chunk)
    return digest.hexdigest()


def check(where: str, value: object, shape: Shape) -> None:
    """Refuses a value that is not of a shape, with its place in the summary.

    A shape is `str`, `bool`, `object` for any plain values; a frozenset of texts, or a pattern of
    a whole text; a `Span` of numbers; a `Maybe`; a list with the shape of its entries (of several,
    as many are needed); a table of names and shapes, where a name ending in "?" may be absent and
    others may be there as well unless it is `Closed`, or of the shapes of all names and their
    values; or a function of place and value that refuses it.
    """
    if isinstance(shape, Maybe):
        if value is not None:
            check(where, value, shape.shape)
    elif isinstance(shape, Closed):
        check(where, value, shape.shape)
        names = {name.removesuffix("?") for name in shape.shape}
        for other in [n for n in value if n not in names] if isinstance(value, dict) else ():
            raise CaseInputError(f"{where} has the unknown name {other!r:.60}".strip())
    elif isinstance(shape, Span):
        _check_number(where, value, shape)
    elif isinstance(shape, list):
        count = len(shape) if len(shape) > 1 else None
        if not isinstance(value, list) or len(value) > MOST_ENTRIES:
            _refuse(where, value, "a list is needed")
        if count not in {None, len(value)}:
            _refuse(where, value, f"a list of {count} entries is needed")
        for place, entry in enumerate(value):
            check(f"{where}[{place}]", entry, shape[0])
    elif isinstance(shape, Mapping):
        _check_table(where, value, shape)
    elif isinstance(shape, frozenset):
        if not isinstance(value, str) or value not in shape:
            _refuse(where, value, f"one of {', '.join(sorted(shape))} is needed")
    elif isinstance(shape, re.Pattern):
        _check_text(where, value)
        if not shape.fullmatch(str(value)):
            _refuse(where, value, "another text is needed")
    elif shape is str:
        _check_text(where, value)
    elif shape is bool:
        if not isinstance(value, bool):
            _refuse(where, value, "true or false is needed")
    elif shape is object:
        _check_plain(where, value)
    else:
        shape(where, value)


def _check_table(where: str, value: object, shape: Mapping[Any, Shape]) -> None:
    if not isinstance(value, dict) or len(value) > MOST_ENTRIES:
        _refuse(where, value, "a table of names and values is needed")
    for key, inner in shape.items():
        if isinstance(key, str):
            name = key.removesuffix("?")
            if name in value:
                check(f"{where}.{name}".lstrip("."), value[name], inner)
            elif name == key:
                raise CaseInputError(f"{where} lacks {name!r}".strip())
            continue
        for name, entry in value.items():
            check(f"a name in {where}", name, key)
            check(f"{where}.{name:.60}".lstrip("."), entry, inner)


def _check_number(where: str, value: object, span: Span) -> None:
    kinds = int if span.whole else int | float
    is_number = isinstance(value, kinds) and not isinstance(value, bool)
    # Compared before it is converted: an int may be too large for a float.
    if not is_number or not span.low <= value <= span.high or not math.isfinite(value):  # type: ignore[operator,arg-type]
        what = "a whole number" if span.whole else "a number"
        _refuse(where, value, f"{what} from {span.low:g} to {span.high:g} is needed")


def _check_text(where: str, value: object) -> None:
    """A text that is not endless."""
    if not isinstance(value, str) or len(value) > MOST_TEXT:
        _refuse(where, value, f"a text of {MOST_TEXT} characters at most is needed")
    try:
        value.encode("utf-8")
    except UnicodeEncodeError:
        _refuse(where, value, "a text of whole characters is needed")


def _check_plain(where: str, value: object, depth: int = 0) -> None:
    """Numbers within any range, texts, flags and nothing, in lists and tables."""
    if depth > DEEPEST:
        raise CaseInputError(f"{where:.200} lies deeper than {DEEPEST} tables")
    if isinstance(value, str):
        _check_text(where, value)
    elif isinstance(value, list):
        for entry in value:
            _check_plain(where, entry, depth + 1)
    elif isinstance(value, dict):
        for name, entry in value.items():
            _check_text(f"a name in {where}", name)
            _check_plain(f"{where}.{name:.60}".lstrip("."), entry, depth + 1)
    elif value is not None and not isinstance(value, bool):
        _check_number(where, value, Span())


def _refuse(where: str, value: object, needed: str) -> NoReturn:
    huge = isinstance(value, int) and not -LARGEST < value < LARGEST
    # Python refuses to write numbers of thousands of digits.
    shown = "a huge number" if huge else repr(value)
    raise CaseInputError(f"{where} is {shown:.60}: {needed}".strip())
