"""Meshes and images that other libraries hold in memory: meshio, PyVista, nibabel."""

import logging
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from cmfsim._core import TetMesh
from cmfsim.errors import CaseInputError, ImageInputError
from cmfsim.io.images.image_files import logged, placed
from cmfsim.io.images.image_headers import check_affine, check_shape
from cmfsim.io.meshes.mesh_files import read_tets
from cmfsim.io.meshes.plain_mesh import NAMES, Cells, PlainMesh, oriented
from cmfsim.io.meshes.surfaces import surface_of
from cmfsim.values.checks import as_floats
from cmfsim.values.image_data import ImageData
from cmfsim.values.surface_data import SurfaceData

_log = logging.getLogger(__name__)

# nibabel's names of units of length, mm; others state none, and are mm.
UNITS = {"meter": 1000.0, "micron": 0.001}
# Cells of a surface, and what is passed over beside them.
OF_SURFACE = {"triangle", "quad", "vertex", "line"}


def from_meshio(mesh: Any) -> TetMesh | SurfaceData:
    """The mesh of a `meshio.Mesh`: a `TetMesh` if it has tets, the surface of its triangles if not.

    Negative tets are turned; triangles of a mesh with tets are left out. Coincident vertices of a
    surface are merged, as by `read_surface`.

    Parameters
    ----------
    mesh : meshio.Mesh
        Points (n, 3) in LPS mm.

    Raises
    ------
    CaseError
        (also `ValueError`) No mesh, other volume cells, no triangles, an index that is not there or
        no whole number, a point that is not finite.
    MeshError
        (also `ValueError`) Tets without volume, or nodes that no tet uses: see `repair_tets`.

    Examples
    --------
    >>> import cmfsim, meshio
    >>> corners = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    >>> cmfsim.from_meshio(meshio.Mesh(corners, [("tetra", [[0, 2, 1, 3]])])).n_tets
    1
    """
    _check_kind(mesh, "cell_sets", "meshio.Mesh")
    return _mesh_of(mesh.points, [(str(b.type), b.data) for b in mesh.cells], "meshio mesh")


def from_pyvista(mesh: Any) -> TetMesh | SurfaceData:
    """The mesh of a PyVista data set, in LPS mm, as `from_meshio` makes it, with the same errors.

    Examples
    --------
    >>> import cmfsim, pyvista
    >>> cmfsim.from_pyvista(pyvista.Sphere()).vertices.shape
    (842, 3)
    """
    _check_kind(mesh, "cast_to_unstructured_grid", "PyVista data set")
    grid = mesh.cast_to_unstructured_grid()
    cells = [(NAMES.get(int(number), str(number)), c) for number, c in grid.cells_dict.items()]
    return _mesh_of(grid.points, cells, "PyVista mesh")


def _check_kind(mesh: Any, mark: str, wanted: str) -> None:
    kind = type(mesh).__name__
    if kind == "MultiBlock":
        raise CaseInputError("the mesh is a MultiBlock: give one of its blocks, or its combine()")
    if not hasattr(mesh, mark):
        raise CaseInputError(
            f"the mesh is of type {kind}: a {wanted} is needed; read_tet_mesh and read_surface "
            "read files"
        )


def _mesh_of(points: Any, cells: Iterable[tuple[str, Any]], name: str) -> TetMesh | SurfaceData:
    blocks = []
    for kind, given in cells:
        rows = np.asarray(given)
        if rows.size and rows.dtype.kind not in "iu":
            raise CaseInputError(
                f"{name}: {kind} cells have dtype {rows.dtype}: whole numbers are needed"
            )
        blocks.append(Cells(kind, rows.astype(np.int64)))
    mesh = PlainMesh(as_floats("points", points), tuple(blocks))
    if not len(mesh.cells_dict.get("tetra", ())):
        if {b.type for b in mesh.cells if len(b.data)} - OF_SURFACE:
            raise CaseInputError(
                f"{name}: linear tets or triangles are needed, found {mesh.found}: convert the "
                "cells first, such as by PyVista's linear_copy() and triangulate()"
            )
        return surface_of(mesh, Path(name))
    tets = read_tets(mesh, Path(name))[0].astype(np.uint32)
    return TetMesh(mesh.points, oriented(mesh.points, tets)[0])


def from_nibabel(image: Any) -> ImageData:
    """The image of nibabel on an axis-aligned grid in LPS mm, as `read_image` gives that of a file.

    Parameters
    ----------
    image : nibabel image
        (nx, ny, nz), one number per voxel; its affine leads to RAS, in mm unless its header states
        another unit; a warning is logged if its codes say that this is a guess. Oblique axes are
        resampled (SimpleITK).

    Raises
    ------
    ImageError
        (also `ValueError`) No affine, another number of axes, colours, voxels that are not finite,
        axes that span no space.

    Examples
    --------
    >>> image = cmfsim.from_nibabel(nibabel.load("ct.nii.gz"))  # doctest: +SKIP
    """
    if image.affine is None:
        raise ImageInputError("the image has no affine: its voxels have no place")
    name, shape = "nibabel image", [int(n) for n in image.shape]
    check_shape(name, shape)
    values = np.asanyarray(image.dataobj).reshape(shape[:3])
    units = getattr(image.header, "get_xyzt_units", lambda: ("mm",))()
    unit = UNITS.get(units[0], 1.0)
    affine = np.array([[-unit], [-unit], [unit]]) * np.asarray(image.affine)[:3]
    check_affine(name, affine, (shape[0], shape[1], shape[2]))
    asked = [getattr(image, get, None) for get in ("get_qform", "get_sform")]
    codes = [get(coded=True)[1] for get in asked if get is not None]
    if codes and not any(codes):
        _log.warning("%s: its codes qform and sform are 0: its axes are nibabel's guess", name)
    return logged(placed(Path(name), values, affine, ()))
