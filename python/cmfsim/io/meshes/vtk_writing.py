"""VTK's XML files: writing, base64 in one block per array, and unpacking of their blocks."""

import base64
import lzma
import zlib
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError


def _unpacked(worker: Any, block: bytes, size: int) -> bytes:
    """The bytes of a block that a library unpacks: as many as are stated, and one at most more."""
    try:
        out: bytes = worker.decompress(block, size + 1)
    except (zlib.error, lzma.LZMAError, EOFError) as error:
        raise CaseInputError(f"a packed block is damaged ({error})") from error
    if not worker.eof:
        raise CaseInputError("a packed block is cut short, or larger than stated")
    return out


def _lz4(block: bytes, size: int) -> bytes:
    """An LZ4 block (lz4.github.io/lz4, block format): literals and copies of what came before."""
    out = bytearray()
    at = 0
    try:
        while at < len(block):
            token = block[at]
            length, at = _lz4_length(block, at + 1, token >> 4)
            if at + length > len(block) or len(out) + length > size:
                raise CaseInputError("a packed block is damaged (literals beyond its end)")
            out += block[at : at + length]
            at += length
            if at == len(block):
                break
            back = block[at] | block[at + 1] << 8
            length, at = _lz4_length(block, at + 2, token & 15)
            length += 4
            if not 0 < back <= len(out) or len(out) + length > size:
                raise CaseInputError("a packed block is damaged (a copy from before its start)")
            piece = bytes(out[-back:])
            out += (piece * (length // back + 1))[:length]
    except IndexError:
        raise CaseInputError("a packed block is cut short") from None
    return bytes(out)


def _lz4_length(block: bytes, at: int, length: int) -> tuple[int, int]:
    if length == 15:
        while True:
            more = block[at]
            at += 1
            length += more
            if more != 255:
                break
    return length, at


# By the name that VTK gives the program that packed them; each takes a block and its unpacked size.
UNPACKERS: Mapping[str, Callable[[bytes, int], bytes]] = MappingProxyType(
    {
        "vtkZLibDataCompressor": lambda b, size: _unpacked(zlib.decompressobj(), b, size),
        "vtkLZ4DataCompressor": _lz4,
        "vtkLZMADataCompressor": lambda b, size: _unpacked(
            lzma.LZMADecompressor(memlimit=2**28), b, size
        ),
    }
)

VTK_TETRA = 10
VTK_TYPES = {
    "float64": "Float64", "float32": "Float32", "uint32": "UInt32", "int32": "Int32",
    "int64": "Int64", "uint8": "UInt8",
}  # fmt: skip


def data_array(name: str, array: NDArray[Any]) -> str:
    """An array as one base64 block."""
    raw = np.ascontiguousarray(array).tobytes()
    block = base64.b64encode(np.uint64(len(raw)).tobytes() + raw).decode()
    components = array.shape[1] if array.ndim == 2 else 1
    return (
        f'<DataArray type="{VTK_TYPES[array.dtype.name]}" Name="{name}" '
        f'NumberOfComponents="{components}" format="binary">{block}</DataArray>\n'
    )


def write_vtk(file: BinaryIO, kind: str, body: str) -> None:
    """Writes a VTK XML file of one kind round its body."""
    order = "LittleEndian" if np.little_endian else "BigEndian"
    file.write(
        f'<?xml version="1.0"?>\n<VTKFile type="{kind}" version="1.0" byte_order="{order}" '
        f'header_type="UInt64">\n<{kind}>{body}</{kind}>\n</VTKFile>\n'.encode()
    )


def write_tets(
    file: BinaryIO,
    nodes: NDArray[Any],
    tets: NDArray[Any],
    point_data: Mapping[str, NDArray[Any]],
    cell_data: Mapping[str, NDArray[Any]],
) -> None:
    """Writes tets as a `.vtu` file with named arrays on nodes and tets."""
    body = (
        f'<Piece NumberOfPoints="{len(nodes)}" NumberOfCells="{len(tets)}">'
        f"<Points>{data_array('points', nodes)}</Points>"
        f"<PointData>{_arrays(point_data)}</PointData><CellData>{_arrays(cell_data)}</CellData>"
        f"<Cells>{data_array('connectivity', tets.reshape(-1).astype(np.int64))}"
        f"{data_array('offsets', 4 * np.arange(1, len(tets) + 1, dtype=np.int64))}"
        f"{data_array('types', np.full(len(tets), VTK_TETRA, dtype=np.uint8))}</Cells></Piece>"
    )
    write_vtk(file, "UnstructuredGrid", body)


def write_triangles(
    file: BinaryIO,
    vertices: NDArray[Any],
    triangles: NDArray[Any],
    point_data: Mapping[str, NDArray[Any]],
    *,
    vectors: str = "",
    frame: str = "",
) -> None:
    """Writes triangles as a `.vtp` file with named arrays on vertices.

    `vectors` names the array that turns with the surface; `frame` is stated as 3D Slicer does.
    """
    turning = f' Vectors="{vectors}"' if vectors else ""
    stated = ""
    if frame:
        codes = " ".join(str(ord(letter)) for letter in frame)
        stated = (
            '<FieldData><Array type="String" Name="SPACE" NumberOfTuples="1" format="ascii">'
            f"{codes} 0</Array></FieldData>"
        )
    body = (
        f'{stated}<Piece NumberOfPoints="{len(vertices)}" NumberOfVerts="0" NumberOfLines="0" '
        f'NumberOfStrips="0" NumberOfPolys="{len(triangles)}">'
        f"<Points>{data_array('points', vertices)}</Points>"
        f"<PointData{turning}>{_arrays(point_data)}</PointData>"
        f"<Polys>{data_array('connectivity', triangles.reshape(-1).astype(np.int32))}"
        f"{data_array('offsets', 3 * np.arange(1, len(triangles) + 1, dtype=np.int32))}"
        "</Polys></Piece>"
    )
    write_vtk(file, "PolyData", body)


def _arrays(named: Mapping[str, NDArray[Any]]) -> str:
    return "".join(data_array(name, array) for name, array in named.items())
