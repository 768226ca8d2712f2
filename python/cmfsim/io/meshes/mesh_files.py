"""Meshes of any format: by our own readers, and by VTK and meshio in a process of its own."""

import contextlib
import io as stdio
from collections.abc import Callable, Mapping
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError
from cmfsim.io.files.reading_writing import check_readable, named, utf8_path
from cmfsim.io.meshes.msh import read_msh
from cmfsim.io.meshes.obj import read_obj
from cmfsim.io.meshes.plain_mesh import Cells, PlainMesh, oriented, stated_frame
from cmfsim.io.meshes.ply import read_ply
from cmfsim.io.meshes.stl import read_stl
from cmfsim.io.meshes.vtk_legacy import read_vtk_legacy
from cmfsim.io.meshes.vtk_xml import read_vtk_xml
from cmfsim.processes.child import ReaderError, read_in_child
from cmfsim.processes.worker import Answer, ReadLimits
from cmfsim.values.checks import AnyPath
from cmfsim.values.finding import Finding

# Formats of meshio whose files name other files, which may lie anywhere, or hold no mesh.
NAME_OTHERS = frozenset({".xdmf", ".xmf", ".hmf", ".node", ".ele", ".svg"})
# Processor time, s, and memory, bytes, that meshio may take for a small file.
SECONDS, MEMORY = 2.0, 2**30
# What the child process imports before this time begins.
LIBRARIES = ("meshio",)
# Cells that lie on or in the tets of a file without being part of the tissue.
PASSED_OVER = frozenset({"vertex", "line", "triangle", "quad", "tetra"})


def _of_triangles(
    points: NDArray[np.float64],
    triangles: NDArray[np.int64],
    frame: str | None,
    findings: tuple[Finding, ...] = (),
) -> PlainMesh:
    cells = (Cells("triangle", triangles),) if len(triangles) else ()
    return PlainMesh(points, cells, frame=frame, findings=findings)


def _stl(data: bytes) -> PlainMesh:
    corners, findings = read_stl(data)
    triangles = np.arange(3 * len(corners)).reshape(-1, 3)
    return _of_triangles(corners.reshape(-1, 3), triangles, stated_frame(data, ".stl"), findings)


def _ply(data: bytes) -> PlainMesh:
    points, triangles, findings = read_ply(data)
    return _of_triangles(points, triangles, stated_frame(data, ".ply"), findings)


READERS: Mapping[str, Callable[[bytes], PlainMesh]] = MappingProxyType(
    {
        ".stl": _stl,
        ".ply": _ply,
        ".obj": lambda data: _of_triangles(*read_obj(data), stated_frame(data, ".obj")),
        ".vtp": lambda data: read_vtk_xml(data, "PolyData"),
        ".vtu": lambda data: read_vtk_xml(data, "UnstructuredGrid"),
        ".msh": read_msh,
    }
)


def read_mesh(path: Path) -> PlainMesh:
    """The mesh in a file, its indices checked.

    path: STL, PLY, OBJ, VTP, VTU, legacy VTK, Gmsh; or another format of one file that meshio
        reads, in the child process.
    """
    check_readable(path)
    suffix = path.suffix.lower()
    with named(path):
        if suffix == ".vtk":
            return read_vtk_legacy(path)
        if suffix not in READERS:
            return _by_meshio(path)
        try:
            data = path.read_bytes()
            # Fluent's files have the same ending as Gmsh's, and begin with "(".
            if suffix == ".msh" and data[:1] == b"(":
                return _by_meshio(path)
            return READERS[suffix](data)
        except MemoryError as error:
            raise CaseInputError("does not fit into memory") from error


def _by_meshio(path: Path) -> PlainMesh:
    suffix = path.suffix.lower()
    if suffix in NAME_OTHERS or not suffix:
        raise _unsupported(suffix)
    if find_spec("meshio") is None:
        raise CaseInputError(
            f"files of {suffix} are read with meshio: pip install '.[mesh]' in cmfsim's folder; "
            f"{', '.join(READERS)} need nothing more"
        )
    size = path.stat().st_size
    # meshio's slowest readers take a MB a second, and less than 200 bytes for each.
    limits = ReadLimits(SECONDS + size / 1e6, MEMORY + 200 * size)
    try:
        with utf8_path(path) as plain:
            answer = read_in_child("cmfsim.io.meshes.mesh_files:meshio_answer", limits, path=plain)
    except ReaderError as error:
        raise CaseInputError(f"cannot be read as a mesh: {error}") from error
    arrays, values = answer.arrays, answer.values
    blocks, n_blocks = list[Cells](), len(values["types"])
    for i, name in enumerate(values["types"]):
        corners = arrays[f"cells.{i}"]
        if corners.dtype.kind not in "iu":
            raise CaseInputError(f"has cells of {corners.dtype}: whole numbers are needed")
        blocks.append(Cells(name, corners.astype(np.int64)))
    points = np.asarray(arrays["points"], dtype=np.float64)
    if points.ndim == 2 and points.shape[1] == 2:
        points = np.concatenate([points, np.zeros((len(points), 1))], axis=1)
    point_data = {n: arrays[f"point_data.{i}"] for i, n in enumerate(values["point_data"])}
    cell_data = {
        name: tuple(arrays[f"cell_data.{i}.{k}"] for k in range(n_blocks))
        for i, name in enumerate(values["cell_data"])
    }
    return PlainMesh(points, tuple(blocks), point_data, cell_data)


def _unsupported(suffix: str) -> CaseInputError:
    return CaseInputError(
        f"files of {suffix or 'no ending'} are not supported: save a surface as .stl, .ply, .obj "
        "or .vtp, tets as .vtu"
    )


def meshio_answer(path: str) -> Answer:
    """What meshio reads from a file; called in the child process."""
    meshio: Any = import_module("meshio")
    if not path.lower().endswith(tuple(meshio.extension_to_filetypes)):
        raise _unsupported(Path(path).suffix.lower())
    try:
        # meshio prints what it finds and, in some readers, exits: neither is the caller's.
        with (
            contextlib.redirect_stdout(stdio.StringIO()),
            contextlib.redirect_stderr(stdio.StringIO()),
        ):
            mesh = meshio.read(path)
        arrays = {"points": np.asarray(mesh.points, dtype=np.float64)}
        for i, block in enumerate(mesh.cells):
            arrays[f"cells.{i}"] = np.asarray(block.data)
        for i, values in enumerate(mesh.point_data.values()):
            arrays[f"point_data.{i}"] = np.asarray(values)
        for i, parts in enumerate(mesh.cell_data.values()):
            for k, values in enumerate(parts):
                arrays[f"cell_data.{i}.{k}"] = np.asarray(values)
    except MemoryError:
        raise
    except (Exception, SystemExit) as error:
        raise CaseInputError(f"cannot be read as a mesh ({error})") from error
    if any(array.dtype.kind not in "fiub" for array in arrays.values()):
        raise CaseInputError("holds cells or values that are not arrays of numbers")
    texts = {
        "types": [str(block.type) for block in mesh.cells],
        "point_data": [str(name) for name in mesh.point_data],
        "cell_data": [str(name) for name in mesh.cell_data],
    }
    return Answer(texts, arrays)


def read_tet_mesh(path: AnyPath) -> tuple[NDArray[np.float64], NDArray[np.uint32]]:
    """The nodes (n, 3), mm, and tets (m, 4) of a file, all positively oriented.

    Parameters
    ----------
    path : path
        VTU, legacy VTK, Gmsh, or another format of one file that meshio reads.

    Raises
    ------
    FileNotFoundError
        The file does not exist.
    CaseError
        (also `ValueError`) No linear tets, other volume elements beside them, an index that is not
        there, a node that is not finite.

    Examples
    --------
    >>> import cmfsim
    >>> nodes, tets = cmfsim.read_tet_mesh("mesh.vtu")
    """
    path = Path(path)
    mesh = read_mesh(path)
    tets = read_tets(mesh, path)[0].astype(np.uint32)
    return mesh.points, oriented(mesh.points, tets)[0]


def read_tets(mesh: PlainMesh, path: Path) -> tuple[NDArray[np.int64], dict[str, NDArray[Any]]]:
    """The linear tets of a mesh and their cell data."""
    blocks = [i for i, b in enumerate(mesh.cells) if b.type == "tetra" and len(b.data)]
    others = {b.type for b in mesh.cells if len(b.data)} - PASSED_OVER
    if not blocks or others:
        raise CaseInputError(f"{path.name}: linear tets are needed, found {mesh.found}")
    tets = np.concatenate([mesh.cells[i].data for i in blocks])
    data = {
        name: np.concatenate([values[i] for i in blocks]) for name, values in mesh.cell_data.items()
    }
    return tets, data
