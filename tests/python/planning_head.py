"""A coarse synthetic head with sliding tissue, for planning."""

from pathlib import Path

import pytest

import cmfsim
from cmfsim.lab.virtual.demo import write_demo_case
from shared_values import COARSE_EDGE, coarse_demo_patient


def planning_patient(folder: Path, temporary: pytest.TempPathFactory) -> cmfsim.PatientModel:
    """The patient of the embedded case on a coarse mesh, whose files are written into a folder."""
    write_demo_case(folder, edge_length=COARSE_EDGE)
    return coarse_demo_patient(temporary)


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
