"""The surfaces of a case, their unit and their frame, with the reasons."""

from cmfsim.drafting.surfaces.anatomy import Anatomy, Question
from cmfsim.drafting.surfaces.choosing import choose_surfaces

__all__ = ["Anatomy", "Question", "choose_surfaces"]
