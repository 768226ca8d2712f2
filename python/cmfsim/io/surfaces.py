"""Triangle surfaces in STL, PLY, OBJ and VTP: reading into LPS mm, and writing."""

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from cmfsim.checks import check_one_of
from cmfsim.errors import CaseInputError
from cmfsim.io.files import replacing
from cmfsim.io.meshes import read_mesh
from cmfsim.io.vtk import data_array, write_vtk
from cmfsim.patient import FRAMES, UNITS
from cmfsim.scene import MovedSurface, SurfaceData

__all__ = [
    "read_moved_surface",
    "read_surface",
    "read_triangles",
    "surface_suffixes",
    "write_surface",
]


def read_surface(
    path: str | os.PathLike[str],
    crease_angle: float = 60.0,
    *,
    units: str = "mm",
    frame: str = "LPS",
) -> SurfaceData:
    """The triangles of a file, in LPS mm, with vertices in the same place made one.

    Parameters
    ----------
    path : path
        STL, PLY, OBJ, VTP, or another file of triangles that meshio reads.
    crease_angle : float, degrees
    units : str
        Of the numbers in the file: "mm", "cm", "m", "um", "inch".
    frame : str
        Of the numbers in the file: "LPS" or "RAS".

    Returns
    -------
    SurfaceData

    Raises
    ------
    FileNotFoundError
        The file does not exist.
    CaseError
        (also `ValueError`) Not a surface, no triangles, a coordinate that is not finite.

    Examples
    --------
    >>> import cmfsim
    >>> skin = cmfsim.read_surface("skin.stl", units="mm", frame="RAS")  # doctest: +SKIP
    """
    check_one_of("units", units, tuple(UNITS))
    check_one_of("frame", frame, FRAMES)
    surface = read_triangles(Path(path), crease_angle)
    if units == "mm" and frame == "LPS":
        return surface
    # RAS to LPS is half a turn about the long axis: triangles keep their orientation.
    signs = np.array([-1.0, -1.0, 1.0] if frame == "RAS" else [1.0, 1.0, 1.0])
    vertices = np.asarray(surface.vertices) * (UNITS[units] * signs)
    return SurfaceData(vertices, surface.triangles, crease_angle)


def read_moved_surface(
    before: str | os.PathLike[str],
    after: str | os.PathLike[str],
    *,
    units: str = "mm",
    frame: str = "LPS",
) -> MovedSurface:
    """The motion of a bone given by its surface before and after, vertex by vertex.

    Parameters
    ----------
    before, after : path
        Files with the same vertices in the same order.
    units, frame : str
        Of the numbers in both files.

    Returns
    -------
    MovedSurface

    Raises
    ------
    FileNotFoundError
        A file does not exist.
    CaseError
        (also `ValueError`) Not surfaces; other vertices or triangles; a vertex that is not finite.

    Examples
    --------
    >>> import cmfsim
    >>> motion = cmfsim.read_moved_surface("mandible.ply", "mandible_post.ply")  # doctest: +SKIP
    """
    check_one_of("units", units, tuple(UNITS))
    check_one_of("frame", frame, FRAMES)
    scale = UNITS[units] * np.array([-1.0, -1.0, 1.0] if frame == "RAS" else [1.0, 1.0, 1.0])
    (here, triangles), (there, moved_triangles) = (
        _numbered(Path(path)) for path in (before, after)
    )
    names = f"{Path(after).name} has {{}}, {Path(before).name} {{}}"
    for what, a, b in (
        ("vertices", len(there), len(here)),
        ("triangles", len(moved_triangles), len(triangles)),
    ):
        if a != b:
            raise CaseInputError(f"{names.format(f'{a} {what}', b)}: {SAME_NEEDED}")
    other_corners = np.flatnonzero((triangles != moved_triangles).any(axis=1))
    if len(other_corners):
        first = int(other_corners[0])
        raise CaseInputError(
            f"{names.format(f'triangle {first} at other vertices', 'at its own')}: {SAME_NEEDED}"
        )
    if not np.isfinite(there).all():
        vertex = int(np.flatnonzero(~np.isfinite(there).all(axis=1))[0])
        raise CaseInputError(f"{Path(after).name}: vertex {vertex} is not finite")
    # One place with two motions is two vertices: there the bone was cut.
    kept, number = _welded(np.concatenate([here, there], axis=1))
    rest = SurfaceData(here[kept] * scale, number[triangles])
    return MovedSurface(rest, there[kept] * scale)


SAME_NEEDED = (
    "the same vertices and triangles in the same order are needed; where the bone was segmented or "
    'remeshed anew, name it in [postoperative.bones] and write plan = "achieved", which lays the '
    "bone before on the one after"
)


def read_triangles(path: Path, crease_angle: float = 60.0) -> SurfaceData:
    """A surface with vertices in the same place made one: STL repeats them for each triangle."""
    mesh = read_mesh(path)
    triangles = _triangles(mesh, path)
    points = np.asarray(mesh.points)
    kept, number = _welded(points)
    return SurfaceData(points[kept], number[triangles], crease_angle)


def _numbered(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The vertices and triangles of a file as it numbers them; STL has corners alone."""
    mesh = read_mesh(path)
    triangles = _triangles(mesh, path)
    points = np.asarray(mesh.points, dtype=np.float64)
    if path.suffix.lower() == ".stl":
        points = points[triangles].reshape(-1, 3)
        triangles = np.arange(len(points)).reshape(-1, 3)
    return points, triangles


def _triangles(mesh: Any, path: Path) -> NDArray[np.int64]:
    """The triangles of a mesh that has nothing else."""
    triangles = [b.data for b in mesh.cells if b.type == "triangle"]
    if not triangles or any(b.type not in {"triangle", "vertex", "line"} for b in mesh.cells):
        found = ", ".join(sorted({b.type for b in mesh.cells})) or "nothing"
        raise CaseInputError(f"{path.name}: a surface of triangles is needed, found {found}")
    return np.concatenate(triangles).astype(np.int64)


def _welded(rows: NDArray[Any]) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
    """The rows that are kept when equal ones become one, and the number each row then has."""
    _, first, back = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    # In the order of the file, so that a surface without repetitions keeps its numbers.
    order = np.argsort(first)
    number = np.empty(len(first), dtype=np.int64)
    number[order] = np.arange(len(first))
    return first[order], number[back.reshape(-1)]


def write_surface(path: str | os.PathLike[str], surface: SurfaceData) -> None:
    """Writes a surface as `.ply`, `.stl`, `.obj` or `.vtp`, LPS mm.

    An existing file is replaced in one step. PLY, OBJ and VTP keep every digit; STL has single
    precision and repeats the vertices of each triangle.

    Parameters
    ----------
    path : path
    surface : SurfaceData

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
        WRITERS[path.suffix](file, surface)


def surface_suffixes() -> tuple[str, ...]:
    """The file endings that `write_surface` knows."""
    return tuple(WRITERS)


def _write_ply(file: BinaryIO, surface: SurfaceData) -> None:
    vertices = np.asarray(surface.vertices, dtype="<f8")
    triangles = np.asarray(surface.triangles)
    rows = np.zeros(len(triangles), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    rows["count"] = 3
    rows["corners"] = triangles
    file.write(
        (
            "ply\nformat binary_little_endian 1.0\ncomment LPS mm\n"
            f"element vertex {len(vertices)}\n"
            "property double x\nproperty double y\nproperty double z\n"
            f"element face {len(triangles)}\n"
            "property list uchar int vertex_indices\nend_header\n"
        ).encode()
    )
    file.write(vertices.tobytes())
    file.write(rows.tobytes())


def _write_stl(file: BinaryIO, surface: SurfaceData) -> None:
    corners = np.asarray(surface.vertices)[np.asarray(surface.triangles)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    # A triangle without area has no normal: zeros, as the format allows.
    normals = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0.0)
    rows = np.zeros(len(corners), dtype=[("n", "<f4", 3), ("v", "<f4", (3, 3)), ("a", "<u2")])
    rows["n"], rows["v"] = normals, corners
    file.write(b"cmfsim LPS mm".ljust(80, b" "))
    file.write(np.uint32(len(corners)).astype("<u4").tobytes())
    file.write(rows.tobytes())


def _write_obj(file: BinaryIO, surface: SurfaceData) -> None:
    file.write(b"# LPS mm\n")
    lines = [f"v {x!r} {y!r} {z!r}\n" for x, y, z in np.asarray(surface.vertices).tolist()]
    lines += [f"f {a} {b} {c}\n" for a, b, c in (np.asarray(surface.triangles) + 1).tolist()]
    file.write("".join(lines).encode())


def _write_vtp(file: BinaryIO, surface: SurfaceData) -> None:
    vertices = np.asarray(surface.vertices, dtype=np.float64)
    triangles = np.asarray(surface.triangles)
    n = len(triangles)
    polys = data_array("connectivity", triangles.reshape(-1).astype(np.int64)) + data_array(
        "offsets", 3 * np.arange(1, n + 1, dtype=np.int64)
    )
    write_vtk(
        file,
        "PolyData",
        f'<Piece NumberOfPoints="{len(vertices)}" NumberOfVerts="0" NumberOfLines="0" '
        f'NumberOfStrips="0" NumberOfPolys="{n}"><Points>{data_array("points", vertices)}</Points>'
        f"<Polys>{polys}</Polys></Piece>",
    )


WRITERS: Mapping[str, Callable[[BinaryIO, SurfaceData], None]] = MappingProxyType(
    {".ply": _write_ply, ".stl": _write_stl, ".obj": _write_obj, ".vtp": _write_vtp}
)
