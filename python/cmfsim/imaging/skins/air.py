"""Hollows inside the skin: airway, nasal and oral cavity."""

import numpy as np

from cmfsim.imaging.bones.bone import Bone
from cmfsim.imaging.intensities.levels import level_of
from cmfsim.imaging.morphology import Volume, label
from cmfsim.imaging.options import SegmentOptions
from cmfsim.imaging.skins.skin import SKIN_SCALE, Skin
from cmfsim.imaging.working_grid import Working

# Smaller bubbles are part of the tissue, mm³.
LEAST_AIR = 200.0


def air_level(work: Working, skin: Skin, bone: Bone, options: SegmentOptions) -> Volume | None:
    """The level of hollows that no bone encloses; None if there are none."""
    labels, sizes = label(skin.hollow & ~bone.mask)
    large = sizes * float(np.prod(work.spacing)) > LEAST_AIR
    if not large.any():
        return None
    return level_of(-work.hu, -options.skin_threshold, SKIN_SCALE, large[labels])
