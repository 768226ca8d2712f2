"""The room that bones, skin and air leave to muscles: distances to what a muscle cannot enter."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmfsim import _core
from cmfsim.values.anatomy import Anatomy
from cmfsim.values.checks import Floats
from cmfsim.values.image_data import ImageData

# Distances are kept on a grid of this spacing, mm: half the thickness of the thinnest muscles. Near
# a surface the levels place it more exactly than the voxels.
SPACING = 1.5
# How far round the muscles the room is known, mm: further than any of them is moved.
MARGIN = 12.0
# Voxels from the surface in which levels refine its distance; further off they are clipped.
NEAR = 2.5
# Where the outermost slice of the head is larger than this part of its largest, the head was cut
# there: by the end of the scan, or of the surface. Crown, nose and chin end in a point.
CUT_SHARE = 0.3


@dataclass(frozen=True, eq=False)
class Room:
    """Signed distances on one grid, mm, positive where a muscle can be.

    tissue: To the nearest place in bone, in air or outside the skin.
    bone: To bone alone.
    low, high: (3,), mm. The head is known between these; beyond, its outermost slice goes on.
    """

    tissue: ImageData
    bone: ImageData
    low: Floats
    high: Floats

    @classmethod
    def of(cls, anatomy: Anatomy, points: Floats) -> "Room":
        """The room round some points of a head.

        points: (n, 3), mm.
        """
        low, high = known_part(anatomy.skin)
        begin = points.min(axis=0) - MARGIN
        shape = np.ceil((points.max(axis=0) + MARGIN - begin) / SPACING).astype(int) + 1
        # Centred: a mirrored head gets a mirrored grid.
        begin -= 0.5 * ((shape - 1) * SPACING - (points.max(axis=0) + MARGIN - begin))
        axes = [
            np.clip(b + SPACING * np.arange(n), lo, hi)
            for b, n, lo, hi in zip(begin, shape, low, high, strict=True)
        ]
        in_bone = np.maximum.reduce([_resampled(b, axes) for b in anatomy.bones.values()])
        closed = np.maximum(in_bone, -_resampled(anatomy.skin, axes))
        if anatomy.air is not None:
            closed = np.maximum(closed, _resampled(anatomy.air, axes))
        tissue, bone = (
            ImageData(_distance(level), [SPACING] * 3, begin) for level in (closed, in_bone)
        )
        return cls(tissue, bone, low, high)

    def known(self, points: Floats) -> NDArray[np.bool_]:
        """Which points lie in the part of the head that the data show."""
        inside = (points >= self.low) & (points <= self.high)
        within: NDArray[np.bool_] = np.all(inside, axis=1)
        return within


def known_part(skin: ImageData) -> tuple[Floats, Floats]:
    """The corners of the box that holds the head, less a voxel where a plane cut it off.

    Returns: high : (3,), mm. Infinite where the head was not cut off along an axis.
    """
    inside = skin.values > 0.0
    low, high = np.full(3, -np.inf), np.full(3, np.inf)
    for axis in range(3):
        others = tuple(a for a in range(3) if a != axis)
        count = np.count_nonzero(inside, axis=others)
        held = np.flatnonzero(count)
        if len(held) < 3:
            continue
        spacing = float(skin.spacing[axis])
        # The slice after the outermost: the cut itself may lie between two.
        if count[held[0] + 1] > CUT_SHARE * count.max():
            low[axis] = skin.lowest[axis] + spacing * (held[0] + 1)
        if count[held[-1] - 1] > CUT_SHARE * count.max():
            high[axis] = skin.lowest[axis] + spacing * (held[-1] - 1)
    return low, high


def _resampled(level: ImageData, axes: list[Floats]) -> NDArray[np.float32]:
    """A level at the crossings of three axes, trilinear, beyond the border as at the border."""
    sides = []
    for places, n, lowest, spacing in zip(
        axes, level.values.shape, level.lowest.tolist(), level.spacing.tolist(), strict=True
    ):
        at = np.clip((places - lowest) / spacing, 0.0, n - 1.0)
        before = np.minimum(at.astype(np.intp), max(n - 2, 0))
        sides.append((before, np.minimum(before + 1, n - 1), (at - before).astype(np.float32)))
    # Only the block between the outermost places: the head is larger.
    block = tuple(slice(before.min(), after.max() + 1) for before, after, _ in sides)
    values = level.values[block]
    for axis, (before, after, share) in enumerate(sides):
        first = before.min()
        part = share.reshape([-1 if a == axis else 1 for a in range(3)])
        low, high = np.take(values, before - first, axis), np.take(values, after - first, axis)
        values = low * (1 - part) + high * part
    return values.astype(np.float32, copy=False)


def _distance(level: NDArray[np.float32]) -> NDArray[np.float32]:
    """Distance to where a level is positive, mm; negative there.

    Near the surface the level by its gradient, as far as that agrees with the distance between
    voxels to half a voxel; that distance elsewhere.
    """
    closed = np.ascontiguousarray(level > 0.0)
    if closed.all() or not closed.any():
        far = np.float32(MARGIN)
        return np.full(level.shape, -far if closed.all() else far, dtype=np.float32)
    size = (SPACING,) * 3
    apart = _core.distance_image(closed, size) - _core.distance_image(~closed, size)
    # From centre to centre: the surface is half a voxel nearer on either side, give or take a half.
    rough = apart - 0.5 * SPACING * np.sign(apart)
    gradient = np.sqrt(sum(np.gradient(level, SPACING, axis=a) ** 2 for a in range(3)))
    near = np.abs(apart) < NEAR * SPACING
    fine = -level / np.maximum(gradient, np.finfo(np.float32).eps)
    limit = 0.5 * SPACING
    distance = np.where(near, np.clip(fine, rough - limit, rough + limit), rough)
    # The level alone tells the side.
    wrong = (distance > 0.0) == closed
    distance[wrong] = np.where(closed[wrong], -0.05, 0.05) * SPACING
    return distance.astype(np.float32, copy=False)
