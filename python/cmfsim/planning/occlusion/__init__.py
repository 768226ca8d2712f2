"""Occlusion: how the tooth rows meet before and after the operation, and splints between them."""

from cmfsim.planning.occlusion.contacts import ContactMap as ContactMap
from cmfsim.planning.occlusion.contacts import contact_map as contact_map
from cmfsim.planning.occlusion.contacts import planned_contacts as planned_contacts
from cmfsim.planning.occlusion.final_bite import FinalBite as FinalBite
from cmfsim.planning.occlusion.final_bite import final_bite as final_bite
from cmfsim.planning.occlusion.molars import first_molars as first_molars
from cmfsim.planning.occlusion.rows import ToothRow as ToothRow
from cmfsim.planning.occlusion.rows import bite_sites as bite_sites
from cmfsim.planning.occlusion.rows import patient_rows as patient_rows
from cmfsim.planning.occlusion.rows import rigid_of as rigid_of
from cmfsim.planning.occlusion.rows import tooth_rows as tooth_rows
from cmfsim.planning.occlusion.splint import THICKNESS as THICKNESS
from cmfsim.planning.occlusion.splint import Splint as Splint
from cmfsim.planning.occlusion.splint import splint_between as splint_between
