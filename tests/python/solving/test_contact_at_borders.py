"""Contact with a surface that ends where nodes press on it.

The surface is a slope that pushes nodes beyond its own border. Without its plane such a node comes
back, with it the node leaves again: rounds that do not keep the plane never end.
"""

import numpy as np
import pytest

import cmfsim
from benches.scenes import meshes

SIZE = (8.0, 8.0, 4.0)
SLOPE, START = 2.0, 0.1


@pytest.fixture(scope="module")
def block():
    """Tensors of a soft block, and the nodes of its bottom and top."""
    nodes, tets = meshes.box((6, 6, 3), SIZE)
    tissue = cmfsim.Tissue.isotropic(np.full(len(tets), 0.003), 0.4)
    tensors = cmfsim.MassTensors(cmfsim.TetMesh(nodes, tets), tissue)
    return tensors, np.flatnonzero(nodes[:, 2] == 0.0), np.flatnonzero(nodes[:, 2] == SIZE[2])


def pressed(block, border, way):
    """The block lifted by `way` against a slope over x < `border`."""
    tensors, bottom, top = block
    vertices, triangles = meshes.plane(6.0, 12)
    vertices = vertices + [border - 6.0, 0.5 * SIZE[1], 0.0]
    vertices[:, 2] = SIZE[2] + START + SLOPE * (vertices[:, 0] - border)
    slope = cmfsim.Surface(vertices, triangles[:, ::-1])
    boundary = cmfsim.Boundary(joined={"bottom": bottom}, obstacles=[(top, None, slope)])
    return cmfsim.StaticSolver(tensors, boundary).solve(
        {"bottom": cmfsim.rigid_motion((0.0, 0.0, way))}
    )


@pytest.mark.parametrize(
    ("border", "way"), [(3.7, 1.0), (3.8, 1.0), (5.05, 1.0), (3.9, 1.6), (4.1, 1.6), (5.2, 1.6)]
)
def test_a_node_that_is_pushed_beyond_a_border_comes_to_rest(block, border, way):
    found = pressed(block, border, way)
    assert found.touching_converged, found.touching_rounds
    assert found.touching_rounds <= 30
    assert found.touching_forces.sum() > 1e-3
    assert found.penetration <= 5e-3
    assert found.error_estimate < 0.05


def test_the_face_changes_little_where_the_border_does(block):
    # Nodes of the top that press at the border: 0.01 mm of it move none by a tenth of an edge.
    places = [pressed(block, border, 1.0).displacements for border in (3.79, 3.8, 3.81)]
    assert np.linalg.norm(np.diff(places, axis=0), axis=2).max() < 0.1
