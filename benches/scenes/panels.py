"""Panels that bend: Cook's membrane (1974) and a cantilever, clamped on one side and sheared."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from benches.scenes.meshes import box

if TYPE_CHECKING:
    from numpy.typing import NDArray

    import cmfsim

    Floats = NDArray[np.float64]
    Indices = NDArray[np.uint32]

COOK = np.array([(0.0, 0.0), (48.0, 44.0), (48.0, 60.0), (0.0, 44.0)])
BEAM = np.array([(0.0, 0.0), (40.0, 0.0), (40.0, 8.0), (0.0, 8.0)])


def panel(cells: tuple[int, int, int], corners: Floats, depth: float) -> tuple[Floats, Indices]:
    """Nodes and tets of a slab over the quadrilateral `corners` (4, 2)."""
    nodes, tets = box(cells)
    s, t = nodes[:, :1], nodes[:, 1:2]
    a, b, c, d = corners
    flat = (1 - s) * (1 - t) * a + s * (1 - t) * b + s * t * c + (1 - s) * t * d
    return np.column_stack([flat, depth * nodes[:, 2]]), tets


def far_side_loads(
    mesh: cmfsim.TetMesh, tensors: cmfsim.MassTensors, corners: Floats, load: float
) -> Floats:
    """Nodal forces of a uniform traction of `load` N along y on the side at the greatest x.

    A third of each triangle goes to its corners, or if quadratic to its mid-edges.
    """
    nodes = np.asarray(mesh.nodes)
    middles = {tuple(edge): mesh.n_nodes + i for i, edge in enumerate(tensors.mid_edges.tolist())}
    loads = np.zeros(tensors.nodes.shape)
    for triangle in mesh.boundary_triangles():
        if np.all(nodes[triangle, 0] > corners[2, 0] - 1e-9):
            sides = nodes[triangle[1:]] - nodes[triangle[0]]
            a, b, c = np.sort(triangle).tolist()
            edges = ((a, b), (a, c), (b, c))
            ends = [middles[edge] for edge in edges] if middles else [a, b, c]
            loads[ends, 1] += np.linalg.norm(np.cross(*sides)) / 6
    scaled: Floats = loads * (load / loads.sum())
    return scaled
