"""VTK's files before XML (`.vtk`), in words or bytes: surfaces and volumes, read only."""

import re
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError
from cmfsim.io.plain_mesh import Cells, PlainMesh
from cmfsim.io.polygons import triangles_of
from cmfsim.io.stated_frames import stated_frame
from cmfsim.io.text_cursor import Cursor
from cmfsim.io.vtk_cells import cells_by_type

__all__ = ["read_vtk_legacy"]

Integers = NDArray[np.int64]
HEADER = re.compile(r"# vtk DataFile Version [0-9]+\.[0-9]+")
DATASETS = ("POLYDATA", "UNSTRUCTURED_GRID")
TYPES = {
    "unsigned_char": "u1",
    "char": "i1",
    "unsigned_short": "u2",
    "short": "i2",
    "unsigned_int": "u4",
    "int": "i4",
    "vtkidtype": "i4",
    "unsigned_long": "u8",
    "long": "i8",
    "vtktypeint64": "i8",
    "vtktypeuint64": "u8",
    "vtktypeint32": "i4",
    "vtktypeuint32": "u4",
    "float": "f4",
    "double": "f8",
}
# Groups of cells of a surface; the first three lie on no face.
GROUPS = ("VERTICES", "LINES", "TRIANGLE_STRIPS", "POLYGONS")
# Arrays of a fixed number of components.
WIDTHS = {"VECTORS": 3, "NORMALS": 3, "TENSORS": 9, "TENSORS6": 6, "GLOBAL_IDS": 1}


def read_vtk_legacy(data: bytes) -> PlainMesh:
    """The mesh of a file; polygons of a surface become triangles.

    Raises
    ------
    CaseError
        (also `ValueError`) Not such a file, another kind of data, a keyword that is not known,
        fewer or more numbers than stated, an index that is not there.
    """
    return _Reader(data).mesh()


class _Reader:
    """A file, keyword by keyword."""

    def __init__(self, data: bytes) -> None:
        self.file = Cursor(data)
        self.points: NDArray[np.float64] | None = None
        self.groups: dict[str, tuple[Integers, Integers]] = {}
        self.types: Integers | None = None
        self.data: dict[str, dict[str, NDArray[Any]]] = {"POINT_DATA": {}, "CELL_DATA": {}}
        self.where, self.rows = "", 0
        self.frame = stated_frame(data, ".vtk")

    def mesh(self) -> PlainMesh:
        """What the file holds."""
        file = self.file
        if not HEADER.fullmatch(file.raw_line().strip()):
            raise CaseInputError("is not a VTK file: '# vtk DataFile Version' is its first line")
        file.raw_line()
        form = file.raw_line().strip().upper()
        if form not in {"ASCII", "BINARY"}:
            raise CaseInputError(f"is {form!r}: ASCII or BINARY is needed")
        file.order = ">" if form == "BINARY" else ""
        kind = self._words(file.line() or "", 2)
        if kind[0] != "DATASET" or kind[1] not in DATASETS:
            raise CaseInputError(f"holds {' '.join(kind)!r}: DATASET {' or '.join(DATASETS)}")
        known: dict[str, Callable[[list[str]], None]] = {
            "POINTS": self._points,
            "CELLS": self._cells,
            "CELL_TYPES": self._types,
            "POINT_DATA": self._begin,
            "CELL_DATA": self._begin,
            "SCALARS": self._scalars,
            "FIELD": self._field,
            "TEXTURE_COORDINATES": self._texture,
            "LOOKUP_TABLE": self._table,
            "METADATA": self._metadata,
            **dict.fromkeys(GROUPS, self._cells),
            **dict.fromkeys(WIDTHS, self._array),
        }
        while (line := file.line()) is not None:
            words = line.split()
            if words[0].upper() not in known:
                raise CaseInputError(f"{words[0][:40]!r} is not known in a VTK file")
            known[words[0].upper()]([words[0].upper(), *words[1:]])
        if self.points is None:
            raise CaseInputError("has no POINTS: is it cut short?")
        surface = kind[1] == "POLYDATA"
        return self._surface(self.points) if surface else self._volume(self.points)

    def _surface(self, points: NDArray[np.float64]) -> PlainMesh:
        if "TRIANGLE_STRIPS" in self.groups:
            raise CaseInputError("has triangle strips: turn them into triangles before it is saved")
        corners, counts = self.groups.get("POLYGONS", (np.zeros(0, np.int64),) * 2)
        if not len(counts):
            return PlainMesh(points, (), self.data["POINT_DATA"], frame=self.frame)
        triangles = triangles_of(points, counts, corners)
        cells = (Cells("triangle", triangles),)
        return PlainMesh(points, cells, self.data["POINT_DATA"], frame=self.frame)

    def _volume(self, points: NDArray[np.float64]) -> PlainMesh:
        corners, counts = self.groups.get("CELLS", (np.zeros(0, np.int64),) * 2)
        if self.types is None or len(self.types) != len(counts):
            found = "none" if self.types is None else len(self.types)
            raise CaseInputError(
                f"has {len(counts)} cells, and types for {found}: is it cut short?"
            )
        blocks, rows = cells_by_type(self.types, counts, corners)
        cell_data = {
            name: tuple(values[mine] for mine in rows)
            for name, values in self.data["CELL_DATA"].items()
        }
        return PlainMesh(points, blocks, self.data["POINT_DATA"], cell_data)

    def _points(self, words: list[str]) -> None:
        _, count, kind = self._words(" ".join(words), 3)
        if self.points is not None:
            raise CaseInputError("has POINTS twice")
        n = _count(count)
        self.points = self._numbers(kind, 3 * n, "POINTS").astype(np.float64).reshape(n, 3)

    def _cells(self, words: list[str]) -> None:
        name, first, second = self._words(" ".join(words), 3)
        if name in self.groups:
            raise CaseInputError(f"has {name} twice")
        n, size = _count(first), _count(second)
        before = self.file.at
        line = self.file.line() if n else ""
        if line is not None and line.startswith("OFFSETS"):
            ends = self._numbers(self._words(line, 2)[1], n, f"{name} OFFSETS")
            line = self.file.line() or ""
            if not line.startswith("CONNECTIVITY"):
                raise CaseInputError(f"{name} has no CONNECTIVITY")
            corners = self._numbers(self._words(line, 2)[1], size, f"{name} CONNECTIVITY")
            if ends[0] != 0 or ends[-1] != size or (np.diff(ends) < 0).any():
                raise CaseInputError(f"{name} OFFSETS do not rise from 0 to {size}")
            self.groups[name] = (corners, np.diff(ends))
            return
        self.file.at = before
        self.groups[name] = _rows(name, self.file.numbers("i4", size, name), n)

    def _types(self, words: list[str]) -> None:
        n = _count(self._words(" ".join(words), 2)[1])
        self.types = self.file.numbers("i4", n, "CELL_TYPES")

    def _begin(self, words: list[str]) -> None:
        self.where, self.rows = words[0], _count(self._words(" ".join(words), 2)[1])
        n_cells = sum(len(counts) for _, counts in self.groups.values())
        needed = n_cells if self.where == "CELL_DATA" else len(self._known_points())
        if self.rows != needed:
            raise CaseInputError(f"{self.where} has {self.rows} rows: {needed} are needed")

    def _scalars(self, words: list[str]) -> None:
        width = _count(words[3]) if len(words) > 3 else 1
        kind = self._words(" ".join(words[:3]), 3)[2]
        before = self.file.at
        # The name of a table of colours stands between in most files.
        if not (self.file.line() or "").upper().startswith("LOOKUP_TABLE"):
            self.file.at = before
        self._keep(words[1], kind, width, self.rows)

    def _array(self, words: list[str]) -> None:
        name, label, kind = self._words(" ".join(words), 3)
        self._keep(label, kind, WIDTHS[name], self.rows)

    def _texture(self, words: list[str]) -> None:
        _, label, width, kind = self._words(" ".join(words), 4)
        self._keep(label, kind, _count(width), self.rows)

    def _field(self, words: list[str]) -> None:
        for _ in range(_count(self._words(" ".join(words), 3)[2])):
            line = self.file.line()
            while line is not None and line.upper().startswith("METADATA"):
                self._metadata([])
                line = self.file.line()
            if line is None:
                raise CaseInputError("is cut short or damaged: a FIELD lacks an array")
            label, width, rows, kind = self._words(line, 4)
            # A field before the points belongs to the file, not to its points or cells.
            if self.where and _count(rows) != self.rows:
                raise CaseInputError(f"field {label!r} has {rows} rows: {self.rows} are needed")
            self._keep(label, kind, _count(width), _count(rows))

    def _keep(self, label: str, kind: str, width: int, rows: int) -> None:
        values = self._numbers(kind, rows * width, repr(label))
        if not self.where:
            return
        if label in self.data[self.where]:
            raise CaseInputError(f"{self.where} has two arrays {label!r}")
        self.data[self.where][label] = values if width == 1 else values.reshape(rows, width)

    def _table(self, words: list[str]) -> None:
        n = _count(self._words(" ".join(words), 3)[2])
        self.file.numbers("u1" if self.file.order else "f4", 4 * n, "LOOKUP_TABLE")

    def _metadata(self, words: list[str]) -> None:
        del words
        while self.file.at < len(self.file.data) and self.file.raw_line().strip():
            pass

    def _numbers(self, kind: str, count: int, what: str) -> NDArray[Any]:
        if kind.lower() not in TYPES:
            raise CaseInputError(f"{what} has type {kind[:40]!r}: {', '.join(TYPES)} are read")
        return self.file.numbers(TYPES[kind.lower()], count, what)

    def _known_points(self) -> NDArray[np.float64]:
        if self.points is None:
            raise CaseInputError("has POINT_DATA before POINTS")
        return self.points

    def _words(self, line: str, count: int) -> Sequence[str]:
        words = line.split()
        if len(words) != count:
            raise CaseInputError(f"has the line {line[:60]!r}: {count} words are needed")
        return words


def _count(word: str) -> int:
    if not re.fullmatch(r"[0-9]{1,18}", word, re.ASCII):
        raise CaseInputError(f"has {word[:40]!r} where a number from 0 on is needed")
    return int(word)


def _rows(name: str, numbers: Integers, n: int) -> tuple[Integers, Integers]:
    """Corners and counts of rows that each begin with their count."""
    if n and len(numbers) % n == 0 and len(numbers):
        table = numbers.reshape(n, -1)
        if (table[:, 0] == table.shape[1] - 1).all():
            return table[:, 1:].reshape(-1), table[:, 0].copy()
    counts, at, values = list[int](), 0, numbers.tolist()
    keep = np.ones(len(numbers), dtype=bool)
    for row in range(n):
        if at >= len(values) or not 0 <= values[at] < len(values) - at:
            raise CaseInputError(f"{name} {row} does not fit into the {len(values)} numbers stated")
        counts.append(values[at])
        keep[at] = False
        at += 1 + values[at]
    if at != len(values):
        raise CaseInputError(f"{name} states {len(values)} numbers, its {n} rows take {at}")
    return numbers[keep], np.array(counts, dtype=np.int64)
