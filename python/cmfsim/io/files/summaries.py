"""Summaries of results as JSON that is read as it was written: with a digest, and checked values.

A summary states what other files are, so it is not believed where it, or one of them, was changed:
it holds the SHA-256 of its own content and of each file that it lists. Whoever computes these again
can write what they like; the checks of types and ranges hold then as well.
"""

import hashlib
import json
import math
import os
import stat
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NoReturn

from cmfsim.errors import CaseInputError
from cmfsim.io.files.reading_writing import refuse_constant
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

# Refuses a value that is not as it must be, given its place in the summary and the value.
Check = Callable[[str, object], None]


def write_summary(
    path: Path, values: Mapping[str, Any], sealed: Mapping[str, str] | None = None
) -> None:
    """Writes a summary with the hashes of files next to it, and its own.

    Parameters
    ----------
    path : Path
    values : mapping
        Plain values.
    sealed : mapping of str to str, optional
        The files in the same folder that it answers for: their `hashes_of`.

    Raises
    ------
    ValueError
        NaN or infinity among the values.
    """
    content = {**values, "sha256": dict(sealed or {})}
    # As a reader will have it: tuples are lists, keys are texts.
    content = json.loads(json.dumps(content, allow_nan=False))
    content["digest"] = _digest(content)
    path.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def read_summary(path: Path, check: Check, again: str) -> dict[str, Any]:
    """The content of a summary that is whole, unchanged and as it must be.

    Parameters
    ----------
    path : Path
    check : callable
    again : str
        What makes the file again, for the error.

    Raises
    ------
    FileNotFoundError
        The file does not exist.
    CaseError
        (also `ValueError`) It is a link or no file, too large, not JSON; its digest is missing or
        another; a value of another type or out of range, with its place.
    """
    try:
        content = plain_json(path)
        if "digest" not in content:
            raise CaseInputError("has no digest: an older version or another program wrote it")
        if content.pop("digest") != _digest(content):
            raise CaseInputError("was changed after it was written")
        plain("", content)
        mapping(text, most=200)("sha256", content.get("sha256"))
        check("", content)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise FileNotFoundError(f"{path}: no such file") from error
    except OSError as error:
        raise CaseInputError(f"{path}: cannot be opened ({error.strerror}); {again}") from error
    except ValueError as error:
        raise CaseInputError(f"{path}: {error}; {again}") from error
    return content


def checked_file(folder: Path, summary: Mapping[str, Any], name: str, again: str) -> Path:
    """The path of a file next to a summary that is the one it was written with.

    Raises
    ------
    FileNotFoundError
        There is none.
    CaseError
        (also `ValueError`) The summary does not list it, or it is another file.
    """
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


def plain_json(path: Path) -> dict[str, Any]:
    """The table of names and values in a JSON file that is no link and not too large.

    Raises
    ------
    CaseError
        (also `ValueError`) Anything else; without the file's name.
    OSError
        It cannot be opened.
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
        found = json.loads(data.decode("utf-8"), parse_constant=refuse_constant)
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


def number(low: float = -LARGEST, high: float = LARGEST) -> Check:
    """A finite number within a range."""

    def check(where: str, value: object) -> None:
        plain = isinstance(value, int | float) and not isinstance(value, bool)
        # Compared before it is converted: an int may be too large for a float.
        if not plain or not low <= value <= high or not math.isfinite(value):  # type: ignore[operator,arg-type]
            _refuse(where, value, f"a number from {low:g} to {high:g} is needed")

    return check


def whole(low: int = 0, high: int = int(LARGEST)) -> Check:
    """A whole number within a range."""

    def check(where: str, value: object) -> None:
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            _refuse(where, value, f"a whole number from {low} to {high} is needed")

    return check


def text(where: str, value: object) -> None:
    """A text that is not endless."""
    if not isinstance(value, str) or len(value) > MOST_TEXT:
        _refuse(where, value, f"a text of {MOST_TEXT} characters at most is needed")
    try:
        value.encode("utf-8")
    except UnicodeEncodeError:
        _refuse(where, value, "a text of whole characters is needed")


def plain(where: str, value: object, depth: int = 0) -> None:
    """Numbers within any range, texts, flags and nothing, in lists and tables."""
    if depth > DEEPEST:
        raise CaseInputError(f"{where:.200} lies deeper than {DEEPEST} tables")
    if isinstance(value, str):
        text(where, value)
    elif isinstance(value, list | dict):
        entries = value.items() if isinstance(value, dict) else enumerate(value)
        for name, entry in entries:
            if isinstance(name, str):
                text(f"a name in {where}", name)
            plain(
                f"{where}.{name:.60}".lstrip(".") if isinstance(name, str) else where,
                entry,
                depth + 1,
            )
    elif value is not None and not isinstance(value, bool):
        number()(where, value)


def file_of(result: str, is_its: Callable[[str], bool]) -> Check:
    """A name that files of a result have, such as "a prediction"."""

    def check(where: str, value: object) -> None:
        if not isinstance(value, str) or not is_its(value):
            raise CaseInputError(f"{where} is {value!r:.60}: {result} has no file of that name")

    return check


def flag(where: str, value: object) -> None:
    """True or false."""
    if not isinstance(value, bool):
        _refuse(where, value, "true or false is needed")


def one_of(*known: str) -> Check:
    """One of some texts."""

    def check(where: str, value: object) -> None:
        if value not in known:
            _refuse(where, value, f"one of {', '.join(known)} is needed")

    return check


def optional(inner: Check) -> Check:
    """What a check lets through, or nothing."""

    def check(where: str, value: object) -> None:
        if value is not None:
            inner(where, value)

    return check


def listing(inner: Check, *, length: int | None = None, least: int = 0) -> Check:
    """A list of what a check lets through."""

    def check(where: str, value: object) -> None:
        if not isinstance(value, list) or not least <= len(value) <= MOST_ENTRIES:
            _refuse(where, value, f"a list of {least} or more entries is needed")
        if length is not None and len(value) != length:
            _refuse(where, value, f"a list of {length} entries is needed")
        for place, entry in enumerate(value):
            inner(f"{where}[{place}]", entry)

    return check


def mapping(inner: Check, *, most: int = MOST_ENTRIES, keys: Check = text) -> Check:
    """A table of any names with what a check lets through."""

    def check(where: str, value: object) -> None:
        if not isinstance(value, dict) or len(value) > most:
            _refuse(where, value, f"a table of {most} names at most is needed")
        for name, entry in value.items():
            keys(f"a name in {where}", name)
            inner(f"{where}.{name:.60}".lstrip("."), entry)

    return check


def table(
    required: Mapping[str, Check], more: Mapping[str, Check] | None = None, *, closed: bool = False
) -> Check:
    """A table that has some names, may have more of known kinds, and others unless it is closed."""
    known = {**required, **(more or {})}

    def check(where: str, value: object) -> None:
        if not isinstance(value, dict):
            _refuse(where, value, "a table of names and values is needed")
        for name in required:
            if name not in value:
                raise CaseInputError(f"{where} lacks {name!r}".strip())
        for name, entry in value.items():
            if name in known:
                known[name](f"{where}.{name}".lstrip("."), entry)
            elif closed:
                raise CaseInputError(f"{where} has the unknown name {name!r:.60}".strip())

    return check


def finding(where: str, value: object) -> None:
    """The values of a `Finding`."""
    known = {"severity": one_of(*SEVERITIES), "code": text, "what": text}
    table({**known, "where": text, "why": text, "fix": text})(where, value)
    if isinstance(value, dict) and not (value["code"] and value["what"]):
        raise CaseInputError(f"{where} states nothing")


def _refuse(where: str, value: object, needed: str) -> NoReturn:
    huge = isinstance(value, int) and not -LARGEST < value < LARGEST
    # Python refuses to write numbers of thousands of digits.
    shown = "a huge number" if huge else repr(value)
    raise CaseInputError(f"{where} is {shown:.60}: {needed}".strip())
