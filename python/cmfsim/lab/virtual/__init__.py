"""Virtual patients: synthetic heads, an operation, and the true face after it (*in silico*).

The true face is computed independently of the models that are tested on it: hyperelastic tissue, a
finer mesh, individual muscles and contact that only pushes, solved with scikit-fem and PyAMG.
`demo` is the case that the package contains; `phantom_case` writes a head with its CT.
"""

from cmfsim.lab.virtual.mechanics.equilibrium import EquilibriumOptions
from cmfsim.lab.virtual.patient_folder import virtual_patients, write_virtual_patient
from cmfsim.lab.virtual.population import PATIENTS, Relocation, VirtualPatient, drawn_patient
from cmfsim.lab.virtual.population_folder import PatientOutcome, virtual_population

__all__ = [
    "PATIENTS",
    "EquilibriumOptions",
    "PatientOutcome",
    "Relocation",
    "VirtualPatient",
    "drawn_patient",
    "virtual_patients",
    "virtual_population",
    "write_virtual_patient",
]
