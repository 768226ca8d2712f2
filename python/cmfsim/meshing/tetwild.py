"""Tets by fTetWild (Hu et al. 2020), the optional other way, from a closed surface."""

import contextlib
import os
import tempfile
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import numpy as np

from cmfsim._core import TetMesh
from cmfsim.errors import MeshInputError
from cmfsim.values.checks import as_positive
from cmfsim.values.surface_data import SurfaceData


def mesh_with_tetwild(surface: SurfaceData, edge_length: float = 3.0) -> TetMesh:
    """The tets inside a closed surface, by the optional package pytetwild (MPL-2.0).

    Parameters
    ----------
    surface : SurfaceData
    edge_length : float, mm

    Raises
    ------
    MeshError
        (also `ValueError`) pytetwild is not installed, or finds no tets.

    Examples
    --------
    >>> import cmfsim
    >>> mesh = cmfsim.mesh_with_tetwild(surface, 3.0)  # doctest: +SKIP
    """
    as_positive("edge_length", edge_length)
    try:
        tetwild = import_module("pytetwild")
    except ModuleNotFoundError as error:
        raise MeshInputError(
            "meshing with fTetWild needs pytetwild: pip install '.[tetwild]' in cmfsim's folder; "
            "mesh_from_labels and mesh_from_level need nothing"
        ) from error
    with _elsewhere():
        nodes, tets = tetwild.tetrahedralize(
            np.array(surface.vertices, dtype=np.float64),
            np.array(surface.triangles, dtype=np.int32),
            edge_length_abs=edge_length,
        )[:2]
    if not len(tets):
        raise MeshInputError(
            "fTetWild found no tets: check that the surface is closed and that "
            "its normals point outwards"
        )
    corners = nodes[tets]
    edges = corners[:, 1:] - corners[:, :1]
    inverted = np.linalg.det(edges) < 0.0
    tets[inverted] = tets[inverted][:, [0, 1, 3, 2]]
    return TetMesh(nodes, tets)


@contextlib.contextmanager
def _elsewhere() -> Iterator[None]:
    """Another current folder for a while: fTetWild leaves a file in it."""
    before = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            yield
        finally:
            os.chdir(before)
