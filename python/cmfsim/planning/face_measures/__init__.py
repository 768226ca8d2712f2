"""Measures of a face that surgeons use: angles and distances between named sites."""

from cmfsim.planning.face_measures.cephalometry import CEPHALOMETRIC_MEASURES, cephalometry
from cmfsim.planning.face_measures.clinical_figures import clinical_figures
from cmfsim.planning.face_measures.definitions import MEASURES, Measure, measure_sites
from cmfsim.planning.face_measures.occlusion import OCCLUSAL_MEASURES, occlusion
from cmfsim.planning.face_measures.profile import midline_profile
from cmfsim.planning.face_measures.sites import BoneSite, FaceSites, face_sites, measure_face

__all__ = [
    "CEPHALOMETRIC_MEASURES",
    "MEASURES",
    "OCCLUSAL_MEASURES",
    "BoneSite",
    "FaceSites",
    "Measure",
    "cephalometry",
    "clinical_figures",
    "face_sites",
    "measure_face",
    "measure_sites",
    "midline_profile",
    "occlusion",
]
