"""Measures of a face that surgeons use: angles and distances between named sites."""

from cmfsim.planning.face_measures.cephalometry import (
    CEPHALOMETRIC_MEASURES as CEPHALOMETRIC_MEASURES,
)
from cmfsim.planning.face_measures.cephalometry import cephalometry as cephalometry
from cmfsim.planning.face_measures.clinical_figures import clinical_figures as clinical_figures
from cmfsim.planning.face_measures.definitions import MEASURES as MEASURES
from cmfsim.planning.face_measures.definitions import Measure as Measure
from cmfsim.planning.face_measures.definitions import measure_sites as measure_sites
from cmfsim.planning.face_measures.occlusion import OCCLUSAL_MEASURES as OCCLUSAL_MEASURES
from cmfsim.planning.face_measures.occlusion import occlusion as occlusion
from cmfsim.planning.face_measures.profile import midline_profile as midline_profile
from cmfsim.planning.face_measures.sites import BoneSite as BoneSite
from cmfsim.planning.face_measures.sites import FaceSites as FaceSites
from cmfsim.planning.face_measures.sites import face_sites as face_sites
from cmfsim.planning.face_measures.sites import measure_face as measure_face
