"""Tooth rows of a synthetic head, from the levels of its bones about the teeth."""

import functools

import numpy as np

import cmfsim
from cmfsim.phantom.grid import level_grid
from cmfsim.surfaces.levels import surface_of_level
from cmfsim.values.motion import carried

# Voxels of the levels, where they are clipped, and the box about the teeth, mm.
SPACING, CLIP = 0.8, 5.0
LOWEST, HIGHEST = np.array([-46.0, -104.0, -62.0]), np.array([46.0, -28.0, -24.0])
# Height of a scan from its cusps, mm: with gum.
HEIGHT = 9.0
# The joint heads of the synthetic head, left and right.
HINGE = ((49.0, -11.0, -3.0), (-49.0, -11.0, -3.0))


def level(head, *names):
    """The level of bones together, mm near their surface."""
    sizes = np.ceil((HIGHEST - LOWEST) / SPACING).astype(int) + 1
    axes = [low + SPACING * np.arange(n) for low, n in zip(LOWEST, sizes, strict=True)]
    # Brick by brick, to each of which few shapes matter.
    values = np.max([level_grid(head.field(name), axes, CLIP) for name in names], axis=0)
    return cmfsim.ImageData(values, [SPACING] * 3, LOWEST)


def rows_of(head, upper=("cranium", "upper_teeth"), lower=("mandible", "lower_teeth"), findings=()):
    """The rows of a head whose bones are made of these parts."""
    levels = {"cranium": level(head, *upper), "mandible": level(head, *lower)}
    anatomy = cmfsim.Anatomy(levels["cranium"], levels)
    segments = [
        cmfsim.BoneSegment(n, bone, surface_of_level(n, bone)) for n, bone in levels.items()
    ]
    return cmfsim.tooth_rows(anatomy, segments, head.skull_landmarks, findings)


@functools.cache
def closed_rows():
    """The upper and the lower row of the ordinary head, whose teeth are 1 mm apart."""
    return rows_of(cmfsim.make_head())


def scan_of(row, motion):
    """An open surface of the teeth of a row, moved."""
    vertices, triangles = row.surface.vertices, row.surface.triangles
    across, ahead, out = ((vertices - row.arch.middle) @ row.arch.axes().T).T
    near = (np.abs(across) < row.arch.half_width + 9) & (ahead > -8)
    near &= -out > (-out)[[*row.cusps.values()]].mean() - HEIGHT
    kept = triangles[near[triangles].all(axis=1)]
    used, numbers = np.unique(kept, return_inverse=True)
    return cmfsim.SurfaceData(carried(motion, vertices[used]), numbers.reshape(-1, 3))
