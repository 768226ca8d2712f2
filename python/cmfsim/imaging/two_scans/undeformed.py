"""The skull that an operation of the jaws leaves alone, as a mask of its scan."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from cmfsim.errors import LandmarkInputError, RegistrationInputError
from cmfsim.imaging.morphology import distance
from cmfsim.values.checks import as_floats, as_number, as_positive, as_rows, check_instance
from cmfsim.values.image_data import ImageData

# Landmarks through which the plane runs above which surgery of the jaws moves no bone: the lower
# rims of the orbits and the roots of the zygomatic arches, close to the Frankfurt plane.
CRANIAL_LANDMARKS = ("suborbital_L", "suborbital_R", "supraglenoid_L", "supraglenoid_R")


def undeformed_mask(
    image: ImageData,
    landmarks: Mapping[str, ArrayLike],
    *,
    threshold: float = 250.0,
    margin: float = 4.0,
) -> ImageData:
    """A mask of the skull above the jaws, which jaw surgery does not change, with a margin.

    Parameters
    ----------
    image : ImageData
        CT in HU.
    landmarks : mapping of str to (3,) float64, mm
        Of the skull: "suborbital_L", "suborbital_R", "supraglenoid_L", "supraglenoid_R".
    threshold : float, HU
        Bone is above this.
    margin : float, mm
        Round the bone: the metric needs both sides of its surface.

    Returns
    -------
    ImageData
        uint8, 1 in the mask, on the grid of the image. For a Le Fort III or an operation on the
        vault, draw a mask by hand.

    Raises
    ------
    LandmarkError
        (also `ValueError`) A landmark is missing, or they lie on one line.
    RegistrationError
        (also `ValueError`) No bone above the plane.

    Examples
    --------
    >>> import cmfsim
    >>> mask = cmfsim.undeformed_mask(image, landmarks)  # doctest: +SKIP
    """
    check_instance("image", image, ImageData)
    as_number("threshold", threshold)
    as_positive("margin", margin)
    missing = [name for name in CRANIAL_LANDMARKS if name not in landmarks]
    if missing:
        raise LandmarkInputError(
            f"landmarks lack {', '.join(missing)}: they define the plane above the jaws, which "
            f"runs through {', '.join(CRANIAL_LANDMARKS)}"
        )
    points = as_rows(
        "landmarks", np.array([as_floats(name, landmarks[name]) for name in CRANIAL_LANDMARKS]), 3
    )
    centre = points.mean(axis=0)
    _, sizes, axes = np.linalg.svd(points - centre)
    # Up is +z in LPS, whichever way the head is tilted by less than a right angle.
    normal = axes[2] if axes[2, 2] > 0.0 else -axes[2]
    if sizes[1] < 0.1 * sizes[0]:
        raise LandmarkInputError(
            f"the landmarks {', '.join(CRANIAL_LANDMARKS)} are nearly on one line, so they do "
            "not define a plane"
        )
    x, y, z = image.axes()
    height = (x - centre[0]) * normal[0] + (y - centre[1]) * normal[1] + (z - centre[2]) * normal[2]
    bone = (image.values > threshold) & (height > 0.0)
    if not bone.any():
        raise RegistrationInputError(
            f"the image has no voxel above {threshold:g} HU on the upper side of the plane "
            f"through {', '.join(CRANIAL_LANDMARKS)}: check that it is in HU, and that image and "
            "landmarks are in one frame"
        )
    near = distance(np.asfortranarray(bone), image.spacing, margin) <= margin
    return image.with_values((near & (height > 0.0)).astype(np.uint8))
