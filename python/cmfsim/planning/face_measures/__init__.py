"""Measures of a face that surgeons use: angles and distances between named sites."""

from cmfsim.planning.face_measures.definitions import MEASURES, Measure, measure_sites
from cmfsim.planning.face_measures.profile import midline_profile
from cmfsim.planning.face_measures.sites import BoneSite, FaceSites, face_sites, measure_face

__all__ = [
    "MEASURES",
    "BoneSite",
    "FaceSites",
    "Measure",
    "face_sites",
    "measure_face",
    "measure_sites",
    "midline_profile",
]
