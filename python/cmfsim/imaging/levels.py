"""Level images, from an image that knows the surface between voxels and a mask that knows where."""

import numpy as np

from cmfsim.imaging.morphology import Mask, Volume, ndimage, shrunk, smoothed

__all__ = ["level_of"]

# Voxels of width over which a mask is smoothed where the image cannot place the surface.
MASK_SIGMA = 1.0
# Least size of the level a voxel away from the surface, of 1.
NEAR = 0.5


def level_of(values: Volume, threshold: float, scale: float, mask: Mask) -> Volume:
    """A level with the sign of the mask, float32, between −1 and 1.

    Where mask and threshold agree it is (values − threshold)/scale, so that the surface lies
    between voxels as the image has it. Where they do not (hollows filled, other things cut away)
    and that makes a new surface, the surface is that of the smoothed mask.
    """
    level = (values - np.float32(threshold)) * np.float32(1.0 / scale)
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
    return level


def _force(level: Volume, forced: Mask, mask: Mask) -> None:
    """The mask's sign given to the level in place, with a smooth surface where it is new."""
    level[forced] = np.where(mask[forced], np.float32(1.0), np.float32(-1.0))
    # Only a rim between forced and other voxels is a surface; the rest of a filling is inside.
    scipy = ndimage()
    box = scipy.find_objects(forced.T.view(np.uint8))[0][::-1]
    box = tuple(
        slice(max(b.start - 4, 0), min(b.stop + 4, n)) for b, n in zip(box, mask.shape, strict=True)
    )
    inside, changed, part = mask[box], forced[box], level[box]
    rim = scipy.binary_dilation(inside) & scipy.binary_dilation(~inside)
    near = scipy.binary_dilation(changed, iterations=2) & rim
    if not near.any():
        return
    weight = np.clip(2.0 * smoothed(np.asfortranarray(near), MASK_SIGMA), 0.0, 1.0)
    weight[near] = 1.0
    soft = smoothed(np.asfortranarray(inside), MASK_SIGMA) * np.float32(2.0) - np.float32(1.0)
    level[box] = np.clip(part + weight * (soft - part), -1.0, 1.0)
