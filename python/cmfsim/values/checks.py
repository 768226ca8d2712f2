"""Checks of what comes in, with the index and value at fault, and values that stay read-only.

Values hold their mappings as `types.MappingProxyType`, which Python can neither pickle nor copy,
and their arrays read-only, which numpy forgets when it does either; `Frozen` keeps both. Pickles
are for process pools and `copy.deepcopy` alone: no file is ever read by unpickling it.
"""

import copyreg
import difflib
import os
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from types import MappingProxyType
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.errors import CaseInputError

AnyPath = str | os.PathLike[str]
Floats = NDArray[np.float64]
Indices = NDArray[np.uint32]
# Most numbers of an array, and letters of a line, that a representation shows.
FEW, LINE = 9, 120


class Frozen:
    """Base of values whose arrays are still read-only after a pickle or a deep copy."""

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        """Takes the fields as they were, arrays read-only."""
        for name, value in state.items():
            object.__setattr__(self, name, _read_only(value))


class Plain:
    """Base of values that JSON holds, field by field."""

    def as_dict(self) -> dict[str, Any]:
        """Plain values with units in their names, as JSON holds them."""
        return _plain_fields(self)


def in_files(name: str | None) -> Mapping[str, str | None]:
    """The metadata of a field that JSON holds under another name, with its unit; None: not held."""
    return {"in_files": name}


def plain(value: Any) -> Any:
    """A value as JSON holds it: with lists, and dictionaries for mappings and other values."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return {key: plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    if hasattr(value, "as_dict"):
        return value.as_dict()
    return _plain_fields(value) if is_dataclass(value) else value


def _plain_fields(value: Any) -> dict[str, Any]:
    names = {f.name: f.metadata.get("in_files", f.name) for f in fields(value)}
    return {name: plain(getattr(value, own)) for own, name in names.items() if name is not None}


def keep(value: object, **made: Any) -> None:
    """Gives a frozen value its fields, as its constructor makes them; mappings become read-only."""
    for name, entry in made.items():
        read_only = MappingProxyType(dict(entry)) if isinstance(entry, Mapping) else entry
        object.__setattr__(value, name, read_only)


def listing(title: str, rows: Mapping[str, str]) -> str:
    """What a value shows of itself: a title, and a line for each row that has a text."""
    shown = {name: text for name, text in rows.items() if text}
    width = max((len(name) for name in shown), default=0)
    return "\n".join([title, *(f"  {name:<{width}}  {text}" for name, text in shown.items())])


def brief(value: Any) -> str:
    """The representation of a value of many numbers: its fields, arrays by their shapes."""
    shown = {f.name: _brief(getattr(value, f.name)) for f in fields(value) if f.repr}
    return listing(type(value).__name__, shown)


def _brief(entry: Any) -> str:
    if isinstance(entry, np.ndarray) and entry.size > FEW:
        return f"{entry.shape} {entry.dtype}"
    if isinstance(entry, Mapping):
        return ", ".join(map(str, entry))
    text = repr(entry).split("\n")[0]
    if isinstance(entry, tuple) and len(text) > LINE:
        return f"{len(entry)} of {type(entry[0]).__name__}"
    return text if len(text) <= LINE else f"{text[:LINE]}…"


def frozen_mapping(items: Mapping[Any, Any]) -> Mapping[Any, Any]:
    """A read-only mapping of these items, arrays among them read-only too."""
    return MappingProxyType({key: _read_only(value) for key, value in items.items()})


def _read_only(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        value.setflags(write=False)
    elif isinstance(value, tuple):
        for entry in value:
            _read_only(entry)
    return value


def _reduced(mapping: "MappingProxyType[Any, Any]") -> tuple[Any, ...]:
    return frozen_mapping, (dict(mapping),)


# For every value that holds one, also deep in a summary: there is one table of this in Python,
# which `pickle` and `copy` both ask. Nothing that could be pickled before is pickled otherwise.
copyreg.pickle(MappingProxyType, _reduced)


def frozen(array: NDArray[Any]) -> NDArray[Any]:
    """A read-only array in C order that shares nothing with the caller's."""
    copy = np.array(array, order="C")
    copy.setflags(write=False)
    return copy


def as_unmasked(name: str, value: ArrayLike) -> NDArray[Any]:
    """The value as an array; masked entries, whose values are unknown, are refused."""
    if hasattr(value, "mask") and np.ma.is_masked(value):
        raise CaseInputError(
            f"{name} has masked entries, whose values are unknown: fill or remove them"
        )
    return np.asarray(value)


def as_floats(name: str, value: ArrayLike) -> Floats:
    """The value as finite float64, or an error with the index at fault."""
    try:
        array = as_unmasked(name, value)
        if array.dtype.kind not in "fiu":
            raise CaseInputError(f"{name} has dtype {array.dtype}: real numbers are needed")
        array = array.astype(np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        if isinstance(error, CaseInputError):
            raise
        raise CaseInputError(f"{name} is not an array of numbers: {error}") from error
    bad = np.argwhere(~np.isfinite(array))
    if len(bad):
        index = ", ".join(str(i) for i in bad[0])
        raise CaseInputError(
            f"{name}[{index}] is {array[tuple(bad[0])]}: every value must be finite"
        )
    return array


def as_rows(name: str, value: ArrayLike, width: int) -> Floats:
    """A read-only (rows, width) float64 copy."""
    array = as_floats(name, value)
    if array.ndim != 2 or array.shape[1] != width:
        raise CaseInputError(f"{name} has shape {array.shape}: (rows, {width}) is needed")
    return frozen(array)


def as_point(name: str, value: ArrayLike) -> Floats:
    """A read-only (3,) float64 copy of a place or a direction."""
    return cast("Floats", as_rows(name, np.reshape(as_unmasked(name, value), (1, -1)), 3)[0])


def as_direction(name: str, value: ArrayLike) -> Floats:
    """A read-only unit vector along a direction of any length but zero."""
    direction = as_point(name, value)
    # The largest component first: a length below 1e-154 would underflow when squared.
    largest = float(np.abs(direction).max())
    if largest == 0.0:
        raise CaseInputError(f"{name} is (0, 0, 0): give a direction of any length")
    direction = direction / largest
    return cast("Floats", frozen(direction / np.linalg.norm(direction)))


def _whole_numbers(name: str, value: ArrayLike, count: int | None, of: str) -> Indices:
    try:
        array = as_unmasked(name, value)
    except (TypeError, ValueError) as error:
        if isinstance(error, CaseInputError):
            raise
        raise CaseInputError(f"{name} is not an array of indices: {error}") from error
    if array.size == 0:
        return np.zeros(array.shape, dtype=np.uint32)
    if array.dtype.kind not in "iu":
        raise CaseInputError(f"{name} has dtype {array.dtype}: whole numbers are needed")
    limit = 2**32 if count is None else count
    bad = np.argwhere((array < 0) | (array >= limit))
    if len(bad):
        index = ", ".join(str(i) for i in bad[0])
        allowed = f"0 to {limit - 1}" if limit else "none"
        raise CaseInputError(
            f"{name}[{index}] is {array[tuple(bad[0])]}, but there are {limit} {of} "
            f"(allowed {allowed}); is the file numbered from 1?"
        )
    return array.astype(np.uint32)


def as_index_rows(name: str, value: ArrayLike, width: int, count: int, of: str) -> Indices:
    """A read-only (rows, width) uint32 copy of indices below `count`."""
    array = _whole_numbers(name, value, count, of)
    if array.ndim != 2 or array.shape[1] != width:
        raise CaseInputError(f"{name} has shape {array.shape}: (rows, {width}) is needed")
    return frozen(array)


def as_indices(name: str, value: ArrayLike, count: int | None = None) -> Indices:
    """A read-only (k,) uint32 copy of node indices, below `count` if given."""
    array = _whole_numbers(name, value, count, "nodes")
    if array.ndim != 1:
        raise CaseInputError(f"{name} has shape {array.shape}: a list of node indices is needed")
    return frozen(array)


def as_number(name: str, value: object) -> float:
    """A finite float."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        raise CaseInputError(f"{name} is {value!r}: a number is needed")
    try:
        number = float(value)
    except OverflowError:
        raise CaseInputError(f"{name} is a whole number of more than 308 digits") from None
    if not np.isfinite(number):
        raise CaseInputError(f"{name} is {number}: must be finite")
    return number


def as_whole(
    name: str,
    value: object,
    least: int,
    most: int | None = None,
    error: type[Exception] = CaseInputError,
) -> int:
    """A whole number in a range."""
    if isinstance(value, int | np.integer) and not isinstance(value, bool):
        number = int(value)
        if number >= least and (most is None or number <= most):
            return number
    end = "on" if most is None else f"to {most}"
    raise error(f"{name} is {value!r}: a whole number from {least} {end} is needed")


def as_positive(name: str, value: object) -> float:
    """A finite float above zero."""
    number = as_number(name, value)
    if number <= 0.0:
        raise CaseInputError(f"{name} is {number:g}: must be above 0")
    return number


def as_text(name: str, value: object) -> str:
    """A text that is not empty."""
    if not isinstance(value, str) or not value:
        raise CaseInputError(f"{name} is {value!r}: a non-empty text is needed")
    return value


def check_instance(name: str, value: object, kind: type) -> None:
    """Refuses a value of another type, naming both."""
    if not isinstance(value, kind):
        found = type(value).__name__
        raise CaseInputError(f"{name} is of type {found}: a {kind.__name__} is needed")


def nearest(name: str, known: Sequence[str]) -> str:
    """A question that names the known name most like this one; empty if none is."""
    close = difflib.get_close_matches(name, known, n=1)
    return f"; did you mean {close[0]!r}?" if close else ""


def check_one_of(
    name: str, value: object, known: Sequence[str], error: type[Exception] = CaseInputError
) -> None:
    """Refuses a name that is not among the known ones."""
    if value not in known:
        raise error(f"{name} is {value!r}: use one of {', '.join(known)}")
