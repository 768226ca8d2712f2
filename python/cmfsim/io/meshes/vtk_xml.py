"""VTK's XML files of surfaces (`.vtp`) and volumes (`.vtu`), read; `vtk_writing` writes them.

VTK's own reader takes the process down for some damaged files and goes on with what is there for
others. Here every array must have the length that the counts of its piece ask for.
"""

import base64
import binascii
import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError
from cmfsim.io.files.reading_writing import walk_xml
from cmfsim.io.files.texts import real_numbers, whole_numbers
from cmfsim.io.meshes.plain_mesh import (
    Cells,
    PlainMesh,
    cells_by_type,
    stated_in_field,
    triangles_of,
    triangles_of_strips,
)
from cmfsim.io.meshes.vtk_writing import UNPACKERS

# Nested elements and all elements that a file may have; VTK nests eight.
MAX_DEPTH, MAX_ELEMENTS = 32, 100_000
MAX_COMPONENTS = 1000
# Characters of "LPS" or "RAS" with the zero that ends a text.
FRAME_CODES = 4
APPENDED = re.compile(rb"<AppendedData\s+encoding\s*=\s*[\"'](raw|base64)[\"']\s*>\s*_")
APPENDED_END = b"</AppendedData>"
ORDERS = {"LittleEndian": "<", "BigEndian": ">"}
HEADERS = {"UInt32": "u4", "UInt64": "u8"}
TYPES = {
    **{f"Int{bits}": f"i{bits // 8}" for bits in (8, 16, 32, 64)},
    **{f"UInt{bits}": f"u{bits // 8}" for bits in (8, 16, 32, 64)},
    "Float32": "f4",
    "Float64": "f8",
}
SPACE = b" \t\r\n"
Integers = NDArray[np.int64]


@dataclass
class _Element:
    """An element of the XML text."""

    name: str
    attributes: Mapping[str, str]
    children: list["_Element"] = field(default_factory=list)
    text: list[str] = field(default_factory=list)

    def all(self, name: str) -> list["_Element"]:
        """The children of a name."""
        return [child for child in self.children if child.name == name]

    def only(self, *known: str) -> None:
        """Refuses other children: a name that is misspelt would be an array less."""
        for child in self.children:
            if child.name not in known:
                raise CaseInputError(
                    f"{self.name} has the element {child.name[:40]!r}: {', '.join(known)} are known"
                )

    def count(self, name: str, default: int | None = None) -> int:
        """An attribute that is a whole number from 0 on."""
        value = self.attributes.get(name)
        if value is None and default is not None:
            return default
        if value is None or not re.fullmatch(r"[0-9]{1,18}", value.strip(), re.ASCII):
            raise CaseInputError(f"{self.name} has {name} = {value!r}: a whole number is needed")
        return int(value)


def read_vtk_xml(data: bytes, kind: str) -> PlainMesh:
    """The mesh of a file of "PolyData" (`.vtp`), polygons cut, or "UnstructuredGrid" (`.vtu`)."""
    root, file = _parsed(data)
    if root.name != "VTKFile" or root.attributes.get("type") != kind:
        found = root.attributes.get("type", root.name)
        raise CaseInputError(f"holds {found!r}: VTKFile type={kind!r} is needed")
    root.only(kind)
    bodies = root.all(kind)
    if len(bodies) != 1:
        raise CaseInputError(f"has {len(bodies)} elements {kind!r}: one is needed")
    bodies[0].only("FieldData", "Piece")
    # Surfaces have no use for their faces' values.
    read = _surface_piece if kind == "PolyData" else _volume_piece
    meshes = [read(piece, file) for piece in bodies[0].all("Piece")]
    frame = _frame(bodies[0], file)
    file.check_overlaps()
    if not meshes:
        raise CaseInputError("has no Piece: it is empty")
    return replace(meshes[0] if len(meshes) == 1 else _joined(meshes), frame=frame)


def _frame(body: _Element, file: "_Arrays") -> str | None:
    """The frame that 3D Slicer states in a text of the field data."""
    stated = [
        array
        for group in body.all("FieldData")
        for array in group.all("Array")
        if array.attributes.get("Name") == "SPACE"
    ]
    if len(stated) > 1:
        raise CaseInputError(f"has {len(stated)} texts 'SPACE': one is needed")
    return stated_in_field(file.short_text(stated[0])) if stated else None


def _surface_piece(piece: _Element, file: "_Arrays") -> PlainMesh:
    piece.only("PointData", "CellData", "Points", "Verts", "Lines", "Strips", "Polys")
    points, point_data = _points(piece, file)
    found = []
    for name, cut in (("Polys", triangles_of), ("Strips", triangles_of_strips)):
        n = piece.count(f"NumberOf{name}", 0)
        if not n:
            _check_empty(piece.all(name), file)
            continue
        corners, counts = _connectivity(_one(piece, name), n, file)
        found.append(cut(points, counts, corners))
    if not found:
        return PlainMesh(points, (), point_data)
    return PlainMesh(points, (Cells("triangle", np.concatenate(found)),), point_data)


def _volume_piece(piece: _Element, file: "_Arrays") -> PlainMesh:
    piece.only("PointData", "CellData", "Points", "Cells")
    points, point_data = _points(piece, file)
    n = piece.count("NumberOfCells")
    if not n:
        _check_empty(piece.all("Cells"), file)
        return PlainMesh(points, (), point_data)
    cells = _one(piece, "Cells")
    corners, counts = _connectivity(cells, n, file)
    types = file.whole(_named(cells, "types"), n)
    blocks, rows = cells_by_type(types, counts, corners)
    cell_data = {
        name: tuple(values[mine] for mine in rows)
        for name, values in _data(piece, "CellData", n, file).items()
    }
    return PlainMesh(points, blocks, point_data, cell_data)


def _check_empty(groups: Sequence[_Element], file: "_Arrays") -> None:
    """Refuses cells where none are stated."""
    for group in groups:
        for array in group.all("DataArray"):
            file.values(array, 0)


def _points(
    piece: _Element, file: "_Arrays"
) -> tuple[NDArray[np.float64], dict[str, NDArray[Any]]]:
    n = piece.count("NumberOfPoints")
    arrays = _one(piece, "Points").all("DataArray")
    if len(arrays) != 1:
        raise CaseInputError(f"Points has {len(arrays)} arrays: one is needed")
    points = file.values(arrays[0], n)
    if points.shape != (n, 3):
        raise CaseInputError(f"Points has an array of shape {points.shape}: ({n}, 3) is needed")
    return points.astype(np.float64), _data(piece, "PointData", n, file)


def _data(piece: _Element, name: str, n: int, file: "_Arrays") -> dict[str, NDArray[Any]]:
    found: dict[str, NDArray[Any]] = {}
    for group in piece.all(name):
        group.only("DataArray", "Array")
        for array in group.all("DataArray"):
            label = array.attributes.get("Name", "")
            if label in found:
                raise CaseInputError(f"{name} has two arrays {label!r}")
            # Texts, and whatever else is no number.
            if array.attributes.get("type") in TYPES:
                found[label] = file.values(array, n)
    return found


def _connectivity(cells: _Element, n: int, file: "_Arrays") -> tuple[Integers, Integers]:
    """The corners of all cells, and how many each has."""
    ends = file.whole(_named(cells, "offsets"), n)
    counts = np.diff(ends, prepend=0)
    if int(counts.min()) < 0:
        bad = int(np.flatnonzero(counts < 0)[0])
        raise CaseInputError(f"{cells.name}: offsets[{bad}] is {ends[bad]}: below the one before")
    return file.whole(_named(cells, "connectivity"), int(ends[-1])), counts


def _one(parent: _Element, name: str) -> _Element:
    found = parent.all(name)
    if len(found) != 1:
        raise CaseInputError(f"a Piece has {len(found)} elements {name!r}: one is needed")
    return found[0]


def _named(parent: _Element, name: str) -> _Element:
    found = [a for a in parent.all("DataArray") if a.attributes.get("Name") == name]
    if len(found) != 1:
        raise CaseInputError(f"{parent.name} has {len(found)} arrays {name!r}: one is needed")
    return found[0]


def _joined(meshes: Sequence[PlainMesh]) -> PlainMesh:
    """The pieces of a file as one mesh."""
    filled = [m for m in meshes if m.cells]
    for what, names in (
        ("PointData", {tuple(sorted(m.point_data)) for m in meshes}),
        ("CellData", {tuple(sorted(m.cell_data)) for m in filled}),
    ):
        if len(names) > 1:
            raise CaseInputError(
                f"its pieces differ in the arrays of their {what}: {sorted(names)}"
            )
    blocks, first = list[Cells](), 0
    for mesh in meshes:
        blocks += [Cells(block.type, block.data + first) for block in mesh.cells]
        first += len(mesh.points)
    cell_names = list(filled[0].cell_data) if filled else []
    return PlainMesh(
        np.concatenate([m.points for m in meshes]),
        tuple(blocks),
        {k: np.concatenate([m.point_data[k] for m in meshes]) for k in meshes[0].point_data},
        {k: tuple(a for m in filled for a in m.cell_data[k]) for k in cell_names},
    )


class _Arrays:
    """The arrays of a file: in the text, or appended to it."""

    def __init__(self, root: _Element, appended: bytes, encoding: str) -> None:
        order = root.attributes.get("byte_order", "LittleEndian")
        header = root.attributes.get("header_type", "UInt32")
        packer = root.attributes.get("compressor", "")
        if order not in ORDERS or header not in HEADERS:
            raise CaseInputError(
                f"has byte_order {order!r} and header_type {header!r}: "
                f"{' or '.join(ORDERS)} and {' or '.join(HEADERS)} are needed"
            )
        if packer and packer not in UNPACKERS:
            raise CaseInputError(f"is packed by {packer!r}: {', '.join(UNPACKERS)} are read")
        self.order, self.header = ORDERS[order], np.dtype(ORDERS[order] + HEADERS[header])
        self.unpack = UNPACKERS.get(packer)
        self.appended, self.encoding = appended, encoding
        self.taken: list[tuple[int, int, str]] = []

    def whole(self, array: _Element, n: int) -> NDArray[np.int64]:
        """The values of an array of n whole numbers."""
        values = self.values(array, n)
        name = array.attributes.get("Name")
        if values.ndim != 1 or values.dtype.kind not in "iu":
            raise CaseInputError(f"{name!r} has {values.dtype}: whole numbers are needed")
        if values.dtype == np.uint64 and values.size and int(values.max()) >= 2**63:
            raise CaseInputError(f"{name!r} holds {values.max()}: too large")
        return values.astype(np.int64)

    def values(self, array: _Element, n: int) -> NDArray[Any]:
        """The values of an array of n rows: (n,), or (n, k) for k > 1 components."""
        name, kind = (array.attributes.get(key) for key in ("Name", "type"))
        if kind not in TYPES:
            raise CaseInputError(f"array {name!r} has type {kind!r}: {', '.join(TYPES)} are read")
        width = array.count("NumberOfComponents", 1) or 1
        if width > MAX_COMPONENTS:
            raise CaseInputError(f"array {name!r} has {width} components")
        if array.count("NumberOfTuples", n) != n:
            raise CaseInputError(
                f"array {name!r} states {array.attributes['NumberOfTuples']} rows, its piece {n}"
            )
        dtype = np.dtype(self.order + TYPES[kind])
        try:
            values = self._decoded(array, dtype, n * width)
        except CaseInputError as error:
            raise CaseInputError(f"array {name!r}: {error}") from error
        if len(values) != n * width:
            raise CaseInputError(
                f"array {name!r} holds {len(values)} numbers, {n * width} are needed: the file is "
                "cut short or damaged"
            )
        return values if width == 1 else values.reshape(n, width)

    def short_text(self, array: _Element) -> bytes:
        """A text of three characters, which VTK ends by a zero: the name of a frame."""
        try:
            codes = self._decoded(array, np.dtype("u1"), FRAME_CODES)
        except CaseInputError as error:
            raise CaseInputError(f"its text 'SPACE' cannot be read: {error}") from error
        return codes.tobytes().rstrip(b"\0")

    def _decoded(self, array: _Element, dtype: np.dtype[Any], count: int) -> NDArray[Any]:
        form = array.attributes.get("format", "ascii")
        if form == "ascii":
            return _from_words(array, dtype)
        if form not in {"binary", "appended"}:
            raise CaseInputError(f"format {form!r} is not known")
        raw = self._bytes(array, form, count * dtype.itemsize)
        return np.frombuffer(raw, dtype).astype(dtype.newbyteorder("="))

    def check_overlaps(self) -> None:
        """Refuses appended arrays that share bytes: one of their offsets is damaged."""
        taken = sorted(self.taken)
        for (_, end, one), (start, _, other) in itertools.pairwise(taken):
            if start < end:
                raise CaseInputError(f"appended arrays {one!r} and {other!r} share bytes")

    def _bytes(self, array: _Element, form: str, size: int) -> bytes:
        if form == "binary":
            text = "".join(array.text).encode("ascii", "replace").translate(None, SPACE)
            raw, end = self._block(text, 0, size, coded=True)
            if end != len(text):
                raise CaseInputError(f"has {len(text) - end} extra characters")
            return raw
        start = array.count("offset")
        coded = self.encoding == "base64"
        raw, end = self._block(self.appended, start, size, coded=coded)
        self.taken.append((start, end, array.attributes.get("Name", "")))
        return raw

    def _block(self, text: bytes, start: int, size: int, *, coded: bool) -> tuple[bytes, int]:
        """The bytes of an array whose header begins here, and where it ends."""
        width = self.header.itemsize

        def take(at: int, count: int) -> tuple[bytes, int]:
            end = at + (-(-count // 3) * 4 if coded else count)
            if end > len(text):
                raise CaseInputError(
                    f"is cut short: {max(0, len(text) - at)} of {end - at} characters"
                )
            raw = _decoded(text[at:end]) if coded else text[at:end]
            if len(raw) < count:
                raise CaseInputError(f"is cut short: {len(raw)} of {count} bytes")
            return raw, end

        if self.unpack is None:
            head, after = take(start, width)
            stated = int(np.frombuffer(head[:width], self.header)[0])
            if stated != size:
                raise CaseInputError(
                    f"states {stated} bytes, {size} are needed for its type and count"
                )
            # Header and data are one text, or, where the header ends in "=", two.
            if coded and not text[start:after].endswith(b"="):
                raw, end = take(start, width + size)
                return _exactly(raw, width + size)[width:], end
            raw, end = take(after, size)
            return _exactly(raw, size), end
        head, _ = take(start, 3 * width)
        n, full, last = (int(v) for v in np.frombuffer(head[: 3 * width], self.header))
        if (n and (n - 1) * full + (last or full)) != size:
            raise CaseInputError(f"states {n} packed blocks of {full} bytes: {size} are needed")
        if n > len(text):
            raise CaseInputError(f"states {n} packed blocks: more than it has bytes")
        head, at = take(start, (3 + n) * width)
        lengths = [int(v) for v in np.frombuffer(_exactly(head, (3 + n) * width), self.header)[3:]]
        packed, end = take(at, sum(lengths))
        packed = _exactly(packed, sum(lengths))
        out, place = list[bytes](), 0
        for i, length in enumerate(lengths):
            wanted = (last or full) if i == n - 1 else full
            block = self.unpack(packed[place : place + length], wanted)
            if len(block) != wanted:
                raise CaseInputError(f"a packed block holds {len(block)} bytes, {wanted} stated")
            out.append(block)
            place += length
        return b"".join(out), end


def _exactly(raw: bytes, count: int) -> bytes:
    if len(raw) != count:
        raise CaseInputError(f"holds {len(raw)} bytes, {count} are stated")
    return raw


def _decoded(text: bytes) -> bytes:
    try:
        return base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError) as error:
        raise CaseInputError(f"is not base64 ({error})") from error


def _from_words(array: _Element, dtype: np.dtype[Any]) -> NDArray[Any]:
    words = "".join(array.text).encode("ascii", "replace").split()
    if dtype.kind == "f":
        return real_numbers(words, "number {}".format, dtype.str[1:])
    values = whole_numbers(words, "number {}".format)
    limits = np.iinfo(dtype)
    if values.size and not (limits.min <= values.min() and int(values.max()) <= limits.max):
        raise CaseInputError(f"holds a number beyond {dtype.name}")
    return values.astype(dtype.newbyteorder("="))


def _parsed(data: bytes) -> tuple[_Element, _Arrays]:
    """The element of the file, and where its arrays are found."""
    appended, encoding = b"", ""
    text = data
    if found := APPENDED.search(data):
        end = data.rfind(APPENDED_END)
        if end < found.end():
            raise CaseInputError("is cut short: its appended data do not end")
        appended, encoding = data[found.end() : end], found[1].decode()
        if encoding == "base64":
            appended = appended.translate(None, SPACE)
        text = data[: found.start()] + data[end + len(APPENDED_END) :]
    root = _tree(text)
    return root, _Arrays(root, appended, encoding)


def _tree(text: bytes) -> _Element:
    top = _Element("", {})
    stack = [top]

    def start(name: str, attributes: dict[str, str]) -> None:
        stack[-1].children.append(_Element(name, attributes))
        stack.append(stack[-1].children[-1])

    def words(part: str) -> None:
        if stack[-1].name in {"DataArray", "Array"}:
            stack[-1].text.append(part)

    walk_xml(text, (MAX_ELEMENTS, MAX_DEPTH), start, stack.pop, words, separator=" ")
    return top.children[0]
