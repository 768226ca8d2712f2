"""Surfaces keep the core's surface, with its search tree, and travel without it."""

import copy
import pickle

import numpy as np

import cmfsim


def tetrahedron() -> cmfsim.SurfaceData:
    corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    return cmfsim.SurfaceData(corners, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], 30.0)


def test_the_surface_of_the_core_is_made_once():
    surface = tetrahedron()
    assert surface.searched is surface.searched
    assert np.array_equal(surface.searched.vertices, surface.vertices)


def test_a_surface_that_was_searched_is_pickled_and_copied():
    surface = tetrahedron()
    closest, _, _ = surface.searched.closest([[2.0, 0.0, 0.0]])
    for other in (pickle.loads(pickle.dumps(surface)), copy.deepcopy(surface)):
        assert other.searched is not surface.searched
        assert other.crease_angle == surface.crease_angle
        assert np.array_equal(other.searched.closest([[2.0, 0.0, 0.0]])[0], closest)
