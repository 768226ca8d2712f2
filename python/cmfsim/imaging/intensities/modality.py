"""Whether an image with a CT's histogram is one: MR images show fat below the skin brightest."""

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import ImageInputError
from cmfsim.imaging.intensities.intensity import AIR, SOFT, STATE_IT
from cmfsim.imaging.morphology import Mask, Volume, closed, depth, filled, largest, opened

# Bone is brighter than this above soft tissue, HU.
BRIGHT = 250.0
# The layer below the skin that holds fat but little bone, and where depth begins, mm.
BELOW_SKIN = (1.0, 4.0)
DEEP = 7.0
# How many times as much of the layer as of what lies deeper is bright: in CTs 1.0 at most, in an MR
# image weighted by T1 1.6.
MOST_BRIGHT = 1.3
# The part of what lies deeper that is as dark as air: sinuses and airways measure up to 0.04, and
# compact bone of an MR image is dark as well, 0.12.
MOST_DARK = 0.07
# Openings of airways that are closed, and sheets and tubes that are no head, mm.
CLOSING, OPENING = 12.0, 3.0


def check_is_ct(hu: Volume, spacing: NDArray[np.float64]) -> None:
    """Refuses an MR image: bright below the skin rather than deeper, and dark where bone is.

    Parameters
    ----------
    hu : (nx, ny, nz) float32
        As calibrated, on voxels of some 2 mm.
    spacing : (3,) float64, mm
    """
    tissue: Mask = np.asfortranarray(hu > 0.5 * (AIR + SOFT))
    thick = opened(tissue, OPENING, spacing)
    if not thick.any():
        return
    inwards = depth(filled(largest(closed(thick, CLOSING, spacing))), spacing)
    low, high = BELOW_SKIN
    shell, inside = (inwards > low) & (inwards < high), inwards >= DEEP
    if not (shell.any() and inside.any()):
        return
    bright = [float((hu[part] > SOFT + BRIGHT).mean()) for part in (shell, inside)]
    dark = float((hu[inside] < 0.5 * (AIR + SOFT)).mean())
    if bright[0] > MOST_BRIGHT * bright[1] and dark > MOST_DARK:
        raise ImageInputError(
            f"the image does not look like a CT: {100 * bright[0]:.0f} % of the layer below the "
            f"skin is as bright as bone, {100 * bright[1]:.0f} % of what lies deeper, and "
            f"{100 * dark:.0f} % of that is as dark as air. An MR image cannot be used: give the "
            f"CT series. {STATE_IT}"
        )
