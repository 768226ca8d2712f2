"""A place in a file of lines and blocks of numbers, as legacy VTK and Gmsh write them."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError
from cmfsim.io.files.text_numbers import real_numbers, whole_numbers

# A line with a keyword is no longer than this, bytes.
MAX_LINE = 2**12


class Cursor:
    """A place in a file, which moves on with what is read.

    Attributes
    ----------
    data : bytes
    at : int
        Where the next line or block begins.
    order : str
        "<" or ">" where numbers are bytes, empty where they are words.
    """

    def __init__(self, data: bytes) -> None:
        self.data, self.at, self.order = data, 0, ""

    def line(self) -> str | None:
        """The next line that is not empty, without white space round it; None at the end."""
        while self.at < len(self.data):
            text = self.raw_line().strip()
            if text:
                return text
        return None

    def raw_line(self) -> str:
        """The next line, empty or not."""
        end = self.data.find(b"\n", self.at)
        end = len(self.data) if end < 0 else end
        if end - self.at > MAX_LINE:
            raise CaseInputError(f"has a line of {end - self.at} bytes: is it damaged?")
        text = self.data[self.at : end].decode("utf-8", "backslashreplace")
        self.at = end + 1
        return text

    def numbers(self, kind: str, count: int, what: str) -> NDArray[Any]:
        """The next numbers: float64 for a kind of float, else int64.

        Parameters
        ----------
        kind : str
            numpy's name of the type that the file holds: "f4", "i8".
        count : int
        what : str
            What they are, for errors.

        Raises
        ------
        CaseError
            (also `ValueError`) Fewer than that many are left, or one is none.
        """
        wide = np.float64 if kind[0] == "f" else np.int64
        if self.order:
            dtype = np.dtype(self.order + kind)
            size = count * dtype.itemsize
            if self.at + size > len(self.data):
                self._short(what, (len(self.data) - self.at) // dtype.itemsize, count)
            block = np.frombuffer(self.data, dtype, count, self.at)
            if dtype.kind == "u" and count and int(block.max()) >= 2**63:
                raise CaseInputError(f"{what}: {block.max()} is too large")
            self.at += size
            return block.astype(wide)
        words = self._words(count, what)
        where = f"{what} {{}}".format
        return real_numbers(words, where, kind) if kind[0] == "f" else whole_numbers(words, where)

    def _words(self, count: int, what: str) -> list[bytes]:
        words: list[bytes] = []
        while len(words) < count:
            if self.at >= len(self.data):
                self._short(what, len(words), count)
            # As many characters as the rest needs at least, up to the end of a line.
            end = self.data.find(b"\n", min(len(self.data), self.at + 2 * (count - len(words)) - 1))
            end = len(self.data) if end < 0 else end
            words += self.data[self.at : end].split()
            self.at = end + 1
        if len(words) > count:
            raise CaseInputError(f"{what}: more than {count} numbers were found")
        return words

    def _short(self, what: str, found: int, count: int) -> None:
        raise CaseInputError(
            f"is cut short or damaged: {count} numbers are stated for {what}, {found} are left"
        )
