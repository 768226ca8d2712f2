"""The landmarks by which regions of a face are placed: the case's own, else proposed ones."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cmfsim.errors import CmfsimError, LandmarkInputError
from cmfsim.evaluation import SKIN_LANDMARKS, skin_regions
from cmfsim.pipeline.proposing import head_surfaces, propose_landmarks
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding
from cmfsim.values.patient_model import PatientModel
from cmfsim.values.prediction import Prediction


@dataclass(frozen=True)
class FaceLandmarks:
    """Landmarks that place the regions of a face.

    points: mapping of str to (3,), mm. All of `SKIN_LANDMARKS`; empty where they are neither given
        nor found.
    findings: That they were proposed, or why there are none.
    """

    points: Mapping[str, Floats]
    findings: tuple[Finding, ...] = ()


def face_landmarks(patient: PatientModel) -> FaceLandmarks:
    """The skin landmarks that place the regions of a patient's face.

    Those of the case where it has all of them; else they are proposed on its surfaces, which takes
    a few seconds. Proposed ones place regions, and nothing else: no distance depends on them.
    """
    known = patient.landmarks.get("skin", {})
    if patient.landmarks_are_found:
        errors = {
            name: site["error"] for name, site in patient.summary["landmarks"]["skin"].items()
        }
        return _proposed(known, errors)
    if all(name in known for name in SKIN_LANDMARKS):
        return FaceLandmarks(known)
    try:
        found = propose_landmarks(*head_surfaces(patient.anatomy)).skin
    except CmfsimError as error:
        return FaceLandmarks({}, (_none(str(error)),))
    points = {name: site.point for name, site in found.items()}
    return _proposed(points, {name: site.error for name, site in found.items()})


def _proposed(points: Mapping[str, Floats], errors: Mapping[str, float]) -> FaceLandmarks:
    """Proposed points, with what to know of them; none where one is missing."""
    missing = [name for name in SKIN_LANDMARKS if name not in points]
    if missing:
        return FaceLandmarks({}, (_none(f"{', '.join(missing)} were not found"),))
    worst = max(errors[name] for name in SKIN_LANDMARKS)
    note = Finding(
        "regions-none",
        "regions of the face are placed by proposed landmarks, each with an expected error of "
        f"up to {worst:.1f} mm",
        where="landmarks.skin",
        why="The case has no complete skin landmarks. The borders between regions are equally "
        "uncertain.",
    )
    return FaceLandmarks({name: points[name] for name in SKIN_LANDMARKS}, (note,))


def _none(reason: str) -> Finding:
    return Finding(
        "regions-none", f"the face is not divided into regions: {reason}", where="landmarks.skin"
    )


def face_motion(prediction: Prediction) -> dict[str, float]:
    """How far the skin of the face moves on average, as "face_mean", mm.

    Empty where the case has not all landmarks of the skin: nothing is looked for.
    """
    known = prediction.patient.landmarks.get("skin", {})
    if any(name not in known for name in SKIN_LANDMARKS):
        return {}
    try:
        face = skin_regions(prediction.skin_before.vertices, known)["face"]
    except LandmarkInputError:
        return {}
    moved = np.linalg.norm(prediction.skin_displacements[face], axis=1)
    return {"face_mean": float(moved.mean())} if len(moved) else {}
