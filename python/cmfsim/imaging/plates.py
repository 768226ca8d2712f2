"""Things that lie flat on the face: pads, dressings, plates. Their rim is a step all round.

A face has steps at nose, lips, lids and ears, but none that closes round a piece of skin. What a
step down surrounds is no part of a face, whatever its density, and on whichever side it lies.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmfsim.imaging.morphology import Mask, Volume, label, ndimage, smoothed
from cmfsim.values.checks import Floats

__all__ = ["STEP", "find_plates"]

# Voxels that steps are looked for on, mm.
STEP = 1.6
# The skin's own direction is that of its level after the first Gaussian, the direction of the face
# around it that of the head's inside after the second, mm.
FINE, WIDE = 1.2, 7.0
# Skin that is turned against the face around it by more than this is a step, degrees: that of a pad
# of 3 mm is by some 30.
STEEP = 25.0
# The neck is taken to go on below the image for so much, as a multiple of the wide Gaussian.
BELOW = 2.5
# What a step may surround, without the step itself, mm²: pads 18 to 90 mm across.
LEAST_AREA, MOST_AREA = 60.0, 8000.0
# Voxels beside a piece in which its step is looked for.
BESIDE = 3
# How far the step faces away from the middle of what it surrounds, as the mean cosine at least: the
# rim of a pit faces inwards.
LEAST_OUTWARDS = 0.4


@dataclass(frozen=True, eq=False)
class _Skin:
    """The voxels of the surface of the face, on a part of the grid.

    Attributes
    ----------
    shell : (nx, ny, nz) bool
    steps : (nx, ny, nz) bool
        Those of the shell where it is a step.
    slope : (nx, ny, nz, 3) float32
        The part of the skin's own direction that lies along the face around it.
    """

    shell: Mask
    steps: Mask
    slope: NDArray[np.float32]


def find_plates(level: Volume, spacing: NDArray[np.float64], behind: int) -> list[NDArray[np.intp]]:
    """The voxels, (n, 3) each, of pieces of the skin that stand out within a step all round.

    Parameters
    ----------
    level : (nx, ny, nz) float32
        The skin's, positive inside; on voxels of about `STEP`.
    spacing : (3,) float64, mm
    behind : int
        Layers along y from this on are not of the face.
    """
    rows = np.flatnonzero((level > 0.0).any(axis=(0, 2)))
    if not len(rows) or rows[0] >= behind:
        return []
    first = max(int(rows[0]) - 4, 0)
    below = int(np.ceil(BELOW * WIDE / spacing[2]))
    part = level[:, first : behind + 4]
    part = np.concatenate([np.repeat(part[:, :, :1], below, axis=2), part], axis=2)
    skin = _skin(np.asfortranarray(part), spacing, behind - first, below)
    wall = ndimage().binary_dilation(skin.steps, np.ones((3, 3, 3), dtype=bool))
    labels, sizes = label(np.asfortranarray(skin.shell & ~wall), corners=True)
    areas = sizes * float(np.prod(spacing)) ** (2.0 / 3.0)
    blocks = ndimage().find_objects(labels)
    found = []
    for piece in np.flatnonzero((areas > LEAST_AREA) & (areas < MOST_AREA)):
        # With room for what lies beside it.
        box = tuple(slice(max(b.start - BESIDE, 0), b.stop + BESIDE) for b in blocks[piece - 1])
        within = labels[box] == piece
        rim = ndimage().binary_dilation(within, np.ones((3, 3, 3), dtype=bool), iterations=BESIDE)
        rim &= skin.steps[box]
        if _outwards(within, rim, skin.slope[box], spacing) > LEAST_OUTWARDS:
            start = np.array([b.start for b in box]) + [0, first, -below]
            found.append(np.argwhere(within | rim) + start)
    return found


def _skin(level: Volume, spacing: NDArray[np.float64], last: int, below: int) -> _Skin:
    """The shell of voxels just inside the skin, before a layer along y and above one along z."""
    inside = level > 0.0
    shell = np.zeros_like(inside)
    for axis in range(3):
        along, out = np.moveaxis(inside, axis, 0), np.moveaxis(shell, axis, 0)
        out[1:] |= along[1:] & ~along[:-1]
        out[:-1] |= along[:-1] & ~along[1:]
    # A head that is cut off is closed by steps.
    shell[:, last:] = shell[:, :, : below + 1] = shell[:, :, -2:] = False
    shell[:2] = shell[-2:] = False
    index = np.argwhere(shell)
    own = _directions(smoothed(level, FINE, spacing), index, spacing)
    around = _directions(smoothed(inside, WIDE, spacing), index, spacing)
    cosine = (own * around).sum(axis=1)
    at = tuple(index.T)
    steps = np.zeros_like(inside)
    steps[at] = cosine < np.cos(np.radians(STEEP))
    slope = np.zeros((*inside.shape, 3), dtype=np.float32)
    slope[at] = own - cosine[:, None] * around
    return _Skin(shell, steps, slope)


def _directions(values: Volume, index: NDArray[np.intp], spacing: NDArray[np.float64]) -> Floats:
    """The unit vectors in which values fall fastest, at some voxels."""
    fall = np.empty(index.shape)
    for axis, (size, step) in enumerate(zip(values.shape, spacing, strict=True)):
        before, after = index.copy(), index.copy()
        before[:, axis] = np.maximum(before[:, axis] - 1, 0)
        after[:, axis] = np.minimum(after[:, axis] + 1, size - 1)
        fall[:, axis] = (values[tuple(before.T)] - values[tuple(after.T)]) / step
    return np.asarray(fall / np.maximum(np.linalg.norm(fall, axis=1), 1e-12)[:, None])


def _outwards(
    within: Mask, rim: Mask, slope: NDArray[np.float32], spacing: NDArray[np.float64]
) -> float:
    """The mean cosine between where a rim faces along the face and the way to it; −1 of none."""
    if not rim.any():
        return -1.0
    away = (np.argwhere(rim) - np.argwhere(within).mean(axis=0)) * spacing
    faces = slope[rim].astype(np.float64)
    lengths = np.linalg.norm(away, axis=1) * np.linalg.norm(faces, axis=1)
    return float(((away * faces).sum(axis=1) / np.maximum(lengths, 1e-12)).mean())
