"""Level images, from an image that knows the surface between voxels and a mask that knows where."""

from collections.abc import Iterator
from itertools import product

import numpy as np

from cmfsim.imaging.morphology import Block, Mask, Volume, box_of, grown, shrunk, smoothed

# Voxels of width over which a mask is smoothed where the image cannot place the surface.
MASK_SIGMA = 1.0
# Least size of the level a voxel away from the surface, of 1.
NEAR = 0.5
# A mask is smoothed in blocks of this many voxels along each axis, and only where it is new; a
# Gaussian of one voxel leaves less than 1e-4 beyond the second.
BLOCK = 32
REACH = 4


def level_of(values: Volume, threshold: float, scale: float, mask: Mask) -> Volume:
    """A level with the sign of the mask, float32, between −1 and 1.

    Where mask and threshold agree it is (values − threshold)/scale, so that the surface lies
    between voxels as the image has it. Where they do not (hollows filled, other things cut away)
    and that makes a new surface, the surface is that of the smoothed mask.
    """
    # Farther from the mask than its surface reaches, all is outside.
    box = box_of(mask, REACH)
    whole = np.full(values.shape, np.float32(-1.0), order="F")
    values, mask = values[box], np.asfortranarray(mask[box])
    level = np.asfortranarray(values - np.float32(threshold)) * np.float32(1.0 / scale)
    np.clip(level, -1.0, 1.0, out=level)
    forced = (level > 0.0) != mask
    if forced.any():
        _force(level, forced, mask)
    # Away from the surface the image's own rims (of hollows inside, of streaks outside) are no
    # zeros of the level: nothing may come near zero there.
    inside, outside = shrunk(mask), shrunk(~mask)
    np.maximum(level, NEAR, out=level, where=inside)
    np.minimum(level, -NEAR, out=level, where=outside)
    np.copyto(level, np.float32(1.0), where=shrunk(inside))
    np.copyto(level, np.float32(-1.0), where=shrunk(outside))
    whole[box] = level
    return whole


def _force(level: Volume, forced: Mask, mask: Mask) -> None:
    """The mask's sign given to the level in place, with a smooth surface where it is new."""
    np.copyto(level, np.where(mask, np.float32(1.0), np.float32(-1.0)), where=forced)
    # Only a rim between forced and other voxels is a surface; the rest of a filling is inside.
    box = box_of(forced, 4)
    inside, part = mask[box], level[box]
    rim = grown(inside) & grown(~inside)
    near = grown(grown(forced[box])) & rim
    # The rim is thin and far from everywhere: blocks that hold none of it need no smoothing.
    for block, around, within in _blocks_with(near):
        close = np.asfortranarray(near[around])
        weight = np.clip(2.0 * smoothed(close, MASK_SIGMA), 0.0, 1.0)
        weight[close] = 1.0
        soft = smoothed(np.asfortranarray(inside[around]), MASK_SIGMA)
        soft = soft * np.float32(2.0) - np.float32(1.0)
        old = part[block]
        part[block] = np.clip(old + weight[within] * (soft[within] - old), -1.0, 1.0)


def _blocks_with(mask: Mask) -> Iterator[tuple[Block, Block, Block]]:
    """Blocks that together hold the mask and what its smoothing reaches.

    Each with the wider block to be smoothed, and its place in that.
    """
    starts = [range(0, n, BLOCK) for n in mask.shape]
    for corner in product(*starts):
        block, around, within = [], [], []
        for start, n in zip(corner, mask.shape, strict=True):
            stop = min(start + BLOCK, n)
            low = max(start - REACH, 0)
            block.append(slice(start, stop))
            around.append(slice(low, min(stop + REACH, n)))
            within.append(slice(start - low, stop - low))
        if mask[tuple(around)].any():
            yield tuple(block), tuple(around), tuple(within)
