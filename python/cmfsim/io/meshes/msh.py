"""Gmsh's files (`.msh`) of versions 2.2 and 4.1, in words or bytes: read only.

Nodes and elements carry numbers of their own, in any order; an element that names a node that is
not there is refused.
"""

import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError
from cmfsim.io.files.texts import real_numbers, whole_numbers
from cmfsim.io.meshes.plain_mesh import Cells, PlainMesh

# A line with a keyword is no longer than this, bytes.
MAX_LINE = 2**12

Integers = NDArray[np.int64]
# Gmsh's numbers of elements (its manual, MSH file format): name, number of nodes.
ELEMENTS = {
    1: ("line", 2), 2: ("triangle", 3), 3: ("quad", 4), 4: ("tetra", 4), 5: ("hexahedron", 8),
    6: ("wedge", 6), 7: ("pyramid", 5), 8: ("line3", 3), 9: ("triangle6", 6), 11: ("tetra10", 10),
    15: ("vertex", 1),
}  # fmt: skip

WHOLE = re.compile(r"-?[0-9]{1,18}")


class Cursor:
    """A place in a file, where the next line or block begins; it moves on with what is read.

    order: "<" or ">" where numbers are bytes, empty where they are words.
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
        """The next numbers: float64 for a kind of float, else int64; `what` they are, for errors.

        kind: numpy's name of the type that the file holds: "f4", "i8".
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


class _Nodes(NamedTuple):
    """Nodes by their number in the file."""

    tags: Integers
    points: NDArray[np.float64]


class _Values(NamedTuple):
    """Values of nodes or elements by their number."""

    name: str
    tags: Integers
    values: NDArray[np.float64]


def read_msh(data: bytes) -> PlainMesh:
    """The mesh of a file.

    Raises `CaseError`: Not such a file, another version, a section that does not end, fewer or more
        nodes or elements than stated, a number twice, a node that is not there.
    """
    return _Reader(data).mesh()


class _Reader:
    """A file, section by section."""

    def __init__(self, data: bytes) -> None:
        self.file = Cursor(data)
        self.version = ""
        self.nodes: _Nodes | None = None
        self.elements: dict[int, tuple[Integers, Integers]] | None = None
        self.node_values: list[_Values] = []
        self.element_values: list[_Values] = []

    def mesh(self) -> PlainMesh:
        """What the file holds."""
        self._format()
        while (line := self.file.line()) is not None:
            if not re.fullmatch(r"\$[A-Za-z]{1,40}", line):
                raise CaseInputError(f"has the line {line[:40]!r} between its sections")
            name = line[1:]
            new = self.version == "4.1"
            if name == "Nodes":
                self._once(self.nodes, name)
                self.nodes = self._nodes_4() if new else self._nodes_2()
            elif name == "Elements":
                self._once(self.elements, name)
                self.elements = self._elements_4() if new else self._elements_2()
            elif name in {"NodeData", "ElementData"}:
                values = self._values(name)
                (self.node_values if name == "NodeData" else self.element_values).append(values)
            else:
                self._skip(name)
                continue
            self._close(name)
        if self.nodes is None or self.elements is None:
            raise CaseInputError("has no $Nodes or no $Elements: is it cut short?")
        return self._joined(self.nodes, self.elements)

    def _joined(self, nodes: _Nodes, elements: dict[int, tuple[Integers, Integers]]) -> PlainMesh:
        order = _order(nodes.tags, "node")
        blocks, tags = list[Cells](), list[Integers]()
        for kind, (numbers, corners) in elements.items():
            name = ELEMENTS[kind][0]
            blocks.append(Cells(name, _places(nodes.tags, order, corners, f"{name} {{}}")))
            tags.append(numbers)
        point_data = {}
        for given in self.node_values:
            where = _places(nodes.tags, order, given.tags, f"{given.name!r} row {{}}")
            if len(np.unique(where)) != len(nodes.tags):
                raise CaseInputError(
                    f"{given.name!r} has values for {len(np.unique(where))} of {len(nodes.tags)} "
                    "nodes"
                )
            values = np.empty_like(given.values)
            values[where] = given.values
            point_data[given.name] = values
        cell_data = {}
        for given in self.element_values:
            at = _order(given.tags, f"{given.name!r}: element")
            cell_data[given.name] = tuple(_values_of(given, at, numbers) for numbers in tags)
        return PlainMesh(nodes.points, tuple(blocks), point_data, cell_data)

    def _format(self) -> None:
        file = self.file
        if file.line() != "$MeshFormat":
            raise CaseInputError("is not a Gmsh file: $MeshFormat is its first line")
        words = (file.line() or "").split()
        if len(words) != 3 or words[0] not in {"2.2", "4.1"} or words[1] not in {"0", "1"}:
            raise CaseInputError(
                f"has the format {' '.join(words)[:40]!r}: version 2.2 or 4.1 is read "
                "(gmsh in.msh -save -format msh41)"
            )
        if words[2] != "8":
            raise CaseInputError(f"has numbers of {words[2][:20]} bytes: 8 are read")
        self.version = words[0]
        if words[1] == "1":
            one = file.data[file.at : file.at + 4]
            if one not in {b"\1\0\0\0", b"\0\0\0\1"}:
                raise CaseInputError("is cut short or damaged after its format")
            file.order = "<" if one[0] else ">"
            file.at += 4
        self._close("MeshFormat")

    def _nodes_2(self) -> _Nodes:
        n = self._count("$Nodes")
        if self.file.order:
            rows = self._table([("tag", "i4"), ("x", "f8", (3,))], n, "$Nodes")
            return _Nodes(rows["tag"].astype(np.int64), rows["x"].astype(np.float64))
        rows = self.file.numbers("f8", 4 * n, "$Nodes").reshape(n, 4)
        if (rows[:, 0] % 1 != 0).any() or (np.abs(rows[:, 0]) >= 2**53).any():
            raise CaseInputError("a node has a number that is not whole")
        return _Nodes(rows[:, 0].astype(np.int64), rows[:, 1:].copy())

    def _nodes_4(self) -> _Nodes:
        n_blocks, n, *_ = self._sizes(4, "$Nodes")
        tags, points = [np.zeros(0, np.int64)], [np.zeros((0, 3))]
        for _ in range(n_blocks):
            dim, _, parametric, count = self._block_head("$Nodes")
            tags.append(self.file.numbers("i8", count, "numbers of nodes"))
            width = 3 + (dim if parametric else 0)
            block = self.file.numbers("f8", width * count, "$Nodes").reshape(count, width)
            points.append(block[:, :3])
        found = _Nodes(np.concatenate(tags), np.concatenate(points))
        if len(found.tags) != n:
            raise CaseInputError(f"$Nodes states {n} nodes, its blocks hold {len(found.tags)}")
        return found

    def _elements_2(self) -> dict[int, tuple[Integers, Integers]]:
        n = self._count("$Elements")
        found: dict[int, list[tuple[Integers, Integers]]] = {}
        if not self.file.order:
            for kind, lines in self._element_lines(n).items():
                table = np.array(lines, dtype=np.int64)
                found[kind] = [(table[:, 0], table[:, 1:])]
            return _concatenated(found, n)
        done = 0
        while done < n:
            kind, count, n_tags = self.file.numbers("i4", 3, "$Elements").tolist()
            size = self._size(kind)
            if count < 1 or not 0 <= n_tags <= len(self.file.data):
                raise CaseInputError(f"$Elements has a block of {count} elements")
            width = 1 + n_tags + size
            rows = self.file.numbers("i4", count * width, "$Elements").reshape(count, width)
            found.setdefault(kind, []).append((rows[:, 0], rows[:, 1 + n_tags :]))
            done += count
        return _concatenated(found, n)

    def _element_lines(self, n: int) -> dict[int, list[list[int]]]:
        """The number and nodes of each element of a file in words, by kind."""
        found: dict[int, list[list[int]]] = {}
        for done in range(n):
            words = (self.file.line() or "").split()
            if len(words) < 3 or not all(map(WHOLE.fullmatch, words)):
                raise CaseInputError(
                    f"$Elements states {n} elements; number {done} is {' '.join(words)[:40]!r}"
                )
            row = [int(word) for word in words]
            needed = 3 + max(row[2], 0) + self._size(row[1])
            if len(row) != needed:
                raise CaseInputError(
                    f"element {row[0]} has {len(row)} numbers: {needed} are needed"
                )
            found.setdefault(row[1], []).append([row[0], *row[3 + max(row[2], 0) :]])
        return found

    def _elements_4(self) -> dict[int, tuple[Integers, Integers]]:
        n_blocks, n, *_ = self._sizes(4, "$Elements")
        found: dict[int, list[tuple[Integers, Integers]]] = {}
        for _ in range(n_blocks):
            _, _, kind, count = self._block_head("$Elements")
            width = 1 + self._size(kind)
            rows = self.file.numbers("i8", count * width, "$Elements").reshape(count, width)
            found.setdefault(kind, []).append((rows[:, 0], rows[:, 1:]))
        return _concatenated(found, n)

    def _values(self, name: str) -> _Values:
        labels = [self.file.line() or "" for _ in range(self._count(name))]
        for _ in range(self._count(name)):
            self.file.line()
        whole = [self.file.line() or "" for _ in range(self._count(name))]
        if not labels or len(whole) < 3 or not all(re.fullmatch("[0-9]{1,18}", w) for w in whole):
            raise CaseInputError(f"${name} lacks its name, or its count of values")
        width, n = int(whole[1]), int(whole[2])
        if self.file.order:
            if not 0 < width <= len(self.file.data):
                raise CaseInputError(f"${name} has {width} values in a row")
            rows = self._table([("tag", "i4"), ("v", "f8", (width,))], n, name)
            tags, values = rows["tag"].astype(np.int64), rows["v"].astype(np.float64)
        else:
            table = self.file.numbers("f8", n * (1 + width), name).reshape(n, 1 + width)
            tags, values = table[:, 0].astype(np.int64), table[:, 1:]
            if (tags != table[:, 0]).any():
                raise CaseInputError(f"${name} has a number that is not whole")
        label = labels[0].strip('"')
        return _Values(label, tags, values[:, 0] if width == 1 else values)

    def _table(self, fields: Sequence[Any], n: int, what: str) -> NDArray[Any]:
        dtype = np.dtype([(f[0], self.file.order + f[1], *f[2:]) for f in fields])
        left = len(self.file.data) - self.file.at
        if n * dtype.itemsize > left:
            raise CaseInputError(
                f"is cut short or damaged: {what} states {n} rows, {left // dtype.itemsize} are "
                "left"
            )
        table = np.frombuffer(self.file.data, dtype, n, self.file.at)
        self.file.at += n * dtype.itemsize
        return table

    def _sizes(self, count: int, what: str) -> list[int]:
        sizes = [int(v) for v in self.file.numbers("i8", count, what).tolist()]
        if min(sizes) < 0:
            raise CaseInputError(f"{what} begins with {sizes}: numbers from 0 on are needed")
        return sizes

    def _block_head(self, what: str) -> tuple[int, int, int, int]:
        if not self.file.order:
            a, b, c, count = self.file.numbers("i8", 4, what).tolist()
        else:
            a, b, c = self.file.numbers("i4", 3, what).tolist()
            (count,) = self.file.numbers("i8", 1, what).tolist()
        if not 0 <= count <= len(self.file.data) or not 0 <= a <= 3:
            raise CaseInputError(f"{what} has a block of {count} in {a} dimensions")
        return a, b, c, count

    def _count(self, what: str) -> int:
        line = self.file.line() or ""
        if not re.fullmatch("[0-9]{1,18}", line):
            raise CaseInputError(f"{what} has {line[:40]!r} where a number is needed")
        return int(line)

    def _size(self, kind: int) -> int:
        if kind not in ELEMENTS:
            raise CaseInputError(f"has elements of Gmsh's type {kind}, which is not supported")
        return ELEMENTS[kind][1]

    def _close(self, name: str) -> None:
        line = self.file.line()
        if line != f"$End{name}":
            found = "the end of the file" if line is None else repr(line[:40])
            raise CaseInputError(f"has {found} where $End{name} is needed: is it damaged?")

    def _skip(self, name: str) -> None:
        end = self.file.data.find(f"\n$End{name}".encode(), self.file.at - 1)
        if end < 0:
            raise CaseInputError(f"is cut short or damaged: ${name} does not end")
        self.file.at = end + 1
        self.file.raw_line()

    def _once(self, value: object, name: str) -> None:
        if value is not None:
            raise CaseInputError(f"has ${name} twice")


def _concatenated(
    found: dict[int, list[tuple[Integers, Integers]]], n: int
) -> dict[int, tuple[Integers, Integers]]:
    held = sum(len(numbers) for parts in found.values() for numbers, _ in parts)
    if held != n:
        raise CaseInputError(f"$Elements states {n} elements, its blocks hold {held}")
    return {
        kind: (np.concatenate([t for t, _ in parts]), np.concatenate([c for _, c in parts]))
        for kind, parts in found.items()
    }


def _order(tags: Integers, what: str) -> Integers:
    """The order in which numbers rise, if none stands twice."""
    order = np.argsort(tags, kind="stable")
    again = np.flatnonzero(np.diff(tags[order]) == 0)
    if len(again):
        raise CaseInputError(f"{what} {tags[order][again[0]]} appears twice")
    return order


def _places(tags: Integers, order: Integers, wanted: Integers, what: str) -> Integers:
    """Where in `tags` each wanted number stands."""
    if not len(tags):
        raise CaseInputError("has no nodes")
    at = np.searchsorted(tags, wanted, sorter=order)
    found = order[np.minimum(at, len(tags) - 1)]
    bad = np.argwhere(tags[found] != wanted)
    if len(bad):
        number = wanted[tuple(bad[0])]
        raise CaseInputError(
            f"{what.format(bad[0][0])} refers to node {number}, which does not exist"
        )
    return found


def _values_of(given: _Values, order: Integers, numbers: Integers) -> NDArray[np.float64]:
    """Values of elements by their number; NaN where the file gives none."""
    values = np.full((len(numbers), *given.values.shape[1:]), np.nan)
    if not len(given.tags):
        return values
    at = np.minimum(np.searchsorted(given.tags, numbers, sorter=order), len(given.tags) - 1)
    found = order[at]
    there = given.tags[found] == numbers
    values[there] = given.values[found[there]]
    return values
