"""Meshes in the formats that meshio reads; XML with a document type is refused."""

import contextlib
import io as stdio
import os
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError
from cmfsim.io.files import named
from cmfsim.io.ply import read_plain_ply

__all__ = [
    "read_mesh",
    "read_tet_mesh",
    "read_tets",
]

# Length of a PLY header with any number of properties and comments, bytes.
MAX_PLY_HEADER = 2**16


def _meshio() -> Any:
    try:
        return import_module("meshio")
    except ModuleNotFoundError as error:
        raise CaseInputError(
            "meshes and surfaces are read with meshio: pip install 'cmfsim[mesh]'"
        ) from error


def read_mesh(path: Path) -> Any:
    """What meshio reads from a file."""
    _meshio()
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    _refuse_entities(path)
    _refuse_headless(path)
    with named(path):
        try:
            # meshio prints what it finds and, in some readers, exits: neither is the caller's.
            with (
                contextlib.redirect_stdout(stdio.StringIO()),
                contextlib.redirect_stderr(stdio.StringIO()),
            ):
                return _read(path)
        except (Exception, SystemExit) as error:
            raise CaseInputError(f"cannot be read as a mesh ({error})") from error


def _read(path: Path) -> Any:
    if path.suffix == ".vtp":
        return _read_vtp(path)
    # meshio takes PLY's triangles one by one.
    plain = read_plain_ply(path) if path.suffix.lower() == ".ply" else None
    if plain is not None:
        points, triangles = plain
        return _meshio().Mesh(points, [("triangle", triangles)])
    return _meshio().read(path)


def _refuse_entities(path: Path) -> None:
    """Refuses XML with a document type, in which entities could grow without bound."""
    data = path.read_bytes()
    if data[:1] == b"<" and (b"<!DOCTYPE" in data or b"<!ENTITY" in data):
        raise CaseInputError(f"{path.name}: XML with a document type is not read")
    if data[:2] in {b"\xff\xfe", b"\xfe\xff"}:
        raise CaseInputError(f"{path.name}: XML in UTF-16 is not read")


def read_tet_mesh(path: str | os.PathLike[str]) -> tuple[NDArray[np.float64], NDArray[np.uint32]]:
    """The nodes (n, 3), mm, and tets (m, 4) of a file that meshio reads, all positively oriented.

    Raises
    ------
    FileNotFoundError
        The file does not exist.
    CaseError
        (also `ValueError`) No linear tets.

    Examples
    --------
    >>> import cmfsim
    >>> nodes, tets = cmfsim.read_tet_mesh("mesh.vtu")  # doctest: +SKIP
    """
    path = Path(path)
    mesh = read_mesh(path)
    nodes = np.asarray(mesh.points, dtype=np.float64)
    tets = np.asarray(read_tets(mesh, path)[0], dtype=np.int64)
    if tets.size and (tets.min() < 0 or tets.max() >= len(nodes)):
        raise CaseInputError(f"{path.name}: a tet names a node that is not among {len(nodes)}")
    # Programs differ in the order of nodes: which one a file has, its volumes say.
    corners = nodes[tets]
    negative = np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0.0
    tets[negative] = tets[negative][:, [0, 1, 3, 2]]
    return nodes, tets.astype(np.uint32)


def _read_vtp(path: Path) -> Any:
    """The triangles of VTK's surface format, which meshio does not know, as a mesh of meshio."""
    try:
        pyvista = import_module("pyvista")
    except ModuleNotFoundError as error:
        raise CaseInputError("VTP is read with pyvista: pip install 'cmfsim[mesh]'") from error
    # VTK prints what it finds wrong and goes on with nothing.
    shown = pyvista.vtk_verbosity()
    pyvista.vtk_verbosity("off")
    try:
        surface = pyvista.read(path).triangulate()
    finally:
        pyvista.vtk_verbosity(shown)
    triangles = surface.faces.reshape(-1, 4)[:, 1:]
    values = {name: np.asarray(surface.point_data[name]) for name in surface.point_data}
    cells = [("triangle", triangles)] if len(triangles) else []
    return _meshio().Mesh(surface.points, cells, point_data=values)


def _refuse_headless(path: Path) -> None:
    """Refuses a PLY whose header does not end, for which meshio 5.3 waits for ever."""
    if path.suffix.lower() != ".ply":
        return
    with path.open("rb") as file:
        head = file.read(MAX_PLY_HEADER)
    if b"end_header" not in head:
        raise CaseInputError(f"{path.name}: is no PLY file, or is cut short in its header")


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
