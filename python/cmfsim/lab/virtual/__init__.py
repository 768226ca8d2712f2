"""Virtual patients: synthetic heads, an operation, and the true face after it (*in silico*).

The true face is computed independently of the models that are tested on it: hyperelastic tissue, a
finer mesh, individual muscles and contact that only pushes, solved with scikit-fem and PyAMG.
`demo` writes the case that the package contains, and any head with its CT.
"""

from cmfsim.lab.virtual.mechanics.equilibrium import EquilibriumOptions as EquilibriumOptions
from cmfsim.lab.virtual.patient_folder import virtual_patients as virtual_patients
from cmfsim.lab.virtual.patient_folder import write_virtual_patient as write_virtual_patient
from cmfsim.lab.virtual.population import PATIENTS as PATIENTS
from cmfsim.lab.virtual.population import Relocation as Relocation
from cmfsim.lab.virtual.population import VirtualPatient as VirtualPatient
from cmfsim.lab.virtual.population import drawn_patient as drawn_patient
from cmfsim.lab.virtual.population_folder import PatientOutcome as PatientOutcome
from cmfsim.lab.virtual.population_folder import virtual_population as virtual_population
