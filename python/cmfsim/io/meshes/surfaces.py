"""Triangle surfaces in STL, PLY, OBJ and VTP: reading into LPS mm, and writing."""

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError, UnpairedError
from cmfsim.io.files.reading_writing import named, replacing
from cmfsim.io.meshes.mesh_files import read_mesh
from cmfsim.io.meshes.obj import write_obj
from cmfsim.io.meshes.plain_mesh import PlainMesh, triangles_of
from cmfsim.io.meshes.ply import write_ply
from cmfsim.io.meshes.stl import write_stl
from cmfsim.io.meshes.vtk_writing import write_triangles
from cmfsim.values.case_parts import FRAMES, UNITS
from cmfsim.values.checks import AnyPath, Floats, check_one_of
from cmfsim.values.finding import Finding
from cmfsim.values.surface_data import MovedSurface, SurfaceData

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class SurfaceFile:
    """A surface with the frame that its file states, if it does, and what was found on it."""

    surface: SurfaceData
    frame: str | None = None
    findings: tuple[Finding, ...] = ()


def read_surface(
    path: AnyPath, crease_angle: float = 60.0, *, units: str = "mm", frame: str | None = None
) -> SurfaceData:
    """The triangles of a file, in LPS mm, with coincident vertices merged.

    Parameters
    ----------
    path : path
        STL, PLY, OBJ, VTP, VTU, legacy VTK, Gmsh, or another file of triangles that meshio reads.
        Polygons are split into triangles if a fan fills them.
    crease_angle : float, degrees
    units : str
        Of the numbers in the file: "mm", "cm", "m", "um", "inch".
    frame : str, optional
        Of the numbers in the file: "LPS" or "RAS". Default: the frame in the file's header, as 3D
        Slicer writes it (`SPACE=RAS`); LPS if it states none.

    Raises
    ------
    FileNotFoundError
        The file does not exist.
    CaseError
        (also `ValueError`) Not a surface, no triangles, cut short, an index that is not there, a
        coordinate that is not finite; another frame than the file's header states.

    Examples
    --------
    >>> import cmfsim
    >>> skin = cmfsim.read_surface("skin.stl", units="mm", frame="RAS")
    """
    read = read_surface_file(path, crease_angle, units=units, frame=frame)
    for finding in read.findings:
        _log.warning("%s: %s", finding.where, finding.what)
    return read.surface


def read_surface_file(
    path: AnyPath, crease_angle: float = 60.0, *, units: str = "mm", frame: str | None = None
) -> SurfaceFile:
    """As `read_surface`, with what was ignored on reading, for those who report it."""
    read = surface_as_stored(Path(path), crease_angle)
    scale = _scale(Path(path), units, frame, read.frame)
    if (scale == 1.0).all():
        return read
    surface = SurfaceData(read.surface.vertices * scale, read.surface.triangles, crease_angle)
    return replace(read, surface=surface)


def _scale(path: Path, units: str, frame: str | None, stated: str | None) -> NDArray[np.float64]:
    """What takes the numbers of a file to LPS mm, axis by axis."""
    check_one_of("units", units, tuple(UNITS))
    if frame is not None:
        check_one_of("frame", frame, FRAMES)
    if frame is not None and stated is not None and frame != stated:
        raise CaseInputError(
            f"{path.name}: its header states {stated}, and frame is {frame}: remove frame (it is "
            "for files that state none), or export the file again"
        )
    # RAS to LPS is half a turn about the long axis: triangles keep their orientation.
    signs = [-1.0, -1.0, 1.0] if (frame or stated) == "RAS" else [1.0, 1.0, 1.0]
    return UNITS[units] * np.array(signs)


def read_moved_surface(
    before: AnyPath, after: AnyPath, *, units: str = "mm", frame: str | None = None
) -> MovedSurface:
    """The motion of a bone given by its surface before and after, vertex by vertex.

    Parameters
    ----------
    before, after : path
        Files with the same vertices in the same order.
    units : str
        Of the numbers in both files.
    frame : str, optional
        As in `read_surface`.

    Raises
    ------
    FileNotFoundError
        A file does not exist.
    CaseError
        (also `ValueError`) Not surfaces; other vertices or triangles; a vertex that is not finite.

    Examples
    --------
    >>> import cmfsim
    >>> motion = cmfsim.read_moved_surface("mandible.ply", "mandible_post.ply")
    """
    (here, triangles, its), (there, moved_triangles, other) = (
        _numbered(Path(path)) for path in (before, after)
    )
    scale = _scale(Path(before), units, frame, its)
    there *= _scale(Path(after), units, frame, other) / scale
    names = f"{Path(after).name} has {{}}, {Path(before).name} {{}}"
    for what, a, b in (
        ("vertices", len(there), len(here)),
        ("triangles", len(moved_triangles), len(triangles)),
    ):
        if a != b:
            raise UnpairedError(f"{names.format(f'{a} {what}', b)}: {SAME_NEEDED}")
    other_corners = np.flatnonzero((triangles != moved_triangles).any(axis=1))
    if len(other_corners):
        first = int(other_corners[0])
        raise UnpairedError(
            f"{names.format(f'triangle {first} at other vertices', 'at its own')}: {SAME_NEEDED}"
        )
    # One place with two motions is two vertices: there the bone was cut.
    kept, number = _welded(np.concatenate([here, there], axis=1))
    rest = SurfaceData(here[kept] * scale, number[triangles])
    return MovedSurface(rest, there[kept] * scale)


def read_bone_pair(
    before: AnyPath, after: AnyPath, *, units: str = "mm", frame: str | None = None
) -> MovedSurface | tuple[SurfaceData, SurfaceData]:
    """A bone before and after: followed by its vertices if the triangles are the same, or both."""
    try:
        return read_moved_surface(before, after, units=units, frame=frame)
    except UnpairedError:
        one, other = (read_surface(path, units=units, frame=frame) for path in (before, after))
        return one, other


SAME_NEEDED = (
    "the same vertices and triangles in the same order are needed; if the bone was segmented or "
    'remeshed, list it in [postoperative.bones] and write plan = "achieved", which registers the '
    "bone before to the one after"
)


def surface_as_stored(path: Path, crease_angle: float = 60.0) -> SurfaceFile:
    """A surface in the file's own numbers; STL's copies of a vertex are made one."""
    mesh = read_mesh(path)
    surface = surface_of(mesh, path, crease_angle)
    findings = tuple(replace(finding, where=path.name) for finding in mesh.findings)
    return SurfaceFile(surface, mesh.frame, findings)


def surface_of(mesh: PlainMesh, path: Path, crease_angle: float = 60.0) -> SurfaceData:
    """The triangles of a mesh, with vertices in the same place made one; `path` names it."""
    triangles = _triangles(mesh, path)
    kept, number = _welded(mesh.points)
    return SurfaceData(mesh.points[kept], number[triangles], crease_angle)


def _numbered(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64], str | None]:
    """The vertices and triangles of a file as it numbers them (STL: corners), and its frame."""
    mesh = read_mesh(path)
    triangles = _triangles(mesh, path)
    points = np.array(mesh.points, dtype=np.float64)
    if path.suffix.lower() == ".stl":
        points = points[triangles].reshape(-1, 3)
        triangles = np.arange(len(points)).reshape(-1, 3)
    return points, triangles, mesh.frame


def _triangles(mesh: PlainMesh, path: Path) -> NDArray[np.int64]:
    """The triangles of a mesh that has nothing else but polygons; quads are cut."""
    faces = [b.data for b in mesh.cells if b.type in {"triangle", "quad"} and len(b.data)]
    others = {b.type for b in mesh.cells if len(b.data)} - {"triangle", "quad", "vertex", "line"}
    if not faces or others:
        raise CaseInputError(f"{path.name}: a surface of triangles is needed, found {mesh.found}")
    with named(path):
        return np.concatenate(
            [
                triangles_of(mesh.points, np.full(len(data), data.shape[1]), data.reshape(-1))
                for data in faces
            ]
        )


def _welded(rows: NDArray[Any]) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
    """The rows that are kept when equal ones become one, and the number each row then has."""
    order = np.lexsort(rows.T)
    in_order = rows[order]
    begins = np.concatenate([[True], (in_order[1:] != in_order[:-1]).any(axis=1)])[: len(rows)]
    # Equal rows keep the order of the file: the first of each group is the first in it.
    first = order[begins]
    back = np.empty(len(rows), dtype=np.int64)
    back[order] = np.cumsum(begins) - 1
    # In the order of the file, so that a surface without repetitions keeps its numbers.
    rise = np.argsort(first)
    number = np.empty(len(first), dtype=np.int64)
    number[rise] = np.arange(len(first))
    return first[rise], number[back]


def write_surface(path: AnyPath, surface: SurfaceData) -> None:
    """Writes a surface as `.ply`, `.stl`, `.obj` or `.vtp`, LPS mm.

    An existing file is replaced in one step. PLY, OBJ and VTP keep every digit; STL has single
    precision and repeats the vertices of each triangle.

    Raises
    ------
    CaseError
        (also `ValueError`) Another ending.
    OSError
        The folder cannot be written to.

    Examples
    --------
    >>> import cmfsim
    >>> triangle = cmfsim.SurfaceData([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    >>> cmfsim.write_surface("triangle.stl", triangle)
    """
    path = Path(path)
    if path.suffix not in WRITERS:
        known = ", ".join(WRITERS)
        raise CaseInputError(f"{path.name}: a surface is written as {known}, not {path.suffix!r}")
    with replacing(path) as file:
        WRITERS[path.suffix](file, surface.vertices, surface.triangles)


def _write_vtp(file: BinaryIO, vertices: Floats, triangles: NDArray[np.integer]) -> None:
    write_triangles(file, vertices, triangles, {})


WRITERS: Mapping[str, Callable[[BinaryIO, NDArray[np.float64], NDArray[np.integer]], None]] = (
    MappingProxyType({".ply": write_ply, ".stl": write_stl, ".obj": write_obj, ".vtp": _write_vtp})
)
