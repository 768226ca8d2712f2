"""A small box of tets, its solver and a floor, and how its errors must be."""

import numpy as np
import pytest

import cmfsim
from benches.scenes import meshes

NODES, TETS = meshes.box((2, 2, 2), (4.0, 4.0, 4.0))
LOW = meshes.nodes_where(NODES[:, 2] == 0.0)
HIGH = meshes.nodes_where(NODES[:, 2] == 4.0)
EYE = np.eye(4)


def refused(error, pattern):
    """An error of this family that is a ValueError too and whose text matches."""

    class Refused:
        def __enter__(self):
            self.context = pytest.raises(error, match=pattern)
            self.caught = self.context.__enter__()

        def __exit__(self, *exception):
            result = self.context.__exit__(*exception)
            assert isinstance(self.caught.value, ValueError)
            return result

    return Refused()


def tensors(nodes=NODES, tets=TETS, tissue=None):
    return cmfsim.MassTensors(
        cmfsim.TetMesh(nodes, tets), tissue or cmfsim.Tissue.isotropic(0.5, 0.3)
    )


def solver(boundary, **options):
    return cmfsim.StaticSolver(tensors(), boundary, **options)


def floor(half_width=10.0, flip=False):
    vertices, triangles = meshes.plane(half_width)
    return cmfsim.Surface(vertices + [2, 2, 0], triangles[:, ::-1] if flip else triangles)
