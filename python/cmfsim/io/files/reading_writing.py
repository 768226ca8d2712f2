"""Shared by all readers and writers: names in errors, documents, XML, safe replacement.

Files come from strangers: paths may not lead out of a folder, sizes are checked before memory is
taken. A file is written under a temporary name and renamed, so a run that fails leaves the old one
whole.
"""

import contextlib
import glob
import json
import math
import os
import re
import stat
import tempfile
from collections.abc import Callable, Iterator, Mapping
from importlib import import_module
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import Any, BinaryIO
from xml.parsers import expat

from cmfsim.errors import CaseInputError, CmfsimError
from cmfsim.io.files.leftovers import abandoned, temporary_file

# Text files (plans, scene descriptions) above this size are not what they say they are, bytes.
MAX_TEXT = 16 * 2**20
FORMAT_VERSION = 1
# Digits of the largest whole number that is a float as well, and that number.
MAX_DIGITS = 308
MAX_WHOLE = 10**MAX_DIGITS
# Parts of a dotted TOML key: ours have four.
MAX_KEY_PARTS = 8
KEY_PART = r"""(?:[A-Za-z0-9_-]+|"(?:[^"\\\n]|\\.)*"|'[^'\n]*')"""
DEEP_KEY = rf"(?<![A-Za-z0-9_-]){KEY_PART}(?:[ \t]*\.[ \t]*{KEY_PART}){{{MAX_KEY_PARTS}}}"
# Comments and texts are taken as a whole, so that a key is found outside of them alone.
OUTSIDE_TEXTS = re.compile(
    r"#[^\n]*|\"\"\"(?:[^\"\\]|\\.|\"(?!\"\"))*(?:\"\"\"|\Z)|'''.*?(?:'''|\Z)"
    rf"|(?P<deep>{DEEP_KEY})|{KEY_PART}",
    re.DOTALL,
)
# Where TOML's error lies; a text between double quotes with a backslash; quotes of word processors.
LINE_IN_MESSAGE = re.compile(r"\(at line (\d+), column (\d+)\)")
WINDOWS_TEXT = re.compile(r'"([^"\n]*\\[^"\n]*)"')
TYPOGRAPHIC = "\N{LEFT DOUBLE QUOTATION MARK}\N{RIGHT DOUBLE QUOTATION MARK}"
MOST_SHOWN_PATH = 120
# The units that every file of ours has; others are refused, never taken for these.
UNITS: Mapping[str, str] = MappingProxyType({"length": "mm", "stress": "MPa", "force": "N"})
# Characters of a file's name that an error repeats; names that no system takes are longer.
MAX_SHOWN_NAME = 255


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """A file under a temporary name in the same folder, renamed to `path` when all went well."""
    for left in abandoned(path.parent, f".{glob.escape(path.name)}.*.part"):
        left.unlink(missing_ok=True)
    handle, temporary = temporary_file(path)
    try:
        # The lock lasts as long as the handle: until the file has its name.
        with os.fdopen(handle, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
            # Such files are their owner's alone; results follow the user's umask.
            umask = os.umask(0)
            os.umask(umask)
            temporary.chmod(0o666 & ~umask)
            if os.name != "nt":
                temporary.replace(path)
        if os.name == "nt":
            # Windows renames no open file.
            temporary.replace(path)
    except BaseException as error:
        is_lost = isinstance(error, FileNotFoundError) and not temporary.exists()
        temporary.unlink(missing_ok=True)
        if is_lost:
            raise deleted_meanwhile(path.parent) from error
        if isinstance(error, OSError) and error.filename is None and error.errno is not None:
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise


def replace_text(path: Path, text: str) -> int:
    """The size in bytes of a text, now in a file in place of what was there; as `replacing`."""
    with replacing(path) as file:
        return file.write(text.encode())


def deleted_meanwhile(folder: Path) -> CmfsimError:
    """The error of a folder that went while results were written to it: no fault of the input."""
    return CmfsimError(
        f"{folder}: was deleted or moved while results were written to it: run the command again"
    )


def check_readable(path: Path, error: type[ValueError] = CaseInputError) -> None:
    """Refuses what is no plain file: opening a pipe waits for ever, a device may never end.

    Raises `FileNotFoundError`: There is nothing of this name; for all else, the given error.
    """
    mode = _mode(path, error)
    if mode is None:
        raise FileNotFoundError(f"{path}: no such file")
    name = _shown(path)
    if stat.S_ISDIR(mode):
        raise error(f"{name}: is a folder, not a file")
    if not stat.S_ISREG(mode):
        raise error(f"{name}: is a pipe or a device, not a file: copy its content to a file")
    if not os.access(path, os.R_OK):
        raise error(f"{name}: cannot be read: change its permissions")


def is_there(path: Path, error: type[ValueError] = CaseInputError) -> bool:
    """Whether there is a file or folder of this name; an error for names that no file can have."""
    return _mode(path, error) is not None


def _mode(path: Path, error: type[ValueError]) -> int | None:
    """The kind and rights of what has this name; None where nothing has."""
    try:
        return path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as other:
        # Path.exists and Path.is_file raise these too: a name of 300 characters, for one.
        raise error(f"{_shown(path)}: cannot be opened ({other.strerror})") from other
    except ValueError as other:
        raise error(f"{_shown(path)!r}: this is not a valid file name ({other})") from other


def _shown(path: Path) -> str:
    name = path.name
    return name if len(name) <= MAX_SHOWN_NAME else f"{name[:MAX_SHOWN_NAME]}…"


@contextlib.contextmanager
def named(path: Path) -> Iterator[None]:
    """Puts the file's name before the text of an error about its content."""
    try:
        yield
    except FileNotFoundError as error:
        if error.filename is None:
            raise
        raise FileNotFoundError(f"{error.filename}: no such file") from error
    except IsADirectoryError as error:
        raise CaseInputError(f"{path.name}: is a folder, not a file") from error
    except PermissionError as error:
        raise CaseInputError(f"{path.name}: cannot be read: change its permissions") from error
    except ValueError as error:
        text = str(error)
        own = text.startswith(f"{path.name}:")
        raise CaseInputError(text if own else f"{path.name}: {text}") from error


@contextlib.contextmanager
def utf8_path(path: Path) -> Iterator[str]:
    """An absolute path as C++ libraries take it: a link in UTF-8 where a name on it is not."""
    text = os.path.abspath(path)  # noqa: PTH100 (links stay as they are named)
    try:
        text.encode()
    except UnicodeEncodeError:
        with tempfile.TemporaryDirectory(prefix="cmfsim-link-") as folder:
            # Some libraries go by the ending.
            ending = "".join(path.suffixes[-2:]).encode("ascii", "ignore").decode()
            link = Path(folder, f"file{ending}")
            link.symlink_to(text)
            yield str(link)
    else:
        yield text


def beside(folder: Path, where: str, name: object) -> Path:
    """A path given by a text file, which may not lead out of that file's folder."""
    if not isinstance(name, str) or not name:
        raise CaseInputError(f"{where} names no file")
    relative = PurePosixPath(name)
    path = folder / relative
    leads_out = relative.is_absolute() or ".." in relative.parts or any(c in name for c in "\\:\0")
    # A link may not lead out of the folder either.
    if leads_out or not is_below(path, folder):
        raise CaseInputError(f"{where} is {name!r}: a file in the same folder or below is needed")
    return path


def is_below(path: Path, folder: Path) -> bool:
    """Whether a path leads into a folder once its links are followed.

    A data set of git-annex or DataLad keeps its files below `.git`, and links to them: these links
    lead into it as well.
    """
    try:
        real, top = path.resolve(), folder.resolve()
        stores = (place / ".git" / "annex" / "objects" for place in (top, *top.parents))
        return real.is_relative_to(top) or any(real.is_relative_to(store) for store in stores)
    except (OSError, RuntimeError, ValueError):
        # Links that lead round in a circle, a name that no system takes.
        return False


def utf8_text(data: bytes) -> str:
    """The text of a file in UTF-8, with or without a mark at its beginning."""
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise CaseInputError(
            'is UTF-16 (Notepad calls it "Unicode"): save it as UTF-8 in your editor'
        )
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        shown = data[error.start : error.start + 1].decode("latin-1")
        raise CaseInputError(
            f"line {line} is not UTF-8 text (byte {data[error.start]:#04x}, {shown!r} in Latin-1): "
            "save the file as UTF-8 in your editor"
        ) from error


def toml_hint(text: str, message: str) -> str:
    """What is probably wrong with a line that is not TOML, and what to write; or nothing."""
    found = LINE_IN_MESSAGE.search(message)
    rows = text.split("\n")
    row = rows[int(found[1]) - 1] if found and int(found[1]) <= len(rows) else ""
    if path := WINDOWS_TEXT.search(row):
        slashes = path[1].replace("\\\\", "\\").replace("\\", "/")[:MOST_SHOWN_PATH]
        return (
            "; between double quotes a backslash begins a code for a character: write "
            f'"{slashes}" with slashes, or use single quotes'
        )
    if any(quote in row for quote in TYPOGRAPHIC):
        return '; its quotes are typographic: replace them by straight ones (")'
    return ""


def check_plain_toml(text: str) -> None:
    """Refuses keys of more than 8 parts: their tables in tables take a thousand times the text."""
    # Usually there is no such key, in texts and comments neither.
    found = re.search(DEEP_KEY, text) and next(
        (match for match in OUTSIDE_TEXTS.finditer(text) if match["deep"]), None
    )
    if found:
        line = text.count("\n", 0, found.start()) + 1
        raise CaseInputError(f"line {line}: a key has more than {MAX_KEY_PARTS} parts")


def check_numbers(value: object, *, finite: bool = False) -> None:
    """Refuses whole numbers beyond a float's range anywhere in plain values of a text.

    finite: Whether other numbers must be finite as well: JSON reads 1e400 as infinity.
    """
    left = [value]
    while left:
        entry = left.pop()
        if isinstance(entry, dict):
            left.extend(entry.values())
        elif isinstance(entry, list):
            left.extend(entry)
        elif isinstance(entry, int) and not -MAX_WHOLE <= entry <= MAX_WHOLE:
            digits = round(entry.bit_length() * math.log10(2.0))
            raise CaseInputError(
                f"holds a whole number of about {digits} digits: at most {MAX_DIGITS} are read"
            )
        elif finite and isinstance(entry, float) and not math.isfinite(entry):
            raise CaseInputError("holds a number that is not finite, such as 1e400")


def toml_module() -> Any:
    """The reader of TOML: of the standard library, or tomli before Python 3.11."""
    for name in ("tomllib", "tomli"):
        with contextlib.suppress(ModuleNotFoundError):
            return import_module(name)
    raise CaseInputError("Python 3.10 reads TOML with tomli: pip install tomli, or use .json")


def parsed_json(text: str) -> Any:
    """The value of a JSON text; NaN, Infinity and a name twice in one table are refused.

    Raises `ValueError`, `RecursionError`: Not JSON, or nested too deeply.
    """
    return json.loads(text, parse_constant=refuse_constant, object_pairs_hook=_refuse_twice)


def refuse_constant(name: str) -> float:
    """Refuses NaN and Infinity, which JSON has not."""
    message = f"{name} is not a JSON number"
    raise ValueError(message)


def _refuse_twice(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """The table of its pairs: of two values of one name, nobody knows which is meant."""
    table = dict(pairs)
    if len(table) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        message = f"{twice[:40]!r} appears twice"
        raise ValueError(message)
    return table


def known_keys(where: str, table: Mapping[str, Any], known: tuple[str, ...]) -> dict[str, Any]:
    """The table, if it has no other keys."""
    for name in table:
        if name not in known:
            raise CaseInputError(f"[{where}] has the unknown key {name!r}: use {', '.join(known)}")
    return dict(table)


def table_of(header: Mapping[str, Any], name: str, *, optional: bool = False) -> dict[str, Any]:
    """A table of a document by its name; empty if optional and absent."""
    if name not in header and optional:
        return {}
    table = header.get(name)
    if not isinstance(table, dict):
        raise CaseInputError(f"lacks the table {name!r}" if table is None else f"{name!r} no table")
    return table


def check_units(units: object) -> None:
    """Refuses a table of units that states others than mm, MPa and N; none at all means these."""
    if units is None:
        return
    if not isinstance(units, dict):
        raise CaseInputError(f"units is {units!r}: a table of names and units is needed")
    for name, unit in units.items():
        if name not in UNITS:
            raise CaseInputError(f"units has the unknown key {name!r}: use {', '.join(UNITS)}")
        if unit != UNITS[name]:
            raise CaseInputError(
                f"units.{name} is {unit!r}: only {UNITS[name]!r} is read. Convert every {name} "
                f"of the file to {UNITS[name]} and write {UNITS[name]!r}"
            )


def check_version(version: object) -> None:
    """Refuses other versions of a format than this one."""
    if isinstance(version, bool) or not isinstance(version, int):
        raise CaseInputError(f"version is {version!r}: a whole number is needed")
    if version != FORMAT_VERSION:
        hint = "the file was written by a newer cmfsim: update cmfsim"
        hint = hint if version > FORMAT_VERSION else "unknown version"
        raise CaseInputError(f"version is {version}, this cmfsim reads {FORMAT_VERSION}; {hint}")


def walk_xml(
    text: bytes,
    most: tuple[int, int],
    start: Callable[[str, dict[str, str]], object],
    end: Callable[[], object] = lambda: None,
    words: Callable[[str], object] | None = None,
    *,
    separator: str | None = None,
) -> None:
    """Calls back for each element of a text that begins and ends, and for its words.

    The encoding is UTF-8 whatever the text states: nothing hides behind another one. Entities could
    grow without bound. Elements, and how deeply they are nested, are limited; without a separator
    between namespace and name, namespaces are not resolved.
    """
    if b"\0" in text:
        raise CaseInputError("is not XML in UTF-8: it holds zero bytes")
    parser = expat.ParserCreate("UTF-8", separator)
    parser.buffer_text, parser.buffer_size = True, 2**20
    left, depth = most

    def refuse(*_: object) -> None:
        raise CaseInputError("XML with a document type or entities is not read")

    def begun(name: str, attributes: dict[str, str]) -> None:
        nonlocal left, depth
        left, depth = left - 1, depth - 1
        if min(left, depth) < 0:
            raise CaseInputError(
                f"is nested too deeply, or has too many elements: at most {most[0]}, {most[1]} deep"
            )
        start(name, attributes)

    def ended(_: str) -> None:
        nonlocal depth
        depth += 1
        end()

    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = refuse
    parser.StartElementHandler, parser.EndElementHandler = begun, ended
    if words is not None:
        parser.CharacterDataHandler = words
    try:
        parser.Parse(text, True)  # noqa: FBT003 (its signature)
    except expat.ExpatError as error:
        raise CaseInputError(
            f"is not XML in UTF-8, or is cut short ({error}); it begins with {text[:20]!r}"
        ) from error
