"""Noise of a scan: measured, smoothed where bone would be lost in it, and reported."""

from cmfsim.imaging.intensities.intensity import noise_of
from cmfsim.imaging.morphology import Volume, smoothed
from cmfsim.values.finding import Finding

# From this noise on (HU on the working grid), a Gaussian of this many voxels: it leaves a third or
# less of the noise, which then is a tenth of the step from soft tissue to the bone threshold.
SMOOTHING = ((45.0, 0.8), (25.0, 0.6))
# From this noise on bone is known less well than landmarks, HU: at 150 HU parts of the orbits and
# of sinus walls move by up to 7 mm.
REPORTED = 70.0


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
