"""PLY, binary and text, with any elements and properties: its vertices and faces."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, BinaryIO, NoReturn, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError
from cmfsim.io.files.texts import real_numbers, shown, whole_numbers
from cmfsim.io.meshes.plain_mesh import triangles_of, triangles_of_strips
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding

Integers = NDArray[np.int64]
Column = NDArray[np.float64] | NDArray[np.int64]
# Length of a header with any number of properties and comments, bytes.
MAX_HEADER = 2**16
ORDERS = {b"binary_little_endian": "<", b"binary_big_endian": ">", b"ascii": ""}
TYPES = {
    **dict.fromkeys((b"char", b"int8"), "i1"), **dict.fromkeys((b"uchar", b"uint8"), "u1"),
    **dict.fromkeys((b"short", b"int16"), "i2"), **dict.fromkeys((b"ushort", b"uint16"), "u2"),
    **dict.fromkeys((b"int", b"int32"), "i4"), **dict.fromkeys((b"uint", b"uint32"), "u4"),
    **dict.fromkeys((b"float", b"float32"), "f4"), **dict.fromkeys((b"double", b"float64"), "f8"),
}  # fmt: skip
END = re.compile(rb"(?:^|(?<=[\r\n]))end_header[ \t]*(?:\r\n|\n|\r)")
AXES = (b"x", b"y", b"z")
CORNERS = (b"vertex_indices", b"vertex_index")
# Bytes after the last element that are a line end.
LINE_ENDS = (b"", b"\n", b"\r\n", b"\r")
# What stands between two strips of a list.
STRIP_END = -1
# Corners of the least face.
LEAST_CORNERS = 3


@dataclass(frozen=True)
class _Property:
    """A property of an element; a list where `count` is the type of its length."""

    name: bytes
    kind: str
    count: str = ""


@dataclass(frozen=True)
class _Element:
    """A kind of row of the file: how many there are, and what each holds."""

    name: str
    number: int
    properties: tuple[_Property, ...]

    def place(self, name: bytes) -> int | None:
        """The number of the property of a name; None if there is none."""
        return next((i for i, p in enumerate(self.properties) if p.name == name), None)


@dataclass(frozen=True)
class _Rows:
    """The rows of an element: a column for each property, and the lengths of its lists."""

    columns: tuple[Column | None, ...]
    lengths: tuple[Integers | None, ...]


def read_ply(data: bytes) -> tuple[Floats, Integers, tuple[Finding, ...]]:
    """The vertices (n, 3), triangles (t, 3) and findings of a file. Polygons become triangles."""
    elements, order, start = _header(data)
    names = [element.name for element in elements]
    # Scans have one list of strips in place of faces.
    kind = "tristrips" if "tristrips" in names and "face" not in names else "face"
    for name in ("vertex", kind):
        if names.count(name) != 1:
            raise CaseInputError(f"has {names.count(name)} elements {name!r}: one is needed")
    source: _Source = _Binary(data, start, order) if order else _Text(data, start)
    rows = {element.name: _rows(source, element) for element in elements}
    left = source.left()
    if left and _may_be_a_row(source, elements[-1], elements[names.index("vertex")].number):
        raise CaseInputError(
            f"holds {left} more than its header states, and they read as another "
            f"{elements[-1].name}: the header states {elements[-1].number}; export it again"
        )
    vertex, face = (elements[names.index(name)] for name in ("vertex", kind))
    axes = [_column(vertex, rows["vertex"], (axis,)) for axis in AXES]
    points = np.stack([np.asarray(column, dtype=np.float64) for column, _ in axes], axis=1)
    if not np.isfinite(points).all():
        bad = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
        raise CaseInputError(f"vertex {bad} is not finite: every coordinate must be finite")
    corners, lengths = _column(face, rows[kind], CORNERS)
    if lengths is None or corners.dtype.kind == "f":
        raise CaseInputError(
            "the corners of faces are not a list of whole numbers: "
            "'property list uchar int vertex_indices' is needed"
        )
    corners = corners.astype(np.int64)
    if kind == "face":
        triangles = triangles_of(points, lengths, corners)
    else:
        # In a list, -1 ends a strip.
        number = np.repeat(np.arange(len(lengths)), lengths) + np.cumsum(corners == STRIP_END)
        kept = corners != STRIP_END
        counts = np.unique(number[kept], return_counts=True)[1]
        triangles = triangles_of_strips(points, counts, corners[kept])
    findings: tuple[Finding, ...] = ()
    if left:
        what = (
            f"{left} after the last row were ignored: they are no row that its header could have "
            "missed"
        )
        why = "the file may have been changed after it was written"
        fix = "look at the surface; if a part is missing, export it again"
        findings = (Finding("field-ignored", what, why=why, fix=fix),)
    return points, triangles, findings


def _may_be_a_row(source: "_Source", last: _Element, n_vertices: int) -> bool:
    """Whether what follows the last element may be one more row of it, which no header counts."""
    try:
        row = _rows(source, _Element(last.name, 1, last.properties))
    except CaseInputError:
        return False
    if last.name != "face":
        return True
    corners, lengths = _column(last, row, CORNERS)
    is_face = lengths is not None and int(lengths[0]) >= LEAST_CORNERS
    return is_face and bool(((corners >= 0) & (corners < n_vertices)).all())


def write_ply(file: BinaryIO, vertices: Floats, triangles: NDArray[np.integer]) -> None:
    """Writes a surface as little-endian PLY in double precision."""
    rows = np.zeros(len(triangles), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    rows["count"] = 3
    rows["corners"] = triangles
    file.write(
        (
            "ply\nformat binary_little_endian 1.0\ncomment LPS mm\n"
            f"element vertex {len(vertices)}\n"
            "property double x\nproperty double y\nproperty double z\n"
            f"element face {len(triangles)}\n"
            "property list uchar int vertex_indices\nend_header\n"
        ).encode()
    )
    file.write(vertices.astype("<f8").tobytes())
    file.write(rows.tobytes())


def _column(
    element: _Element, rows: _Rows, names: tuple[bytes, ...]
) -> tuple[Column, Integers | None]:
    """The values of the one property that has a name among these, and the lengths of its lists."""
    places = [i for i, p in enumerate(element.properties) if p.name in names]
    if len(places) != 1:
        known = " or ".join(repr(name.decode()) for name in names)
        raise CaseInputError(
            f"element {element.name!r} has {len(places)} properties {known}: one is needed"
        )
    column, lengths = rows.columns[places[0]], rows.lengths[places[0]]
    if column is None or (lengths is not None) != bool(element.properties[places[0]].count):
        raise CaseInputError(f"element {element.name!r} cannot be read")
    if names != CORNERS and lengths is not None:
        raise CaseInputError(f"property {names[0].decode()!r} is a list: a number is needed")
    return column, lengths


def _header(data: bytes) -> tuple[list[_Element], str, int]:
    """The elements, the order of bytes (empty for text) and where the first element begins."""
    found = END.search(data, 0, MAX_HEADER) if data[:3] == b"ply" else None
    if found is None:
        raise CaseInputError("is not a PLY file, or is cut short in its header")
    end = found.end()
    lines = re.split(rb"\r\n|\n|\r", data[: found.start()])
    # Where lines end in one character, a zero byte or line feed after it belongs to the data.
    if data[end - 2 : end] == b"\r\n" and b"\r\n" not in data[: found.start()]:
        end -= 1
    order: str | None = None
    elements: list[_Element] = []
    for number, line in enumerate(lines[1:], start=2):
        words = line.split()

        def fail(why: str, number: int = number, line: bytes = line) -> NoReturn:
            raise CaseInputError(f"line {number} of the header, {shown(line)}: {why}")

        if not words or words[0] in {b"comment", b"obj_info"}:
            continue
        if words[0] == b"format":
            if order is not None or len(words) != 3 or words[2] != b"1.0":
                fail("one 'format … 1.0' is needed")
            if words[1] not in ORDERS:
                fail(f"use one of {', '.join(name.decode() for name in ORDERS)}")
            order = ORDERS[words[1]]
        elif words[0] == b"element":
            if len(words) != 3 or not re.fullmatch(rb"[0-9]{1,18}", words[2]):
                fail("a name and a number are needed")
            name = words[1].decode("ascii", "backslashreplace")
            elements.append(_Element(name, int(words[2]), ()))
        elif words[0] == b"property":
            if not elements:
                fail("comes before the first element")
            found_property = _property(words)
            if found_property is None:
                fail(f"types are {', '.join(name.decode() for name in TYPES)}")
            last = elements[-1]
            if last.place(found_property.name) is not None:
                fail("appears a second time")
            elements[-1] = _Element(last.name, last.number, (*last.properties, found_property))
        else:
            fail("is not known in PLY")
    if order is None or lines[0].strip() != b"ply":
        raise CaseInputError("is not a PLY file: its header lacks 'ply' or 'format'")
    return elements, order, end


def _property(words: list[bytes]) -> _Property | None:
    if len(words) == 3 and words[1] in TYPES:
        return _Property(words[2], TYPES[words[1]])
    if len(words) == 5 and words[1] == b"list" and words[2] in TYPES and words[3] in TYPES:
        count = TYPES[words[2]]
        return _Property(words[4], TYPES[words[3]], count) if count[0] != "f" else None
    return None


def _rows(source: "_Source", element: _Element) -> _Rows:
    """The rows of the next element."""
    if not element.number or not element.properties:
        return _Rows(
            tuple(_values(p, [], str) for p in element.properties),
            tuple(np.zeros(0, dtype=np.int64) if p.count else None for p in element.properties),
        )
    # Usually every list has the length of the first row's: then all rows are alike.
    lengths, after = list[int | None](), source.at
    for prop in element.properties:
        length = None
        if prop.count:
            length, after = source.length(element, prop, after, 0)
        lengths.append(length)
        after += source.width(prop) * (1 if length is None else length)
    width = after - source.at
    if source.at + element.number * width <= source.end:
        columns = source.alike(element, lengths)
        if columns is not None:
            source.at += element.number * width
            counts = (None if n is None else np.full(element.number, n) for n in lengths)
            return _Rows(tuple(columns), tuple(counts))
    if all(length is None for length in lengths):
        _short(element, (source.end - source.at) // width)
    return _one_by_one(source, element)


def _one_by_one(source: "_Source", element: _Element) -> _Rows:
    places: list[list[slice]] = [[] for _ in element.properties]
    lengths: list[list[int]] = [[] for _ in element.properties]
    for row in range(element.number):
        for i, prop in enumerate(element.properties):
            length = 1
            if prop.count:
                length, source.at = source.length(element, prop, source.at, row)
                lengths[i].append(length)
            place = slice(source.at, source.at + length * source.width(prop))
            if place.stop > source.end:
                _short(element, row)
            places[i].append(place)
            source.at = place.stop
    return _Rows(
        tuple(source.column(element, i, of) for i, of in enumerate(places)),
        tuple(
            np.array(n, dtype=np.int64) if p.count else None
            for n, p in zip(lengths, element.properties, strict=True)
        ),
    )


def _short(element: _Element, row: int) -> NoReturn:
    raise CaseInputError(
        f"is cut short or damaged: its header states {element.number} of element "
        f"{element.name!r}, the file ends in number {row}; copy or export it again"
    )


class _Binary:
    """Elements in bytes."""

    def __init__(self, data: bytes, start: int, order: str) -> None:
        self.data, self.at, self.end, self.order = data, start, len(data), order

    def left(self) -> str:
        """What no element takes, in words; empty if there is nothing but a line end."""
        left = self.end - self.at
        return "" if self.data[self.at : self.at + 3] in LINE_ENDS else f"{left} bytes"

    def width(self, prop: _Property) -> int:
        """What a number takes."""
        return np.dtype(prop.kind).itemsize

    def length(self, element: _Element, prop: _Property, at: int, row: int) -> tuple[int, int]:
        """The length of a list, and where its entries begin; they are all there."""
        after = at + np.dtype(prop.count).itemsize
        if after > self.end:
            _short(element, row)
        length = int(np.frombuffer(self.data[at:after], self.order + prop.count)[0])
        if length < 0:
            raise CaseInputError(f"{element.name} {row} has a list of length {length}")
        if after + length * self.width(prop) > self.end:
            _short(element, row)
        return length, after

    def alike(self, element: _Element, lengths: list[int | None]) -> list[Column] | None:
        """The columns if all lists are as long as those of the first row; None if they are not."""
        fields: list[Any] = []
        for i, (prop, n) in enumerate(zip(element.properties, lengths, strict=True)):
            fields += [] if n is None else [(f"n{i}", self.order + prop.count)]
            fields.append((f"v{i}", self.order + prop.kind, () if n is None else (n,)))
        table = np.frombuffer(self.data, np.dtype(fields), element.number, self.at)
        if not all((table[f"n{i}"] == n).all() for i, n in enumerate(lengths) if n is not None):
            return None
        return [_wide(table[f"v{i}"].reshape(-1)) for i in range(len(lengths))]

    def column(self, element: _Element, number: int, places: list[slice]) -> Column:
        """The values of a property at some places."""
        raw = b"".join(self.data[place] for place in places)
        return _wide(np.frombuffer(raw, self.order + element.properties[number].kind))


class _Text:
    """Elements in words."""

    def __init__(self, data: bytes, start: int) -> None:
        self.words, self.at = data[start:].split(), 0
        self.end = len(self.words)

    def left(self) -> str:
        """What no element takes, in words; empty if there is nothing."""
        left = self.end - self.at
        return f"{left} words" if left else ""

    def width(self, _: _Property) -> int:
        """What a number takes: a word."""
        return 1

    def length(self, element: _Element, _: _Property, at: int, row: int) -> tuple[int, int]:
        """The length of a list, and where its entries begin; they are all there."""
        if at >= self.end:
            _short(element, row)
        length = int(whole_numbers([self.words[at]], lambda _: f"{element.name} {row}")[0])
        if not 0 <= length <= self.end - at - 1:
            raise CaseInputError(
                f"{element.name} {row} has a list of length {length}, and "
                f"{self.end - at - 1} numbers are left: is it cut short?"
            )
        return length, at + 1

    def alike(self, element: _Element, lengths: list[int | None]) -> list[Column] | None:
        """The columns if all lists are as long as those of the first row; None if they are not."""
        width = sum(1 if n is None else 1 + n for n in lengths)
        words = self.words[self.at : self.at + element.number * width]
        columns: list[Column] = []
        place = 0
        for prop, length in zip(element.properties, lengths, strict=True):
            if length is not None:
                if set(words[place::width]) != {words[place]}:
                    return None
                place += 1
            count = 1 if length is None else length
            parts = [
                _values(prop, words[place + i :: width], f"{element.name} {{}}".format)
                for i in range(count)
            ]
            table: NDArray[Any] = np.stack(parts, axis=1) if parts else _values(prop, [], str)
            columns.append(table.reshape(-1))
            place += count
        return columns

    def column(self, element: _Element, number: int, places: list[slice]) -> Column:
        """The values of a property at some places."""
        words = [word for place in places for word in self.words[place]]
        return _values(element.properties[number], words, lambda _: f"element {element.name!r}")


# What elements are read from; each has a place and an end, in bytes or in words.
_Source: TypeAlias = _Binary | _Text


def _values(prop: _Property, words: list[bytes], where: Callable[[int], str]) -> Column:
    if prop.kind[0] == "f":
        return real_numbers(words, where, prop.kind)
    return whole_numbers(words, where)


def _wide(values: NDArray[np.generic]) -> Column:
    return values.astype(np.float64) if values.dtype.kind == "f" else values.astype(np.int64)
