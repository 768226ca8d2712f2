"""Wavefront OBJ: vertices and faces; texture, normals, groups and materials are passed over."""

import re
from itertools import chain
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError
from cmfsim.io.files.texts import real_numbers, shown, whole_numbers
from cmfsim.io.meshes.plain_mesh import triangles_of
from cmfsim.values.checks import Floats

Integers = NDArray[np.int64]
# Keywords that say nothing about where a surface lies.
PASSED_OVER = frozenset(
    b"vt vn vp l p g o s mg usemtl mtllib usemap maplib bevel c_interp d_interp lod shadow_obj "
    b"trace_obj".split()
)
# What follows a vertex in a corner, 1/2/3, 1//3 or 1/2, if it is none of these.
BAD_REFERENCE = re.compile(
    rb"(?<![0-9/])/[^ \t\r\n]*|/(?!(?:-?[0-9]+)?(?:/(?:-?[0-9]+)?)?(?:[ \t\r\n]|$))[^ \t\r\n]*"
)
REFERENCE = re.compile(rb"/[^ \t\r\n]*")
# Counts that this program, MeshLab and 3ds Max state in comments of their own.
STATED = re.compile(
    rb"^#(?: LPS mm, (?P<v1>[0-9]+) vertices, (?P<f1>[0-9]+) faces"
    rb"|[ \t]*vertices: (?P<v2>[0-9]+)|[ \t]*faces: (?P<f2>[0-9]+)"
    rb"|[ \t]*(?P<v3>[0-9]+) vertices|[ \t]*(?P<f3>[0-9]+) faces)[ \t\r]*$",
    re.MULTILINE | re.IGNORECASE,
)
# A mark of UTF-8 before a text, and what some programs write after one.
UTF8, ENDS = b"\xef\xbb\xbf", b"\0\x1a"
LINE_FEED = 10
# The weight that changes nothing, as programs write it.
ONE = re.compile(rb"\+?0*1\.?0*(?:[eE][-+]?0+)?")
# Digits of a count; a longer one is a comment of another kind.
MAX_DIGITS = 18


def read_obj(data: bytes) -> tuple[Floats, Integers]:
    """The vertices (n, 3) and triangles (t, 3), from 0 on, of a file.

    Negative indices count back from the vertices defined so far. Polygons become triangles.
    """
    data = data.removeprefix(UTF8).rstrip(ENDS)
    if b"\0" in data:
        raise CaseInputError("is not an OBJ file: it holds zero bytes")
    if b"\r" in data and b"\n" not in data:
        data = data.replace(b"\r", b"\n")
    lines = data.split(b"\n")
    if any(m.start() and data[m.start() - 1] != LINE_FEED for m in re.finditer(b"#", data)):
        lines = [line if line[:1] == b"#" else line.partition(b"#")[0] for line in lines]
    if b"\\" in data:
        lines = _joined(lines)
    vertices: list[list[bytes]] = []
    faces: list[bytes] = []
    places: list[tuple[int, int]] = []
    numbers: list[int] = []
    for number, line in enumerate(lines, start=1):
        head = line[:2]
        if head in {b"vn", b"vt", b"# ", b"\r"} or not line:
            continue
        word = head[:1] if head in {b"v ", b"f "} else next(iter(line.split(None, 1)), b"#")
        if word == b"v":
            vertices.append(line.split())
            numbers.append(number)
        elif word == b"f":
            faces.append(line)
            places.append((number, len(vertices)))
        elif not word.startswith(b"#") and word not in PASSED_OVER:
            raise CaseInputError(f"line {number}: {shown(word)} is not known in OBJ")
    points = _points(vertices, numbers)
    triangles = _faces(faces, places, points)
    _check_stated(data, len(points), len(faces))
    return points, triangles


def write_obj(file: BinaryIO, vertices: Floats, triangles: NDArray[np.integer]) -> None:
    """Writes a surface as OBJ, with its counts in a comment."""
    lines = [f"# LPS mm, {len(vertices)} vertices, {len(triangles)} faces\n"]
    lines += [f"v {x!r} {y!r} {z!r}\n" for x, y, z in vertices.tolist()]
    lines += [f"f {a} {b} {c}\n" for a, b, c in (triangles.astype(np.int64) + 1).tolist()]
    file.write("".join(lines).encode())


def _joined(lines: list[bytes]) -> list[bytes]:
    """Lines where one that ends in a backslash goes on in the next; numbers of lines stay."""
    done: list[bytes] = []
    first: int | None = None
    for line in lines:
        text = line.rstrip(b"\r")
        if first is None:
            first = len(done)
            done.append(b"")
        else:
            done.append(b"")
        if text.endswith(b"\\") and not done[first].startswith(b"#"):
            done[first] += text[:-1] + b" "
        else:
            done[first] += text
            first = None
    return done


def _points(vertices: list[list[bytes]], numbers: list[int]) -> Floats:
    lengths = set(map(len, vertices))
    if lengths - {4}:
        # x y z w with w = 1, or x y z and a colour of three or four parts.
        for row, number in zip(vertices, numbers, strict=True):
            if len(row) not in {4, 5, 7, 8}:
                raise CaseInputError(
                    f"line {number}: a vertex has {len(row) - 1} numbers: x y z are needed"
                )
            if len(row) == 5 and not ONE.fullmatch(row[4]):
                raise CaseInputError(
                    f"line {number}: a vertex has the weight {shown(row[4])}: only 1 is read, "
                    "since programs differ in what others do to x y z; export it without weights"
                )
        vertices = [row[:4] for row in vertices]
    words = [word for _, *xyz in vertices for word in xyz]
    return real_numbers(words, lambda i: f"line {numbers[i // 3]}").reshape(-1, 3)


def _faces(faces: list[bytes], places: list[tuple[int, int]], points: Floats) -> Integers:
    text = b"\n".join(faces)
    if b"/" in text:
        if other := BAD_REFERENCE.search(text):
            number = places[text.count(b"\n", 0, other.start())][0]
            raise CaseInputError(f"line {number}: {shown(other[0])} is not a texture or normal")
        text = REFERENCE.sub(b"", text)
    rows = [line.split() for line in text.split(b"\n")] if faces else []
    counts = np.fromiter(map(len, rows), np.int64, len(rows)) - 1
    few = np.flatnonzero(counts < 3)
    if len(few):
        raise CaseInputError(
            f"line {places[few[0]][0]}: a face has {counts[few[0]]} corners: three or more are "
            "needed; is the file cut short?"
        )
    words = list(chain.from_iterable(row[1:] for row in rows))
    face = np.repeat(np.arange(len(rows)), counts)
    corners = whole_numbers(words, lambda i: f"line {places[face[i]][0]}")
    so_far = np.array([count for _, count in places], dtype=np.int64)[face]
    # The vertices defined so far number from 1 on, and back from -1.
    numbers = np.where(corners < 0, corners + so_far + 1, corners)
    bad = np.flatnonzero((numbers < 1) | (numbers > len(points)))
    if len(bad):
        line = places[face[bad[0]]][0]
        if corners[bad[0]] == 0:
            raise CaseInputError(f"line {line}: names vertex 0; OBJ numbers vertices from 1 on")
        known = so_far[bad[0]] if corners[bad[0]] < 0 else len(points)
        raise CaseInputError(
            f"line {line}: names vertex {corners[bad[0]]}, but there are {known} vertices"
        )
    return triangles_of(points, counts, numbers - 1, first=1)


def _check_stated(data: bytes, n_vertices: int, n_faces: int) -> None:
    """Refuses a file whose comment states other counts: nothing else shows that it is cut."""
    if b"#" not in data:
        return
    found: dict[str, list[int]] = {"v": [], "f": []}
    for comment in STATED.finditer(data):
        for name, digits in comment.groupdict().items():
            if digits is not None and len(digits) <= MAX_DIGITS:
                found[name[0]].append(int(digits))
    for kind, what, count in (("v", "vertices", n_vertices), ("f", "faces", n_faces)):
        # Several counts are those of the objects of a file.
        if len(found[kind]) == 1 and found[kind][0] != count:
            raise CaseInputError(
                f"is cut short or damaged: a comment states {found[kind][0]} {what}, the file "
                f"holds {count}; export it again (or remove the comment)"
            )
