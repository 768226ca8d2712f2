"""Rough places of chin, tooth rows and joints by shape alone, for heads without landmarks."""

from collections.abc import Mapping

from cmfsim.checks import Floats
from cmfsim.imaging.bone import Bone
from cmfsim.imaging.working import Working

__all__ = ["guessed_landmarks"]


def guessed_landmarks(work: Working, bone: Bone) -> Mapping[str, Floats] | None:
    """Landmarks guessed."""
    return None
