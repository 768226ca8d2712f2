"""The surfaces of a case, their unit and their frame, with the reasons."""

from cmfsim.drafting.surfaces.anatomy import Anatomy as Anatomy
from cmfsim.drafting.surfaces.anatomy import Question as Question
from cmfsim.drafting.surfaces.choosing import choose_surfaces as choose_surfaces
