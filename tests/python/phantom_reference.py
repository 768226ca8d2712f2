"""The CT phantom's reference surfaces, and how far a segmentation is from them."""

import numpy as np
from skimage import measure

from real_heads import core_surface


def reference():
    """Skin, bone and mandible, ready to be searched."""
    return {name: core_surface("ct_phantom", name) for name in ("skin", "bone", "mandible")}


def dice(a, b):
    return 2.0 * np.count_nonzero(a & b) / (np.count_nonzero(a) + np.count_nonzero(b))


def surface_points(level):
    """Vertices of the zero set, mm."""
    spacing = np.asarray(level.spacing)
    values = np.pad(level.values, 1, constant_values=-1.0)
    points = measure.marching_cubes(values, 0.0, spacing=tuple(spacing))[0]
    return points + level.lowest - spacing


def distances(points, surface):
    closest = surface.closest(points)[0]
    return np.linalg.norm(points - closest, axis=1)


def face(points):
    """The frontal part of the phantom, from the neck to the vertex."""
    return points[(points[:, 1] < -200.0) & (points[:, 2] > 322.0) & (points[:, 2] < 520.0)]


def parted_as(anatomy, reference):
    """Dice of the mandible with the reference."""
    level = anatomy.bones["mandible"]
    grid = np.stack(np.broadcast_arrays(*level.axes()), axis=-1)
    low, high = np.array([-65.0, -307.0, 322.0]), np.array([70.0, -196.0, 412.0])
    near = ((grid > low) & (grid < high)).all(axis=-1)
    truth = reference["mandible"].winding_number(grid[near]) > 0.5
    assert np.count_nonzero((level.values > 0.0) & ~near) < 0.01 * np.count_nonzero(truth)
    return dice(level.values[near] > 0.0, truth)


def check_face(anatomy, surfaces, median, p95, parted):
    """Asserts how far the face is from the reference, mm, and the least Dice of the mandible."""
    points = face(surface_points(anatomy.skin))
    # Where the image ends the surface is closed flat: that is no skin.
    low, high = anatomy.skin.lowest + 2.5, anatomy.skin.highest - 2.5
    points = points[((points > low) & (points < high)).all(axis=1)]
    distance = distances(points, surfaces["skin"])
    assert np.median(distance) < median
    assert np.percentile(distance, 95.0) < p95
    assert {"cranium", "mandible"} == set(anatomy.bones)
    if parted is not None:
        assert parted_as(anatomy, surfaces) > parted
