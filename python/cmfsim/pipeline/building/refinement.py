"""How often the edge of a mesh is halved: where tissue is thin, and at the mouth."""

import numpy as np
from numpy.typing import NDArray

from cmfsim._core import distance_image
from cmfsim.meshing import near_skin
from cmfsim.values.anatomy import Anatomy
from cmfsim.values.image_data import ImageData

__all__ = ["GAP_REFINEMENTS", "allowed_halvings", "needed_halvings"]

Counts = NDArray[np.uint8]

# Depth below the skin to which thin tissue is refined, mm: lips, nose and lids, not the walls of
# the nasal cavity.
THIN_DEPTH = 12.0
# Halvings of the edge at gaps between skin and skin: lips a millimetre apart stay two.
GAP_REFINEMENTS = 2
# The mouth is where the distances from the upper jaw and from the mandible come to less, mm: the
# lips over the crowns of the teeth. What the jaws' motions differ by is sheared over this width.
MOUTH_WIDTH = 24.0
# How far below the skin it reaches, mm: lips and the muscle in them, not the tongue.
MOUTH_DEPTH = 15.0
# How far behind its foremost tissue, mm: the corners of the mouth and what is beside them. The arch
# of the cheekbone and the mandible's processes, as near to each other, lie farther back.
MOUTH_LENGTH = 35.0


def allowed_halvings(anatomy: Anatomy) -> Counts:
    """How often the edge may be halved for what is thin: (nx, ny, nz) on the anatomy's grid."""
    allowed: Counts = near_skin(anatomy, THIN_DEPTH).astype(np.uint8)
    allowed[np.asarray(anatomy.skin.values) <= 0.0] = GAP_REFINEMENTS
    return allowed


def needed_halvings(level: ImageData, anatomy: Anatomy) -> Counts:
    """How often the edge is halved at least: once at the mouth, if the anatomy has a "mandible".

    A tet holds one mixture of fat and muscle: one half as large as a lip is thick smears the lip's
    muscle over it, where the motions of the jaws differ most. No landmark is asked for, nor that
    the image show the lips apart.

    Parameters
    ----------
    level : ImageData
        Of the tissue, on the anatomy's grid.
    anatomy : Anatomy

    Returns
    -------
    (nx, ny, nz) uint8
    """
    tissue = np.asarray(level.values) > 0.0
    upper = np.zeros(tissue.shape, dtype=bool)
    lower = np.zeros(tissue.shape, dtype=bool)
    for name, bone in anatomy.bones.items():
        jaw = lower if name == "mandible" else upper
        jaw |= np.asarray(bone.values) > 0.0
    sx, sy, sz = (float(s) for s in np.asarray(level.spacing))
    width = np.zeros(tissue.shape, dtype=np.float32)
    for jaw in (upper, lower):
        width += distance_image(jaw, (sx, sy, sz), within=MOUTH_WIDTH)
    mouth = tissue & (width < MOUTH_WIDTH) & near_skin(anatomy, MOUTH_DEPTH)
    rows = np.flatnonzero(mouth.any(axis=(0, 2)))
    if len(rows):
        # The second axis of the grid runs from front to back.
        mouth[:, rows[0] + int(MOUTH_LENGTH / sy) + 1 :] = False
    return mouth.astype(np.uint8)
