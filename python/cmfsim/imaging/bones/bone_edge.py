"""The surface of bone between voxels: half-way between soft tissue and the bone behind the surface.

A voxel that bone fills by half shows the mean of both. One threshold for all bone lies below that
for compact bone, and makes it thicker all round by a third of a voxel. Half the height of the step
is where the surface is, whatever the blur (Spoor, Zonneveld & Macho 1993).
"""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from cmfsim.imaging.intensities.intensity import SOFT
from cmfsim.imaging.morphology import Mask, Volume, depth, grown, ndimage

# The blur of a step from soft tissue to bone is over within this, voxels of the scan.
BLUR = 2.0
# Half of the step to compact bone; enamel, three times as dense, would draw the bone beside it in.
HIGHEST = 0.5 * (SOFT + 1400.0)
# Values are looked up this far apart along a line, voxels.
SAMPLE = 0.5
# Number of distances that are looked up at a time.
THREADS = 2


def at_half_height(
    hu: Volume, mask: Mask, threshold: float, scale: float, spacing: NDArray[np.float64]
) -> tuple[Volume, Mask]:
    """HU whose surface of bone lies at the threshold, and the mask without what lies outside it.

    Near the surface values are lowered by what half the step exceeds the threshold; the step ends
    at the densest value behind the surface along its normal. Bone less dense than twice the
    threshold stays as it is, as do values farther than `scale` from any such half: no level shows
    a difference there.
    """
    reach = BLUR * float(spacing.max())
    near = np.abs(depth(mask, spacing, reach)) < reach
    near &= (hu > threshold - scale) & (hu < HIGHEST + scale)
    # Borders of the image have no other side.
    for axis in range(3):
        np.moveaxis(near, axis, 0)[[0, -1]] = False
    # By their numbers in the order of memory, which is that of z, y, x.
    voxels, values = np.flatnonzero(near.T), hu.T.reshape(-1)
    index = np.stack(np.unravel_index(voxels, hu.T.shape)[::-1])
    steps = np.cumprod([1, *hu.shape[:2]])
    gradient = np.stack(
        [
            (values[voxels + step] - values[voxels - step]) / (2.0 * width)
            for step, width in zip(steps, spacing, strict=True)
        ]
    )
    inwards = gradient / np.maximum(np.linalg.norm(gradient, axis=0), 1e-6)
    own = values[voxels]
    densest = own.copy()
    sampled = ndimage().map_coordinates

    def values_at(far: float) -> NDArray[np.float32]:
        places = index + inwards * (far * spacing.max() / spacing)[:, None]
        found: NDArray[np.float32] = sampled(hu, places, order=1, mode="nearest")
        return found

    with ThreadPoolExecutor(THREADS) as pool:
        for found in pool.map(values_at, np.arange(SAMPLE, BLUR + 0.5 * SAMPLE, SAMPLE)):
            np.maximum(densest, found, out=densest)
    half = np.clip(0.5 * (SOFT + densest), threshold, max(HIGHEST, threshold))
    lowered = hu.copy(order="F")
    lowered.T.reshape(-1)[voxels] = own - (half - np.float32(threshold)).astype(np.float32)
    # Marrow behind compact bone is low as well: only what is open to the outside is cut.
    low = near & mask & (lowered <= threshold)
    cut = np.zeros_like(mask)
    for _ in range(int(BLUR)):
        cut = low & (hu > threshold) & grown(~mask | cut)
    kept = mask & ~cut
    np.copyto(lowered, hu, where=low & kept)
    return lowered, kept
