"""Files and values: each format's reader beside its writer, one file per subject."""

import sys

from cmfsim.io.cases.case_files import Case, CaseOrPath, as_case
from cmfsim.io.cases.case_plans import write_plan
from cmfsim.io.cases.cohorts import AS_GIVEN, Cohort, Variant, Variants
from cmfsim.io.cases.scenes import read_plan, read_scene, write_scene
from cmfsim.io.cases.tables import CaseChanges
from cmfsim.io.files.folders import finish_writing, replacing_files
from cmfsim.io.files.reading_writing import replacing
from cmfsim.io.images.image_files import read_image, write_image
from cmfsim.io.landmark_files import read_landmark_file, read_landmarks, write_landmarks
from cmfsim.io.meshes import ply
from cmfsim.io.meshes.mesh_files import read_tet_mesh
from cmfsim.io.results.metrics import write_metrics
from cmfsim.io.results.models import write_model
from cmfsim.io.results.predictions import read_parts, write_prediction
from cmfsim.io.results.result_files import read_result, result_suffixes, write_result
from cmfsim.io.slicer.output import write_slicer_bundle
from cmfsim.io.slicer.transforms import read_transform, write_transform
from cmfsim.io.surfaces import (
    read_bone_pair,
    read_moved_surface,
    read_surface,
    read_surface_file,
    write_surface,
)

# Scripts of others import this module under its former name.
sys.modules[f"{__name__}.ply"] = ply

__all__ = [
    "AS_GIVEN",
    "Case",
    "CaseChanges",
    "CaseOrPath",
    "Cohort",
    "Variant",
    "Variants",
    "as_case",
    "finish_writing",
    "read_bone_pair",
    "read_image",
    "read_landmark_file",
    "read_landmarks",
    "read_moved_surface",
    "read_parts",
    "read_plan",
    "read_result",
    "read_scene",
    "read_surface",
    "read_surface_file",
    "read_tet_mesh",
    "read_transform",
    "replacing",
    "replacing_files",
    "result_suffixes",
    "write_image",
    "write_landmarks",
    "write_metrics",
    "write_model",
    "write_plan",
    "write_prediction",
    "write_result",
    "write_scene",
    "write_slicer_bundle",
    "write_surface",
    "write_transform",
]
