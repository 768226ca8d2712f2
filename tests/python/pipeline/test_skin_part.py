"""Which part of a mesh's boundary is skin, known on a ball."""

import numpy as np
import pytest

import cmfsim
from benches.scenes import meshes
from cmfsim.pipeline.building import skin as skin_part

RADIUS = 30.0


def level(function):
    axis = np.arange(-40.0, 41.0)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    return cmfsim.ImageData(function(points), (1.0, 1.0, 1.0), (-40.0, -40.0, -40.0))


@pytest.fixture(scope="module")
def ball():
    vertices, triangles = meshes.icosphere(3, RADIUS)
    skin = level(lambda x: RADIUS - np.linalg.norm(x, axis=-1))
    return np.asarray(vertices), np.asarray(triangles, dtype=np.uint32), skin


def found(ball, bone):
    vertices, triangles, skin = ball
    anatomy = cmfsim.Anatomy(skin=skin, bones={"cranium": level(bone)})
    return skin_part.on_skin(vertices, triangles, anatomy, skin)


def test_bone_that_touches_the_skin_makes_no_hole_in_it(ball, monkeypatch):
    vertices, triangles, _ = ball
    centroid = vertices[triangles[100]].mean(axis=0)
    outward = centroid / np.linalg.norm(centroid)

    def bone(x):
        """A stud whose flat end, exact on the grid, lies in the triangle."""
        return np.minimum((centroid - x) @ outward, 4.0 - np.linalg.norm(x - centroid, axis=-1))

    assert found(ball, bone).all()
    monkeypatch.setattr(skin_part, "LEAST_PATCH", 0.0)
    alone = found(ball, bone)
    assert not alone[100]
    assert alone.sum() > len(triangles) - 10


def test_bone_that_bounds_half_of_the_tissue_stays_bone(ball):
    """Bone outside the ball's lower half, so that its surface is the ball's there."""

    def bone(x):
        return np.minimum(np.linalg.norm(x, axis=-1) - RADIUS, -2.0 - x[..., 2])

    vertices, triangles, _ = ball
    # Inside a triangle the ball bulges over it, as far from skin as from bone: bone lies nearer.
    height = vertices[triangles].mean(axis=1)[:, 2]
    chosen = found(ball, lambda x: bone(x) + 0.05)
    assert chosen[height > 0.0].all()
    assert not chosen[height < -6.0].any()


def test_the_wall_of_a_small_cavity_is_no_skin(ball):
    vertices, triangles, skin = ball
    wall, corners = meshes.icosphere(1, 2.0)
    nodes = np.concatenate([vertices, np.asarray(wall)])
    both = np.concatenate([triangles, np.asarray(corners)[:, ::-1] + len(vertices)])
    cavity = level(lambda x: 2.0 - np.linalg.norm(x, axis=-1))
    anatomy = cmfsim.Anatomy(skin=skin, bones={"cranium": cavity})
    chosen = skin_part.on_skin(nodes, both.astype(np.uint32), anatomy, skin)
    assert chosen[: len(triangles)].all()
    assert not chosen[len(triangles) :].any()
