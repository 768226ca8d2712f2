"""Meshes and images that other libraries hold in memory: meshio, PyVista, nibabel."""

from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from cmfsim._core import TetMesh
from cmfsim.errors import CaseInputError, ImageInputError
from cmfsim.io.images.image_files import placed
from cmfsim.io.images.image_headers import check_affine, check_shape
from cmfsim.io.meshes.mesh_files import read_tets
from cmfsim.io.meshes.plain_mesh import Cells, PlainMesh, in_space
from cmfsim.io.meshes.tets import oriented
from cmfsim.io.meshes.vtk.cells import cells_by_type
from cmfsim.io.surfaces import surface_of
from cmfsim.values.image_data import ImageData
from cmfsim.values.surface_data import SurfaceData

# nibabel's names of units of length, mm; others state none, and are mm.
UNITS = {"meter": 1000.0, "micron": 0.001}
RAS_TO_LPS = np.diag([-1.0, -1.0, 1.0])


def from_meshio(mesh: Any) -> TetMesh | SurfaceData:
    """The mesh of a `meshio.Mesh`: a `TetMesh` if it has tets, the surface of its triangles if not.

    Parameters
    ----------
    mesh : meshio.Mesh
        Points in LPS mm. Negative tets are turned; triangles of a mesh with tets are left out.

    Returns
    -------
    TetMesh or SurfaceData
        The surface with coincident vertices merged, as of `read_surface`.

    Raises
    ------
    CaseError
        (also `ValueError`) Other volume cells, no triangles, an index that is not there, a point
        that is not finite.
    MeshError
        (also `ValueError`) Tets without volume, or nodes that no tet uses: see `repair_tets`.

    Examples
    --------
    >>> import cmfsim, meshio
    >>> corners = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    >>> cmfsim.from_meshio(meshio.Mesh(corners, [("tetra", [[0, 2, 1, 3]])])).n_tets
    1
    """
    if not (hasattr(mesh, "points") and hasattr(mesh, "cells")):
        raise CaseInputError(f"a meshio.Mesh is needed, not {type(mesh).__name__}")
    cells = [Cells(str(b.type), np.asarray(b.data, dtype=np.int64)) for b in mesh.cells]
    return _mesh_of(PlainMesh(in_space(mesh.points), tuple(cells)), "meshio mesh")


def from_pyvista(mesh: Any) -> TetMesh | SurfaceData:
    """The mesh of PyVista: a `TetMesh` if it has tets, the surface of its triangles if not.

    Parameters
    ----------
    mesh : pyvista.UnstructuredGrid or pyvista.PolyData
        Points in LPS mm. Negative tets are turned; triangles of a mesh with tets are left out.

    Returns
    -------
    TetMesh or SurfaceData
        The surface with coincident vertices merged, as of `read_surface`.

    Raises
    ------
    CaseError, MeshError
        As `from_meshio`.

    Examples
    --------
    >>> import cmfsim, pyvista
    >>> surface = cmfsim.from_pyvista(pyvista.Sphere())
    >>> surface.vertices.shape
    (842, 3)
    """
    if not hasattr(mesh, "cast_to_unstructured_grid"):
        raise CaseInputError(f"one mesh of PyVista is needed, not {type(mesh).__name__}")
    grid = mesh.cast_to_unstructured_grid()
    cells, array_of = grid.GetCells(), import_module("pyvista").convert_array
    types, starts, corners = (
        np.asarray(array, dtype=np.int64)
        for array in (
            grid.celltypes,
            array_of(cells.GetOffsetsArray()),
            array_of(cells.GetConnectivityArray()),
        )
    )
    blocks, _ = cells_by_type(types, np.diff(starts), corners)
    return _mesh_of(PlainMesh(in_space(grid.points), blocks), "PyVista mesh")


def _mesh_of(mesh: PlainMesh, name: str) -> TetMesh | SurfaceData:
    if not len(mesh.cells_dict.get("tetra", ())):
        return surface_of(mesh, Path(name))
    tets = read_tets(mesh, Path(name))[0].astype(np.uint32)
    return TetMesh(mesh.points, oriented(mesh.points, tets)[0])


def from_nibabel(image: Any) -> ImageData:
    """The image of nibabel on an axis-aligned grid in LPS mm, as `read_image` gives that of a file.

    Parameters
    ----------
    image : nibabel image
        Three axes, one number per voxel; its affine leads to RAS. Millimetres, unless its header
        states another unit. Oblique axes are resampled (SimpleITK).

    Returns
    -------
    ImageData

    Raises
    ------
    ImageError
        (also `ValueError`) No affine, another number of axes, colours, voxels that are not finite,
        axes that span no space.

    Examples
    --------
    >>> import cmfsim, nibabel  # doctest: +SKIP
    >>> image = cmfsim.from_nibabel(nibabel.load("ct.nii.gz"))  # doctest: +SKIP
    >>> anatomy = cmfsim.segment_head(image)  # doctest: +SKIP
    """
    if getattr(image, "affine", None) is None or not hasattr(image, "dataobj"):
        raise ImageInputError(
            f"an image of nibabel with an affine is needed, not {type(image).__name__}"
        )
    name, shape = "nibabel image", [int(n) for n in image.shape]
    check_shape(name, shape)
    values = np.asanyarray(image.dataobj).reshape(shape[:3])
    units = getattr(image.header, "get_xyzt_units", lambda: ("mm", ""))()
    affine = RAS_TO_LPS @ np.asarray(image.affine)[:3] * UNITS.get(units[0], 1.0)
    if not np.isfinite(affine).all():
        raise ImageInputError(f"{name}: affine is not finite: {image.affine.tolist()}")
    check_affine(name, affine, (shape[0], shape[1], shape[2]))
    return placed(Path(name), values, affine, ()).image
