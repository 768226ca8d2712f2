"""Occlusion: how the tooth rows meet before and after the operation, and splints between them."""

from cmfsim.planning.occlusion.contacts import ContactMap, contact_map, planned_contacts
from cmfsim.planning.occlusion.final_bite import FinalBite, final_bite
from cmfsim.planning.occlusion.molars import first_molars
from cmfsim.planning.occlusion.rows import ToothRow, bite_sites, patient_rows, rigid_of, tooth_rows
from cmfsim.planning.occlusion.splint import THICKNESS, Splint, splint_between

__all__ = [
    "THICKNESS",
    "ContactMap",
    "FinalBite",
    "Splint",
    "ToothRow",
    "bite_sites",
    "contact_map",
    "final_bite",
    "first_molars",
    "patient_rows",
    "planned_contacts",
    "rigid_of",
    "splint_between",
    "tooth_rows",
]
