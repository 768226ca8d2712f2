"""Bone segments from bones: cutting planes, standard procedures, the pieces and their surfaces."""

from cmfsim.bones.contact_sheets import ContactSheet, SheetOptions, contact_sheet, sheet_departure
from cmfsim.bones.cuts.cutting import (
    CutBones,
    CutOptions,
    cut_bones,
    part_segment,
    segments_from_surfaces,
)
from cmfsim.bones.cuts.planes import CuttingPlane, Procedure, free_cut
from cmfsim.bones.cuts.procedures import PROCEDURES, place_procedure, procedure_options
from cmfsim.bones.segment_checks import check_segments

__all__ = [
    "PROCEDURES",
    "ContactSheet",
    "CutBones",
    "CutOptions",
    "CuttingPlane",
    "Procedure",
    "SheetOptions",
    "check_segments",
    "contact_sheet",
    "cut_bones",
    "free_cut",
    "part_segment",
    "place_procedure",
    "procedure_options",
    "segments_from_surfaces",
    "sheet_departure",
]
