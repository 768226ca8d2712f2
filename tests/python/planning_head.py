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
