"""Files and values: each format's reader beside its writer, one file per subject."""

import sys

from cmfsim.io.cases.case_files import Case as Case
from cmfsim.io.cases.case_files import CaseOrPath as CaseOrPath
from cmfsim.io.cases.case_files import as_case as as_case
from cmfsim.io.cases.case_tables import write_plan as write_plan
from cmfsim.io.cases.cohorts import AS_GIVEN as AS_GIVEN
from cmfsim.io.cases.cohorts import Cohort as Cohort
from cmfsim.io.cases.cohorts import Variant as Variant
from cmfsim.io.cases.cohorts import Variants as Variants
from cmfsim.io.cases.scenes import read_plan as read_plan
from cmfsim.io.cases.scenes import read_scene as read_scene
from cmfsim.io.cases.scenes import write_scene as write_scene
from cmfsim.io.cases.tables import CaseChanges as CaseChanges
from cmfsim.io.files.folders import finish_writing as finish_writing
from cmfsim.io.files.folders import replacing_files as replacing_files
from cmfsim.io.files.reading_writing import replace_text as replace_text
from cmfsim.io.files.reading_writing import replacing as replacing
from cmfsim.io.images.image_files import read_image as read_image
from cmfsim.io.images.image_files import write_image as write_image
from cmfsim.io.landmarks import read_landmark_file as read_landmark_file
from cmfsim.io.landmarks import read_landmarks as read_landmarks
from cmfsim.io.landmarks import write_landmarks as write_landmarks
from cmfsim.io.meshes import ply, surfaces
from cmfsim.io.meshes.mesh_files import read_tet_mesh as read_tet_mesh
from cmfsim.io.meshes.surfaces import read_bone_pair as read_bone_pair
from cmfsim.io.meshes.surfaces import read_moved_surface as read_moved_surface
from cmfsim.io.meshes.surfaces import read_surface as read_surface
from cmfsim.io.meshes.surfaces import read_surface_file as read_surface_file
from cmfsim.io.meshes.surfaces import write_surface as write_surface
from cmfsim.io.results.predictions import read_parts as read_parts
from cmfsim.io.results.predictions import write_prediction as write_prediction
from cmfsim.io.results.result_files import read_result as read_result
from cmfsim.io.results.result_files import result_suffixes as result_suffixes
from cmfsim.io.results.result_files import write_metrics as write_metrics
from cmfsim.io.results.result_files import write_model as write_model
from cmfsim.io.results.result_files import write_result as write_result
from cmfsim.io.slicer.output import write_slicer_bundle as write_slicer_bundle
from cmfsim.io.slicer.transforms import read_transform as read_transform
from cmfsim.io.slicer.transforms import write_transform as write_transform

# Scripts of others import these modules under their former names.
sys.modules[f"{__name__}.ply"] = ply
sys.modules[f"{__name__}.surfaces"] = surfaces
