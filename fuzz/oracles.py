"""Strict, slow readers that follow the rules of each format, one value at a time.

These readers share nothing with the package. If a reader of the package accepts a file that one of
these refuses, or returns other vertices or triangles, it silently changed the geometry.
"""

import base64
import csv
import json
import math
import re
import struct
import xml.etree.ElementTree as ET
import zlib

Surface = tuple[list[tuple[float, ...]], list[tuple[int, ...]]]
PLAIN_REAL = re.compile(r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?", re.ASCII)
PLAIN_WHOLE = re.compile(r"[-+]?[0-9]+", re.ASCII)
SIZES = {"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I"}
SIZES |= {"float": "f", "double": "d", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H"}
SIZES |= {"int32": "i", "uint32": "I", "float32": "f", "float64": "d"}


class UndecidedError(Exception):
    """The format's rules say nothing of this file that is simple enough to be checked here."""


def _real(word: str) -> float:
    if not PLAIN_REAL.fullmatch(word) or not math.isfinite(float(word)):
        raise ValueError(word)
    return float(word)


def _whole(word: str) -> int:
    if not PLAIN_WHOLE.fullmatch(word) or len(word) > 20:
        raise ValueError(word)
    return int(word)


def _single(value: float) -> float:
    return struct.unpack("<f", struct.pack("<f", value))[0]


def _checked(points: list[tuple[float, ...]], faces: list[tuple[int, ...]]) -> Surface:
    for face in faces:
        if len(face) < 3 or any(not 0 <= corner < len(points) for corner in face):
            raise ValueError(face)
    if any(not math.isfinite(x) for point in points for x in point):
        raise ValueError(points)
    if any(len(face) != 3 for face in faces):
        raise UndecidedError("polygons")
    return points, faces


def stl(data: bytes) -> Surface:
    """Corners of each triangle, three new points each."""
    points: list[tuple[float, ...]] = []
    # A few bytes more than the triangles take are none of them.
    more = len(data) - 84 - 50 * struct.unpack("<I", data[80:84])[0] if len(data) >= 84 else -1
    text = data.removeprefix(b"\xef\xbb\xbf").rstrip(b"\0\x1a")
    is_text = text.lstrip()[:5].lower() == b"solid" and b"\0" not in text
    if data[80:84] == bytes(4) and more % 50 == 0 and more > 0 and not is_text:
        data = data[:80] + struct.pack("<I", more // 50) + data[84:]
        more = 0
    data = text if is_text and more else data
    if more == 0 or (0 < more < 50 and not is_text):
        for i in range(struct.unpack("<I", data[80:84])[0]):
            row = struct.unpack("<12fH", data[84 + 50 * i : 134 + 50 * i])
            points += [row[3:6], row[6:9], row[9:12]]
    else:
        inside = False
        state: list[str] = []
        for line in re.split(r"\r\n|\r|\n", data.decode("latin-1")):
            words = line.lower().split()
            if words and words[0] in {"solid", "endsolid"}:
                if (words[0] == "solid") == inside or state:
                    raise ValueError(line)
                inside = not inside
            else:
                state += words
            while len(state) >= 21:
                facet, state = state[:21], state[21:]
                if (
                    not inside
                    or facet[:2] != ["facet", "normal"]
                    or facet[5:7] != ["outer", "loop"]
                ):
                    raise ValueError(facet)
                if facet[19:] != ["endloop", "endfacet"]:
                    raise ValueError(facet)
                for at in (7, 11, 15):
                    if facet[at] != "vertex":
                        raise ValueError(facet)
                    points.append(tuple(map(_real, facet[at + 1 : at + 4])))
        if inside or state:
            raise ValueError("cut short")
    faces = [(i, i + 1, i + 2) for i in range(0, len(points), 3)]
    return _checked(points, faces)


def ply(data: bytes) -> Surface:
    """Vertices and faces of any order of elements and properties."""
    end = re.search(rb"[\r\n]end_header[ \t]*(\r\n|\n|\r)", data[: 2**16])
    if end is None or not data.startswith(b"ply"):
        raise ValueError("no header")
    lines = [
        line.split() for line in re.split(r"\r\n|\n|\r", data[: end.start()].decode("latin-1"))
    ]
    if lines[0] != ["ply"]:
        raise ValueError(lines[0])
    form = ""
    elements: list[tuple[str, int, list[list[str]]]] = []
    for words in lines[1:]:
        if not words or words[0] in {"comment", "obj_info"}:
            continue
        if words[0] == "format" and not form and len(words) == 3 and words[2] == "1.0":
            form = words[1]
        elif words[0] == "element" and len(words) == 3:
            elements.append((words[1], _whole(words[2]), []))
        elif words[0] == "property":
            elements[-1][2].append(words[1:])
        else:
            raise ValueError(words)
    body = data[end.end() :]
    if b"\r\n" not in data[: end.start()] and end[1] == b"\r\n":
        body = data[end.end() - 1 :]
    order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[form]
    words_left = iter(body.split()) if not order else None
    at = 0

    def value(kind: str) -> float:
        nonlocal at
        if words_left is not None:
            word = next(words_left, b"").decode("latin-1")
            if SIZES[kind] not in "fd":
                return _whole(word)
            return _single(_real(word)) if SIZES[kind] == "f" else _real(word)
        size = struct.calcsize(SIZES[kind])
        (number,) = struct.unpack(order + SIZES[kind], body[at : at + size])
        at += size
        return number

    found: dict[str, list[dict[str, list[float]]]] = {}
    for name, count, properties in elements:
        if name in found:
            raise ValueError(name)
        if count > len(body):
            raise ValueError(count)
        rows = []
        for _ in range(count):
            row: dict[str, list[float]] = {}
            for words in properties:
                if words[0] == "list":
                    n = value(words[1])
                    if not 0 <= n <= len(body):
                        raise ValueError(n)
                    row[words[3]] = [value(words[2]) for _ in range(int(n))]
                else:
                    row[words[1]] = [value(words[0])]
            rows.append(row)
        found[name] = rows
    rest = list(words_left) if words_left is not None else body[at:].strip(b"\r\n")
    if rest:
        # The header may have missed a row: one more of the last element must not be there.
        name, _, properties = elements[-1]
        if name != "face":
            raise UndecidedError("bytes after the last row")
        try:
            for words in properties:
                many = int(value(words[1])) if words[0] == "list" else 1
                more = [value(words[2] if words[0] == "list" else words[0]) for _ in range(many)]
                if words[-1] in {"vertex_indices", "vertex_index"}:
                    found["more"] = [{"row": more}]
            extra = found["more"][0]["row"]
            if len(extra) >= 3 and all(0 <= c < len(found["vertex"]) for c in extra):
                raise LookupError("too long")
        except (ValueError, OverflowError, struct.error):
            pass
    points = [(*row["x"], *row["y"], *row["z"]) for row in found["vertex"]]
    faces = []
    for row in found["face"]:
        corners = row.get("vertex_indices", row.get("vertex_index"))
        if corners is None or any(not isinstance(c, int) for c in corners):
            raise ValueError(row)
        faces.append(tuple(corners))
    return _checked(points, faces)


def obj(data: bytes) -> Surface:
    """Vertices and faces, line by line."""
    text = data.removeprefix(b"\xef\xbb\xbf").rstrip(b"\0\x1a").decode("latin-1")
    if "\\" in text:
        raise UndecidedError("continued lines")
    text = text if "\n" in text else text.replace("\r", "\n")
    points: list[tuple[float, ...]] = []
    faces: list[tuple[int, ...]] = []
    for line in text.split("\n"):
        words = [w for w in re.split("[ \t\r\x0b\x0c]+", line.partition("#")[0]) if w]
        if not words:
            continue
        if words[0] == "v":
            if len(words) not in {4, 5, 7, 8} or (len(words) == 5 and _real(words[4]) != 1.0):
                raise ValueError(line)
            points.append(tuple(map(_real, words[1:4])))
        elif words[0] == "f":
            corners = []
            for word in words[1:]:
                if not re.fullmatch(r"[-+]?[0-9]+(/(-?[0-9]+)?(/(-?[0-9]+)?)?)?", word, re.ASCII):
                    raise ValueError(line)
                number = _whole(word.split("/")[0])
                if number == 0 or number < -len(points):
                    raise ValueError(line)
                corners.append(number - 1 if number > 0 else len(points) + number)
            faces.append(tuple(corners))
    return _checked(points, faces)


def vtk_xml(data: bytes) -> Surface:
    """Points, and triangles or tets, of a file of one piece with its arrays in the text."""
    if b"<!DOCTYPE" in data:
        raise ValueError("document type")
    if b"<AppendedData" in data:
        raise UndecidedError("appended")
    root = ET.fromstring(data)  # noqa: S314 (document types are refused above)
    order = {"LittleEndian": "<", "BigEndian": ">"}[root.get("byte_order", "LittleEndian")]
    head = {"UInt32": "I", "UInt64": "Q"}[root.get("header_type", "UInt32")]
    pieces = root.findall("./*/Piece")
    if len(pieces) != 1:
        raise UndecidedError("pieces")
    piece = pieces[0]
    points_array = piece.find("./Points/DataArray")
    cells = piece.find("./Polys" if root.get("type") == "PolyData" else "./Cells")
    if points_array is None or cells is None:
        raise ValueError("no points or cells")

    def numbers(array: ET.Element, count: int) -> list[float]:
        kind = {"Float32": "f", "Float64": "d", "Int32": "i", "Int64": "q", "UInt8": "B"}
        kind |= {"Int8": "b", "UInt64": "Q", "UInt32": "I", "Int16": "h", "UInt16": "H"}
        letter = kind[array.get("type", "")]
        text = "".join(array.itertext()) if array.get("format", "ascii") == "ascii" else array.text
        text = (text or "").strip()
        if array.get("format", "ascii") == "ascii":
            words = text.split()
            if len(words) != count:
                raise ValueError(count)
            if letter not in "fd":
                return [_whole(w) for w in words]
            return [_single(_real(w)) if letter == "f" else _real(w) for w in words]
        text = re.sub(r"\s", "", text)
        size = struct.calcsize(order + head)
        if root.get("compressor"):
            if root.get("compressor") != "vtkZLibDataCompressor":
                raise UndecidedError("packed")
            first = base64.b64decode(text[: -(-3 * size // 3) * 4], validate=True)
            n = struct.unpack(order + 3 * head, first[: 3 * size])[0]
            width = -(-(3 + n) * size // 3) * 4
            heads = base64.b64decode(text[:width], validate=True)
            lengths = struct.unpack(order + n * head, heads[3 * size : (3 + n) * size])
            packed = base64.b64decode(text[width:], validate=True)
            raw = b""
            for length in lengths:
                raw += zlib.decompress(packed[:length])
                packed = packed[length:]
            if packed:
                raise ValueError("too long")
        else:
            both = base64.b64decode(text, validate=True)
            (length,) = struct.unpack(order + head, both[:size])
            raw = both[size:]
            if length != len(raw):
                raise ValueError(length)
        return list(struct.unpack(f"{order}{count}{letter}", raw))

    n = _whole(piece.get("NumberOfPoints", ""))
    m = _whole(piece.get("NumberOfPolys", piece.get("NumberOfCells", "")))
    if max(n, m) > len(data):
        raise ValueError(n)
    flat = numbers(points_array, 3 * n)
    points = [tuple(flat[3 * i : 3 * i + 3]) for i in range(n)]
    arrays = {a.get("Name"): a for a in cells.findall("./DataArray")}
    ends = [int(v) for v in numbers(arrays["offsets"], m)]
    corners = [int(v) for v in numbers(arrays["connectivity"], ends[-1] if ends else 0)]
    faces = [tuple(corners[a:b]) for a, b in zip([0, *ends], ends, strict=False)]
    if any(a > b for a, b in zip([0, *ends], ends, strict=False)):
        raise ValueError(ends)
    if any(not 0 <= c < n for face in faces for c in face):
        raise ValueError(faces)
    if root.get("type") == "UnstructuredGrid":
        if any(t != 10 for t in numbers(arrays["types"], m)) or any(len(f) != 4 for f in faces):
            raise UndecidedError("other cells")
        return points, faces
    return _checked(points, faces)


def markups(data: bytes) -> dict[str, tuple[float, ...]]:
    """Points of a `.mrk.json` by label, in LPS mm."""

    def once(pairs: list[tuple[str, object]]) -> dict[str, object]:
        if len(dict(pairs)) < len(pairs):
            raise ValueError(pairs)
        return dict(pairs)

    document = json.loads(data.decode("utf-8-sig"), object_pairs_hook=once)
    found = {}
    for markup in document["markups"]:
        sign = {"LPS": 1, "1": 1, "RAS": -1, "0": -1, "": 1}[
            str(markup.get("coordinateSystem", ""))
        ]
        scale = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "um": 0.001}[
            markup.get("coordinateUnits", "mm")
        ]
        for point in markup.get("controlPoints", []):
            if point.get("positionStatus", "defined") != "defined":
                continue
            x, y, z = map(float, point["position"])
            label = point["label"].strip()
            if label in found or not all(map(math.isfinite, (x, y, z))):
                raise ValueError(label)
            found[label] = (sign * scale * x, sign * scale * y, scale * z)
    return found


def fcsv(data: bytes) -> dict[str, tuple[float, ...]]:
    """Points of a `.fcsv` by label, in LPS mm."""
    sign, found = -1, {}
    columns = ["id", "x", "y", "z", "ow", "ox", "oy", "oz", "vis", "sel", "lock", "label"]
    columns += ["desc", "associatedNodeID"]
    rows = []
    for line in data.decode("utf-8-sig").splitlines():
        if line.startswith("#"):
            key, _, value = line.lstrip("# ").partition("=")
            if key.strip() == "CoordinateSystem":
                sign = {"LPS": 1, "1": 1, "RAS": -1, "0": -1, "": -1}[value.strip()]
            elif key.strip() == "columns":
                columns = [name.strip() for name in value.split(",")]
        elif line.strip():
            rows.append(next(csv.reader([line], strict=True)))
    for row in rows:
        cells = dict(zip([*columns, "status"], row, strict=False))
        if cells.get("status", "").strip() in {"0", "1"}:
            continue
        x, y, z = (_real(cells[axis].strip()) for axis in "xyz")
        if cells["label"].strip() in found:
            raise ValueError(cells)
        found[cells["label"].strip()] = (sign * x, sign * y, z)
    return found
