"""Numbers from the words of a text file: all of them, or an error that names the first bad one."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError
from cmfsim.values.checks import Floats

# Characters of a word that an error repeats.
SHOWN = 40


def real_numbers(words: Sequence[bytes], where: Callable[[int], str], kind: str = "f8") -> Floats:
    """Words as finite float64, one for one.

    where: The place of a word, by its index, as an error names it: "line 3".
    kind: "f4" where the file states single precision: numbers become those that it can hold.
    Returns: (n,).
    Raises `CaseError`: A word that is no number, NaN or infinity.
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
    """Words as int64, one for one.

    where: The place of a word, by its index, as an error names it.
    Returns: (n,) int64.
    Raises `CaseError`: A word that is no whole number, or one beyond 64 bits.
    """
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
