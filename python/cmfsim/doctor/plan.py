"""The plan of a case in a surgeon's words, from what can be read before any work."""

from collections.abc import Mapping

from cmfsim.checks import Floats
from cmfsim.clinical_plan import ClinicalMotion, clinical_motion
from cmfsim.doctor.evidence import Evidence
from cmfsim.scene import MovedSurface

__all__ = ["state_plan"]


def state_plan(
    evidence: Evidence, pieces: Mapping[str, Floats | None]
) -> dict[str, ClinicalMotion]:
    """The motion of each segment that the plan names and that can be read, by name.

    An achieved plan is empty here: it is read off the bones when the case is built.

    Parameters
    ----------
    evidence : Evidence
    pieces : mapping of str to (k, 6) float64 or None
        Points on the surface of a segment, with normals, where known.
    """
    found: dict[str, ClinicalMotion] = {}
    for name, given in evidence.case.plan.items():
        motion: Floats | MovedSurface
        if name in evidence.motions:
            motion = evidence.motions[name]
        else:
            moved = evidence.moved.get(name)
            if not isinstance(moved, MovedSurface):
                continue
            motion = moved
        piece = pieces.get(name)
        read = evidence.transforms.get(name)
        found[name] = clinical_motion(
            name,
            motion,
            landmarks=evidence.skull_landmarks,
            vertices=None if piece is None else piece[:, :3],
            centre=given.centre,
            source=given.source("" if read is None else read.text),
        )
    return found
