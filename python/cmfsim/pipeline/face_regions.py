"""The landmarks by which regions of a face are placed: the case's own, else proposed ones."""

from collections.abc import Mapping
from dataclasses import dataclass

from cmfsim.errors import CmfsimError
from cmfsim.evaluation import SKIN_LANDMARKS
from cmfsim.pipeline.proposing import head_surfaces, propose_landmarks
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding
from cmfsim.values.patient_model import PatientModel


@dataclass(frozen=True)
class FaceLandmarks:
    """Landmarks that place the regions of a face.

    Attributes
    ----------
    points : mapping of str to (3,) float64, mm
        All of `SKIN_LANDMARKS`; empty where they are neither given nor found.
    findings : tuple of Finding
        That they were proposed, or why there are none.
    """

    points: Mapping[str, Floats]
    findings: tuple[Finding, ...] = ()


def face_landmarks(patient: PatientModel) -> FaceLandmarks:
    """The skin landmarks that place the regions of a patient's face.

    Those of the case where it has all of them; else they are proposed on its surfaces, which takes
    a few seconds. Proposed ones place regions, and nothing else: no distance depends on them.

    Parameters
    ----------
    patient : PatientModel
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
