"""Meshes and surfaces in the formats that meshio reads; XML with a document type is refused."""

import contextlib
import io as stdio
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError
from cmfsim.io.files import named
from cmfsim.scene import SurfaceData

__all__ = [
    "read_mesh",
    "read_surface",
    "read_tets",
    "read_triangles",
]


def _meshio() -> Any:
    try:
        return import_module("meshio")
    except ModuleNotFoundError as error:
        raise CaseInputError(
            "meshes and surfaces are read with meshio: pip install 'cmfsim[mesh]'"
        ) from error


def read_mesh(path: Path) -> Any:
    """What meshio reads from a file."""
    meshio = _meshio()
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    _refuse_entities(path)
    with named(path):
        try:
            # meshio prints what it finds and, in some readers, exits: neither is the caller's.
            with (
                contextlib.redirect_stdout(stdio.StringIO()),
                contextlib.redirect_stderr(stdio.StringIO()),
            ):
                return meshio.read(path)
        except (Exception, SystemExit) as error:
            raise CaseInputError(f"cannot be read as a mesh ({error})") from error


def _refuse_entities(path: Path) -> None:
    """Refuses XML with a document type, in which entities could grow without bound."""
    data = path.read_bytes()
    if data[:1] == b"<" and (b"<!DOCTYPE" in data or b"<!ENTITY" in data):
        raise CaseInputError(f"{path.name}: XML with a document type is not read")
    if data[:2] in {b"\xff\xfe", b"\xfe\xff"}:
        raise CaseInputError(f"{path.name}: XML in UTF-16 is not read")


@dataclass(frozen=True)
class _Weld:
    """Which vertices of a file were kept when equal ones became one."""

    n_read: int
    kept: NDArray[np.intp]


def read_surface(path: Path, crease_angle: float = 60.0) -> SurfaceData:
    """The triangles of a file, with vertices in the same place made one."""
    return read_triangles(path, crease_angle)[0]


def read_triangles(path: Path, crease_angle: float = 60.0) -> tuple[SurfaceData, _Weld]:
    """A surface with vertices in the same place made one: STL repeats them for each triangle."""
    mesh = read_mesh(path)
    triangles = [b.data for b in mesh.cells if b.type == "triangle"]
    if not triangles or any(b.type not in {"triangle", "vertex", "line"} for b in mesh.cells):
        found = ", ".join(sorted({b.type for b in mesh.cells})) or "nothing"
        raise CaseInputError(f"{path.name}: a surface of triangles is needed, found {found}")
    points = np.asarray(mesh.points)
    _, first, back = np.unique(points, axis=0, return_index=True, return_inverse=True)
    # In the order of the file, so that a surface without repetitions keeps its numbers.
    order = np.argsort(first)
    number = np.empty(len(first), dtype=np.int64)
    number[order] = np.arange(len(first))
    kept = first[order]
    welded = number[back.reshape(-1)][np.concatenate(triangles)]
    return SurfaceData(points[kept], welded, crease_angle), _Weld(len(points), kept)


def read_tets(mesh: Any, path: Path) -> tuple[NDArray[Any], dict[str, NDArray[Any]]]:
    """The linear tets of a mesh and their cell data."""
    blocks = [i for i, b in enumerate(mesh.cells) if b.type == "tetra"]
    if not blocks:
        found = ", ".join(sorted({b.type for b in mesh.cells})) or "nothing"
        raise CaseInputError(f"{path.name}: linear tets are needed, found {found}")
    tets = np.concatenate([mesh.cells[i].data for i in blocks])
    data = {
        name: np.concatenate([np.asarray(values[i]) for i in blocks])
        for name, values in mesh.cell_data.items()
    }
    return tets, data
