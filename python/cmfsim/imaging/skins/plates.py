"""Things that lie flat on the face: pads, dressings, plates. Their rim is a step nearly all round.

A face has steps at nose, lips, lids and ears, but none that goes most of the way round a piece of
skin and faces away from it. What such a step surrounds is no part of a face, whatever its density,
and on whichever side it lies.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cmfsim.imaging.morphology import Mask, Volume, label, ndimage, smoothed, widened_by
from cmfsim.values.checks import Floats

# Voxels that steps are looked for on, mm.
STEP = 1.6
# The skin's own direction is that of its level after the first Gaussian, the direction of the face
# around it that of the head's inside after the second, mm.
FINE, WIDE = 1.2, 7.0
# A rim that lies in a fold of the face differs less from the face around it than from the skin just
# beside it: that of this Gaussian, mm.
NEAR = 4.5
# Skin that is turned against the face around it by more than one of these is a step, degrees: low
# ones close a rim that is weak in places, high ones do not take a small pad for all step. Voxels
# that steps are widened by, which closes gaps of a rim.
STEEP = {
    (WIDE, 1): (17.0, 20.0, 25.0, 32.0, 40.0),
    (WIDE, 2): (17.0, 20.0, 25.0),
    (NEAR, 1): (17.0, 20.0, 25.0),
    (NEAR, 2): (20.0, 25.0),
}
# In voxels larger than the first, mm, noses have rims of few voxels: only such steps are looked
# for, and this part of a border must have a rim.
COARSE = 2.0
STEEP_COARSE = {(WIDE, 1): (25.0,)}
LEAST_RIM_COARSE = 0.9
# The neck is taken to go on below the image for so much, mm.
BELOW = 17.5
# What a step may surround, without the step itself, mm²: pads 18 to 90 mm across.
LEAST_AREA, MOST_AREA = 60.0, 8000.0
# Voxels beside a piece in which its step is looked for, beyond those that it was widened by.
BESIDE = 2
# A rim is there where skin faces away from the piece by so much more than the face around it,
# degrees: that of a pit faces inwards.
OUTWARDS = 20.0
# Along its border a piece faces outwards by no more than this on average, degrees. A pad's upper
# edge is convex, and the face around it leans to the step beyond: −19 to 0. Skin beside a fold is
# concave: 5 at noses, 18 between jaw and neck.
EDGE = 1.0
# The part of a piece's border that has such a rim, at least: that of pads of 60 mm whose rim meets
# lips or folds is 0.7, that of faces without one 0.5 at most.
LEAST_RIM = 0.62
# Gaussian by which a piece's border gets a direction, voxels.
BORDER = 2.0


@dataclass(frozen=True, eq=False)
class _Skin:
    """The voxels just inside the surface of the face, on a part of the grid.

    level: (nx, ny, nz) float32.
    shell, cut_off: (nx, ny, nz) bool. Those that are looked at, and those beyond, where the face
        ends.
    spacing: (3,), mm.
    """

    level: Volume
    shell: Mask
    cut_off: Mask
    spacing: NDArray[np.float64]

    @cached_property
    def index(self) -> NDArray[np.intp]:
        """The voxels of the shell, (n, 3)."""
        return np.argwhere(self.shell)

    @cached_property
    def own(self) -> Floats:
        """The skin's own direction there."""
        return _directions(smoothed(self.level, FINE, self.spacing), self.index, self.spacing)

    def slope(self, wide: float) -> NDArray[np.float32]:
        """The part of the skin's own direction along the face around it, (nx, ny, nz, 3)."""
        inside = self.level > 0.0
        around = _directions(smoothed(inside, wide, self.spacing), self.index, self.spacing)
        cosine = (self.own * around).sum(axis=1, keepdims=True)
        # Skin that is turned away by more than a right angle is a step as high as any.
        along = self.own - np.minimum(cosine, 1.0) * around
        lengths = np.linalg.norm(along, axis=1, keepdims=True)
        along = np.where(cosine < 0.0, along / np.maximum(lengths, 1e-9), along)
        slope = np.zeros((*self.shell.shape, 3), dtype=np.float32)
        slope[tuple(self.index.T)] = along
        return slope


def find_plates(level: Volume, spacing: NDArray[np.float64], behind: int) -> list[NDArray[np.intp]]:
    """The voxels, (n, 3) each, of pieces of the skin that stand out within a step.

    level: (nx, ny, nz) float32. The skin's, positive inside; on voxels of about `STEP`.
    spacing: (3,), mm.
    behind: Layers along y from this on are not of the face.
    """
    rows = np.flatnonzero((level > 0.0).any(axis=(0, 2)))
    if not len(rows) or rows[0] >= behind:
        return []
    first = max(int(rows[0]) - 4, 0)
    below = int(np.ceil(BELOW / spacing[2]))
    part = level[:, first : behind + 4]
    part = np.concatenate([np.repeat(part[:, :, :1], below, axis=2), part], axis=2)
    skin = _skin(np.asfortranarray(part), spacing, behind - first, below)
    is_coarse = float(np.max(spacing)) > COARSE
    steep, least_rim = (STEEP_COARSE, LEAST_RIM_COARSE) if is_coarse else (STEEP, LEAST_RIM)
    slopes = {wide: skin.slope(wide) for wide in {wide for wide, _ in steep}}
    found: list[NDArray[np.intp]] = []
    for (wide, widened), angles in steep.items():
        height = np.linalg.norm(slopes[wide], axis=-1)
        for angle in angles:
            steps = skin.shell & (height > np.sin(np.radians(angle)))
            found += _surrounded(skin, steps, widened, slopes[WIDE], least_rim)
    shift = np.array([0, first, -below], dtype=np.intp)
    return [voxels + shift for voxels in _apart(found, skin.shell.shape)]


def _surrounded(
    skin: _Skin, steps: Mask, widened: int, slope: NDArray[np.float32], least_rim: float
) -> list[NDArray[np.intp]]:
    """The voxels, with those of its rim, of each piece of the shell that a rim surrounds."""
    wall = widened_by(steps, widened)
    labels, sizes = label(np.asfortranarray(skin.shell & ~wall), corners=True)
    areas = sizes * float(np.prod(skin.spacing)) ** (2.0 / 3.0)
    blocks = ndimage().find_objects(labels)
    reach = BESIDE + widened
    pieces = []
    for number in np.flatnonzero((areas > LEAST_AREA) & (areas < MOST_AREA)):
        # With room for what lies beside it.
        block = blocks[number - 1]
        box = tuple(slice(max(b.start - reach - 1, 0), b.stop + reach + 1) for b in block)
        within = labels[box] == number
        shell = skin.shell[box]
        beside = widened_by(within, reach) & shell & ~within
        ends = widened_by(skin.cut_off[box], 1)
        border = within & (ends | widened_by(beside, 1))
        outwards = _outwards(within, beside | border, slope[box], skin.spacing)
        if not border.any() or outwards[border].mean() > np.sin(np.radians(EDGE)):
            continue
        rim = beside & (outwards > np.sin(np.radians(OUTWARDS)))
        near = widened_by(rim, reach)
        # Where the face ends, what lies beyond is not known to be lower.
        if (near & ~ends)[border].mean() > least_rim:
            pieces.append(np.argwhere(within | rim) + np.array([b.start for b in box]))
    return pieces


def _outwards(
    within: Mask, where: Mask, slope: NDArray[np.float32], spacing: NDArray[np.float64]
) -> Volume:
    """How far skin faces away from a piece, against the face around it; as a sine, 0 elsewhere."""
    piece = ndimage().gaussian_filter(within.astype(np.float32), BORDER)
    index = np.argwhere(where)
    away = _directions(piece, index, spacing)
    outwards = np.zeros(within.shape, dtype=np.float32)
    at = tuple(index.T)
    outwards[at] = (slope[at] * away).sum(axis=1)
    return outwards


def _apart(pieces: list[NDArray[np.intp]], shape: tuple[int, ...]) -> list[NDArray[np.intp]]:
    """The largest of those that overlap."""
    taken = np.zeros(shape, dtype=bool)
    kept = []
    for voxels in sorted(pieces, key=len, reverse=True):
        at = tuple(voxels.T)
        if not taken[at].any():
            kept.append(voxels)
            taken[at] = True
    return kept


def _skin(level: Volume, spacing: NDArray[np.float64], last: int, below: int) -> _Skin:
    """The shell of voxels just inside the skin, before a layer along y and above one along z."""
    inside = level > 0.0
    shell = np.zeros_like(inside)
    for axis in range(3):
        along, out = np.moveaxis(inside, axis, 0), np.moveaxis(shell, axis, 0)
        out[1:] |= along[1:] & ~along[:-1]
        out[:-1] |= along[:-1] & ~along[1:]
    whole = shell.copy()
    # A head that is cut off is closed by steps.
    shell[:, last:] = shell[:, :, : below + 1] = shell[:, :, -2:] = False
    shell[:2] = shell[-2:] = False
    return _Skin(level, shell, whole & ~shell, spacing)


def _directions(values: Volume, index: NDArray[np.intp], spacing: NDArray[np.float64]) -> Floats:
    """The unit vectors in which values fall fastest, at some voxels."""
    fall = np.empty(index.shape)
    for axis, (size, step) in enumerate(zip(values.shape, spacing, strict=True)):
        before, after = index.copy(), index.copy()
        before[:, axis] = np.maximum(before[:, axis] - 1, 0)
        after[:, axis] = np.minimum(after[:, axis] + 1, size - 1)
        fall[:, axis] = (values[tuple(before.T)] - values[tuple(after.T)]) / step
    return np.asarray(fall / np.maximum(np.linalg.norm(fall, axis=1), 1e-12)[:, None])
