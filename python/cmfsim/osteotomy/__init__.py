"""Bone segments from bones: cutting planes, standard procedures, the pieces and their surfaces."""

from cmfsim.osteotomy.cutting import CutBones, CutOptions, cut_bones, segments_from_surfaces
from cmfsim.osteotomy.parting import part_segment
from cmfsim.osteotomy.planes import Cut, CuttingPlane, Procedure, free_cut
from cmfsim.osteotomy.procedures import PROCEDURES, place_procedure, procedure_options
from cmfsim.osteotomy.segment_checks import check_segments
from cmfsim.osteotomy.sheets import ContactSheet, SheetOptions, contact_sheet, sheet_departure
from cmfsim.osteotomy.surfaces import (
    SurfaceOptions,
    contact_surface,
    simplified_surface,
    surface_of_level,
)

__all__ = [
    "PROCEDURES",
    "ContactSheet",
    "Cut",
    "CutBones",
    "CutOptions",
    "CuttingPlane",
    "Procedure",
    "SheetOptions",
    "SurfaceOptions",
    "check_segments",
    "contact_sheet",
    "contact_surface",
    "cut_bones",
    "free_cut",
    "part_segment",
    "place_procedure",
    "procedure_options",
    "segments_from_surfaces",
    "sheet_departure",
    "simplified_surface",
    "surface_of_level",
]
