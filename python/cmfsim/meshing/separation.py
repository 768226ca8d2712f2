"""Meshes separated along an open surface, as lips that an image shows as one."""

from dataclasses import dataclass

from cmfsim import _core
from cmfsim._core import Surface, TetMesh
from cmfsim.values.checks import Indices
from cmfsim.values.surface_data import SurfaceData


@dataclass(frozen=True, eq=False)
class SeparatedMesh:
    """A mesh that was separated, and where its new nodes come from.

    mesh: Nodes keep their numbers; new ones follow.
    parents: (k, 2) uint32, of each new node, the ends of the edge that was cut there, or twice the
        node that it is a copy of.
    """

    mesh: TetMesh
    parents: Indices


def separated_mesh(mesh: TetMesh, surface: SurfaceData) -> SeparatedMesh:
    """The mesh separated along an open surface, as `part_mesh`, with the origin of its new nodes.

    Raises `MeshError`: The surface runs through no tissue.
    """
    return SeparatedMesh(*_core.part_mesh(mesh, Surface(surface.vertices, surface.triangles)))


def part_mesh(mesh: TetMesh, surface: SurfaceData) -> TetMesh:
    """The mesh separated along an open surface, such as lips that an image shows as one piece.

    Nodes close to the surface move onto it, and edges that still cross it are cut, so that both
    sides of the crack are as smooth as the surface.

    Parameters
    ----------
    mesh : TetMesh
    surface : SurfaceData
        Open; the crack ends at its rim, and at the boundary of the mesh where it reaches beyond.

    Returns
    -------
    TetMesh
        Its nodes keep their numbers; new ones on the crack follow them.

    Raises
    ------
    MeshError
        (also `ValueError`) The surface runs through no tissue.

    Examples
    --------
    >>> import cmfsim, numpy as np
    >>> mesh = cmfsim.mesh_from_labels(np.ones((12, 12, 12)) > 0, spacing=1.0)
    >>> corners = [[-9, -9, 5.6], [6, -9, 5.6], [6, 20, 5.6], [-9, 20, 5.6]]
    >>> sheet = cmfsim.SurfaceData(corners, [[0, 1, 2], [0, 2, 3]])
    >>> cmfsim.part_mesh(mesh, sheet).n_nodes > mesh.n_nodes
    True
    """
    return separated_mesh(mesh, surface).mesh
