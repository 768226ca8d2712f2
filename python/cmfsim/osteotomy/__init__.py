"""Bone segments from bones: cutting planes, standard procedures, the pieces and their surfaces."""

from cmfsim.osteotomy.cutting import CutBones, CutOptions, cut_bones, segments_from_surfaces
from cmfsim.osteotomy.planes import Cut, CuttingPlane, Procedure, free_cut
from cmfsim.osteotomy.procedures import PROCEDURES, place_procedure, procedure_options
from cmfsim.osteotomy.surfaces import SurfaceOptions, surface_of_level

__all__ = [
    "PROCEDURES",
    "Cut",
    "CutBones",
    "CutOptions",
    "CuttingPlane",
    "Procedure",
    "SurfaceOptions",
    "cut_bones",
    "free_cut",
    "place_procedure",
    "procedure_options",
    "segments_from_surfaces",
    "surface_of_level",
]
