"""Surfaces of levels: closed, of the right size, without vertices that belong to nothing."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import cmfsim
from cmfsim import _core
from cmfsim.surfaces.levels import SurfaceOptions, detailed_surface, surface_of_level

pytest.importorskip("skimage")
pytest.importorskip("scipy")


def test_a_voxel_that_is_hardly_inside_leaves_no_vertex():
    """All vertices of its surface fall together: smoothing divided them by no neighbour."""
    x, y, z = np.indices((24, 24, 24))
    values = np.clip(6.0 - np.sqrt((x - 9.0) ** 2 + (y - 9.0) ** 2 + (z - 9.0) ** 2), -1.0, 1.0)
    values[20, 20, 20] = 1e-30
    level = cmfsim.ImageData(values.astype(np.float32), (1.0, 1.0, 1.0))
    for smoothing in (0, 6):
        surface = surface_of_level("ball", level, SurfaceOptions(smoothing=smoothing))
        assert np.isfinite(surface.vertices).all()
        np.testing.assert_array_equal(
            np.unique(surface.triangles), np.arange(len(surface.vertices))
        )
        assert np.abs(np.linalg.norm(surface.vertices - 9.0, axis=1) - 6.0).max() < 0.2


def test_a_detailed_surface_is_made_once_and_its_error_stays():
    """Segmentation makes the skin's beside other work; landmarks wait for the same one."""
    x, y, z = np.indices((24, 24, 24))
    values = 6.0 - np.sqrt((x - 9.0) ** 2 + (y - 9.0) ** 2 + (z - 9.0) ** 2)
    level = cmfsim.ImageData(values.astype(np.float32), (1.0, 1.0, 1.0))
    with ThreadPoolExecutor(4) as pool:
        first, *others = pool.map(lambda _: detailed_surface("skin", level), range(4))
    assert all(other is first for other in others)
    np.testing.assert_array_equal(first.vertices, surface_of_level("skin", level).vertices)
    empty = level.with_values(-np.abs(level.values) - 1.0)
    for _ in range(2):
        with pytest.raises(cmfsim.CaseError, match="no voxel inside"):
            detailed_surface("skin", empty)


def test_smoothing_moves_each_vertex_towards_the_mean_of_its_neighbours():
    """An octahedron: each vertex has four neighbours, and two edges pass each of them."""
    places = np.random.default_rng(0).normal(size=(6, 3))
    triangles = [[a, b, c] for a in (0, 1) for b in (2, 3) for c in (4, 5)]
    triangles = [t if sum(t) % 2 else t[::-1] for t in triangles]
    expected = places.copy()
    for step in (0.5, -0.53):
        means = [expected[[k for k in range(6) if k // 2 != j // 2]].mean(axis=0) for j in range(6)]
        expected = expected + step * (np.array(means) - expected)
    found = _core.smoothed(places, triangles, [0.5, -0.53])
    assert np.abs(found - expected).max() < 1e-15
    assert np.array_equal(_core.smoothed(places, triangles, []), places)
    with pytest.raises(cmfsim.MeshError, match="triangles have vertex 6; there are 6"):
        _core.smoothed(places, [[0, 1, 6]], [0.5])


def test_surfaces_are_decimated_to_the_wanted_size_and_stay_closed():
    image = cmfsim.ImageData(np.zeros((50, 50, 50)), (1, 1, 1))
    x, y, z = image.axes()
    wave = 3.0 * np.sin(x / 3) * np.sin(y / 3)
    ball = 20 - np.sqrt((x - 25) ** 2 + (y - 25) ** 2 + (z - 25 - wave) ** 2)
    level = image.with_values(np.clip(ball, -2, 2))
    fine = surface_of_level("ball", level)
    coarse = surface_of_level("ball", level, SurfaceOptions(max_triangles=1500))
    assert len(fine.triangles) > 6000
    assert abs(len(coarse.triangles) - 1500) < 50
    surfaces = [cmfsim.Surface(s.vertices, s.triangles) for s in (fine, coarse)]
    assert all(s.is_closed for s in surfaces)
    assert surfaces[1].volume == pytest.approx(surfaces[0].volume, rel=0.01)
    closest, _, _ = surfaces[1].closest(fine.vertices)
    assert np.linalg.norm(closest - fine.vertices, axis=1).max() < 1.0
    with pytest.raises(cmfsim.MeshError, match=r"triangles have vertex 9; there are 3"):
        _core.decimated(np.zeros((3, 3)), [[0, 1, 9]], 1)
