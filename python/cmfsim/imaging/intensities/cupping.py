"""Cone-beam scanners' cupping: scatter darkens the middle of a head, and is undone.

Scattered photons come from all of the head, so their share grows with how much head is around: the
loss is fitted as a function of the head's mask, smoothed widely (Siewerdsen & Jaffray 2001).

Noise is measured as well, and smoothed where bone would be lost in it.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.imaging.intensities.intensity import AIR, SOFT, noise_of
from cmfsim.imaging.morphology import Mask, Volume, depth, largest, ndimage, resampled_to, smoothed
from cmfsim.imaging.working_grid import Working, coarse_of
from cmfsim.values.finding import Finding

# From this noise on (HU on the working grid), a Gaussian of this many voxels: it leaves a third or
# less of the noise, which then is a tenth of the step from soft tissue to the bone threshold.
SMOOTHING = ((45.0, 0.8), (25.0, 0.6))
# From this noise on bone is known less well than landmarks, HU: at 150 HU parts of the orbits and
# of sinus walls move by up to 7 mm.
REPORTED = 70.0

# Voxels that the loss is fitted on, mm: noise averages out, and bone is still apart from the rest.
STEP = 4.0
# Scatter reaches about this far, mm.
REACH = 30.0
# Soft tissue, with loss and noise, lies within this of its nominal value, and in later rounds of
# the fit within the second of the fitted one, HU.
NOMINAL = 350.0
FITTED = 150.0
ROUNDS = 6
# Where air shares a voxel, soft tissue is darker anyway, mm.
BELOW_SKIN = 6.0
# Smaller losses between the rim and the middle of the head are fat, muscle and brain, HU: clinical
# CTs show the middle brighter, for fat lies below the skin.
LEAST_LOSS = 90.0
# Fewer voxels are not conclusive.
LEAST_VOXELS = 500
AIR_LEVEL = -300.0
# No correction goes further than this, HU: what is that dark is no soft tissue.
MOST_LOSS = 450.0


def without_cupping(work: Working) -> tuple[Volume, tuple[Finding, ...]]:
    """HU scaled between air and soft tissue where soft tissue has not one value throughout."""
    coarse, steps, shift = coarse_of(work.hu, work.spacing, STEP)
    tissue: Mask = np.asfortranarray(coarse > AIR_LEVEL)
    if not tissue.any():
        return work.hu, ()
    head = largest(tissue)
    around = _around(head, steps)
    usable = head & (np.abs(coarse - SOFT) < NOMINAL) & (depth(head, steps) > BELOW_SKIN)
    if np.count_nonzero(usable) < LEAST_VOXELS:
        return work.hu, ()
    fitted = _fitted(around[usable], coarse[usable])
    low, high = np.percentile(around[usable], (5.0, 95.0))
    loss = float(np.polyval(fitted, low) - np.polyval(fitted, high))
    if loss < LEAST_LOSS:
        return work.hu, ()
    soft = np.polyval(fitted, np.clip(around, low, high))
    soft = np.clip(soft, SOFT - MOST_LOSS, SOFT + MOST_LOSS).astype(np.float32)
    gain = np.float32(SOFT - AIR) / (soft - np.float32(AIR))
    fine = resampled_to(np.asfortranarray(gain), steps, shift, work.hu.shape, work.spacing)
    corrected: Volume = (work.hu - np.float32(AIR)) * fine + np.float32(AIR)
    finding = Finding(
        "ct-cupping",
        f"soft tissue is {loss:.0f} HU darker in the middle of the head than near its surface, as "
        "is typical of cone-beam scanners; the values were scaled between air and soft tissue to "
        "compensate",
        where="image",
    )
    return corrected, (finding,)


def _around(head: Mask, steps: NDArray[np.float64]) -> Volume:
    """How much head is around each voxel: 1 far inside. Beyond the image it goes on as it is."""
    found: Volume = ndimage().gaussian_filter(
        head.astype(np.float32), REACH / steps, mode="nearest", truncate=2.5
    )
    return found


def _fitted(around: NDArray[Any], hu: NDArray[Any]) -> NDArray[np.float64]:
    """The parabola of soft tissue over what is around it; what is far off is left out in turn."""
    fitted = np.array([0.0, 0.0, float(np.median(hu))])
    for _ in range(ROUNDS):
        near = np.abs(hu - np.polyval(fitted, around)) < FITTED
        if np.count_nonzero(near) < LEAST_VOXELS:
            break
        fitted = np.polyfit(around[near].astype(np.float64), hu[near], 2)
    return fitted


def without_noise(hu: Volume) -> tuple[Volume, tuple[Finding, ...]]:
    """HU smoothed as far as the noise asks for: not at all in most clinical scans.

    For bone only: the skin stands out of any noise, and smoothing would draw it in.
    """
    noise = noise_of(hu)
    sigma = next((sigma for least, sigma in SMOOTHING if noise >= least), 0.0)
    if sigma == 0.0:
        return hu, ()
    finding = Finding(
        "ct-noise",
        f"the noise of the image is {noise:.0f} HU in voxels of the working grid; bone was found "
        f"in the image smoothed by a Gaussian of {sigma:g} voxels",
        where="image",
    )
    return smoothed(hu, sigma), (finding,) if noise >= REPORTED else ()
