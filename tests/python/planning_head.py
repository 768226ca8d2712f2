"""A coarse synthetic head with sliding tissue, built for planning: some ten seconds."""

from pathlib import Path

import cmfsim
from cmfsim.lab.virtual.demo import write_demo_case
from cmfsim.pipeline.building.stages import BuildOptions
from cmfsim.pipeline.predicting import build_patient

EDGE = 14.0


def planning_patient(folder: Path) -> cmfsim.PatientModel:
    """The patient of the embedded case on a coarse mesh, without muscles."""
    made = write_demo_case(folder, edge_length=EDGE)
    return build_patient(made.case, ("H+S",), BuildOptions(anatomy=made.anatomy, check=False))


def other_plan(planning, size=1.0):
    """Maxilla and mandible away from the reference, by mm and degrees of an ordinary plan."""
    skull = planning.patient.landmarks["skull"]
    plan = dict(planning.reference)
    plan["maxilla"] = cmfsim.planned_motion(
        skull["supradentale"], shift=(3.0 * size, 2.0, -1.0), turn=(-3.0, 2.0 * size, 1.0)
    )
    plan["mandible_body"] = cmfsim.planned_motion(
        skull["pogonion"], shift=(-2.0 * size, 1.0, -1.5), turn=(1.0, 1.5, -2.0 * size)
    )
    return plan


# The planning model ---------------------------------------------------------------------------
