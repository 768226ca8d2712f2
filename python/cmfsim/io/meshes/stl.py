"""STL, binary and text: triangles by their corners, in single precision."""

import re
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError
from cmfsim.io.files.texts import real_numbers, shown
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding

HEADER = 80
ROW = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
# Lines that open and close a solid; their names may hold anything.
SOLID = re.compile(
    rb"^[ \t]*(solid|endsolid)(?=[ \t\r\n]|\Z)[^\r\n]*", re.IGNORECASE | re.MULTILINE
)
# The words of a facet in text; empty where a number stands.
FACET = (
    *(b"facet", b"normal", b"", b"", b"", b"outer", b"loop"),
    *(b"vertex", b"", b"", b"") * 3,
    *(b"endloop", b"endfacet"),
)
# A mark of UTF-8 before a text, and what some programs write after one.
UTF8, ENDS = b"\xef\xbb\xbf", b"\0\x1a"
CORNERS = (8, 9, 10, 12, 13, 14, 16, 17, 18)
LOOK = "look at the surface; if a part is missing, export it again"


def read_stl(data: bytes) -> tuple[Floats, tuple[Finding, ...]]:
    """The corners (t, 3, 3) of the triangles of a file, and findings.

    Whether it is text goes by its content: binary files may begin with "solid" as well.
    """
    if len(data) >= HEADER + 4 and len(data) == _length(data):
        return _read_binary(data), ()
    text = data.removeprefix(UTF8).rstrip(ENDS)
    if text[:1024].lstrip()[:5].lower() == b"solid" and b"\0" not in text:
        return _read_text(text), ()
    if len(data) < HEADER + 4:
        raise CaseInputError(
            f"is not an STL file, or is cut short: {len(data)} bytes, a header has {HEADER + 4}"
        )
    if _count(data) == 0 and len(data) > HEADER + 4 and not (len(data) - HEADER - 4) % ROW.itemsize:
        count = (len(data) - HEADER - 4) // ROW.itemsize
        why = "the program that wrote it did not finish its header, or was stopped"
        what = f"it states 0 triangles, and has bytes for {count}, which were read"
        whole = data[:HEADER] + count.to_bytes(4, "little") + data[HEADER + 4 :]
        return _read_binary(whole), (Finding("field-ignored", what, why=why, fix=LOOK),)
    if 0 < (left := len(data) - _length(data)) < ROW.itemsize:
        why = "the file may have been changed after it was written"
        what = f"{left} bytes after the last triangle were ignored: a triangle takes {ROW.itemsize}"
        finding = Finding("field-ignored", what, why=why, fix=LOOK)
        return _read_binary(data), (finding,)
    raise CaseInputError(
        f"is not an STL file, or is cut short or damaged: it states {_count(data)} triangles, "
        f"which take {_length(data)} bytes, but has {len(data)}; export it again"
    )


def write_stl(file: BinaryIO, vertices: Floats, triangles: NDArray[np.integer]) -> None:
    """Writes triangles as binary STL."""
    corners = vertices[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    rows = np.zeros(len(corners), dtype=ROW)
    # A triangle without area has no normal: zeros, as the format allows.
    rows["normal"] = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0.0)
    rows["corners"] = corners
    file.write(b"cmfsim LPS mm".ljust(HEADER, b" "))
    file.write(np.uint32(len(corners)).astype("<u4").tobytes())
    file.write(rows.tobytes())


def _count(data: bytes) -> int:
    return int.from_bytes(data[HEADER : HEADER + 4], "little")


def _length(data: bytes) -> int:
    return HEADER + 4 + ROW.itemsize * _count(data)


def _read_binary(data: bytes) -> Floats:
    corners = np.frombuffer(data, ROW, _count(data), HEADER + 4)["corners"].astype(np.float64)
    bad = np.argwhere(~np.isfinite(corners))
    if len(bad):
        raise CaseInputError(f"triangle {bad[0][0]} has a corner that is not finite")
    return corners


def _read_text(data: bytes) -> Floats:
    kinds = [match[1].lower() for match in SOLID.finditer(data)]
    # One file may hold several solids, one after the other.
    if len(kinds) % 2 or any(k != (b"endsolid", b"solid")[i % 2 == 0] for i, k in enumerate(kinds)):
        n_open = sum(kind == b"solid" for kind in kinds)
        raise CaseInputError(
            f"is cut short or damaged: {n_open} solids begin and {len(kinds) - n_open} end"
        )
    words = SOLID.sub(b"", data).split()
    if len(words) % len(FACET):
        raise CaseInputError(
            f"is cut short or damaged: {len(words)} words are not {len(FACET)} for each facet "
            f"(facet {len(words) // len(FACET)})"
        )
    for place, known in enumerate(FACET):
        if not known:
            continue
        column = words[place :: len(FACET)]
        if set(column) != {known} and words:
            facet = next((i for i, word in enumerate(column) if word.lower() != known), None)
            if facet is not None:
                raise CaseInputError(
                    f"facet {facet} has {shown(column[facet])} where {known.decode()!r} is needed"
                )
    corners = np.empty((len(words) // len(FACET), len(CORNERS)))
    for number, place in enumerate(CORNERS):
        corners[:, number] = real_numbers(words[place :: len(FACET)], "facet {}".format)
    return corners.reshape(-1, 3, 3)
