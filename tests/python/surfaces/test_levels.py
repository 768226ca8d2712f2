"""Surfaces of levels: closed, of the right size, without vertices that belong to nothing."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import cmfsim
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
