"""Desired faces in files: a surface, or skin landmarks at their desired positions."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from cmfsim.errors import CaseInputError, LandmarkInputError
from cmfsim.io import read_landmarks, read_surface
from cmfsim.planning.face_planning import PointTarget, SurfaceTarget, Target
from cmfsim.planning.replanning import PlanningModel
from cmfsim.values.landmark_sites import label_key

SURFACES = (".stl", ".ply", ".obj", ".vtp")
LANDMARKS = (".json", ".fcsv")
# Tolerance of a point of the face, mm.
TARGET_STD = 0.5


def read_targets(path: Path) -> Callable[[PlanningModel], list[Target]]:
    """A function that returns the targets in a file, once the patient is built.

    Raises
    ------
    FileNotFoundError
        The file does not exist.
    CaseError, LandmarkError
        (also `ValueError`) An unknown suffix; a file whose content does not match its suffix.
    """
    ending = path.suffix.lower()
    if ending in SURFACES:
        wished = read_surface(path)
        return lambda _: [SurfaceTarget(wished, std=TARGET_STD)]
    if ending not in LANDMARKS:
        known = ", ".join((*SURFACES, ".mrk.json", ".fcsv"))
        raise CaseInputError(f"{path.name}: a file with a desired face ends in {known}")
    goals = {label_key(name): place for name, place in read_landmarks(path).items()}

    def targets(planning: PlanningModel) -> list[Target]:
        own = planning.patient.landmarks.get("skin", {})
        both = [name for name in own if label_key(name) in goals]
        if not both:
            raise LandmarkInputError(
                f"{path.name}: has none of the case's skin landmarks, which are: "
                f"{', '.join(own) or 'none'}"
            )
        places = np.array([own[name] for name in both])
        there = np.array([goals[label_key(name)] for name in both])
        return [PointTarget(places, there, std=TARGET_STD)]

    return targets
