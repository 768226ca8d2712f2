"""The patient's skin in full detail: tets are larger than what one sees of lips and lids."""

import logging
from importlib.util import find_spec

from cmfsim.case import Anatomy
from cmfsim.osteotomy import surface_of_level
from cmfsim.scene import SurfaceData

__all__ = ["detailed_face"]

_log = logging.getLogger(__name__)


def detailed_face(anatomy: Anatomy) -> SurfaceData | None:
    """The skin as it was given, or as the image shows it; None where scikit-image is missing."""
    given = anatomy.surfaces.get("skin")
    if given is not None:
        return given
    if find_spec("skimage") is None:
        _log.info("no detailed face: scikit-image is not installed")
        return None
    return surface_of_level("skin", anatomy.skin)
