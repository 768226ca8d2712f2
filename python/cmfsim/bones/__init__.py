"""Bone segments from bones: cutting planes, standard procedures, the pieces and their surfaces."""

from cmfsim.bones.contact_sheets import ContactSheet as ContactSheet
from cmfsim.bones.contact_sheets import SheetOptions as SheetOptions
from cmfsim.bones.contact_sheets import contact_sheet as contact_sheet
from cmfsim.bones.contact_sheets import sheet_departure as sheet_departure
from cmfsim.bones.cuts.cutting import CutBones as CutBones
from cmfsim.bones.cuts.cutting import cut_bones as cut_bones
from cmfsim.bones.cuts.cutting import part_segment as part_segment
from cmfsim.bones.cuts.cutting import segments_from_surfaces as segments_from_surfaces
from cmfsim.bones.cuts.planes import CuttingPlane as CuttingPlane
from cmfsim.bones.cuts.planes import Procedure as Procedure
from cmfsim.bones.cuts.planes import free_cut as free_cut
from cmfsim.bones.cuts.procedures import PROCEDURES as PROCEDURES
from cmfsim.bones.cuts.procedures import place_procedure as place_procedure
from cmfsim.bones.cuts.procedures import placed_cut as placed_cut
from cmfsim.bones.cuts.procedures import procedure_options as procedure_options
from cmfsim.bones.segment_checks import check_segments as check_segments
