"""Virtual patients: made heads, an operation, and the face that it truly makes (*in silico*).

The truth is computed by other means than the models that are tested on it: hyperelastic tissue, a
finer mesh, the person's own muscles and contact that only pushes, solved with scikit-fem and PyAMG.
"""

from cmfsim.insilico.equilibrium import EquilibriumOptions
from cmfsim.insilico.patient_folder import virtual_patients, write_virtual_patient
from cmfsim.insilico.people import PATIENTS, Relocation, VirtualPatient
from cmfsim.insilico.truth import PostoperativeTruth, postoperative_truth

__all__ = [
    "PATIENTS",
    "EquilibriumOptions",
    "PostoperativeTruth",
    "Relocation",
    "VirtualPatient",
    "postoperative_truth",
    "virtual_patients",
    "write_virtual_patient",
]
