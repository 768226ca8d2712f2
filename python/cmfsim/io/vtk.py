"""VTK's XML files, base64 in one block per array."""

import base64
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "VTK_TETRA",
    "data_array",
    "write_vtk",
]

VTK_TETRA = 10
VTK_TYPES = {"float64": "Float64", "uint32": "UInt32", "int64": "Int64", "uint8": "UInt8"}


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
