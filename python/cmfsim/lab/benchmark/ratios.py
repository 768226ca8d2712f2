"""The entry of published ratios: skin landmarks follow bone by fixed shares.

Such shares are what planning in two dimensions rests on. They are known for few landmarks; between
these the face follows a thin-plate spline.
"""

from dataclasses import dataclass

import numpy as np

from cmfsim._core import ThinPlateSpline
from cmfsim.lab.benchmark.patients import BenchmarkPatient
from cmfsim.values.checks import Floats


@dataclass(frozen=True)
class Ratio:
    """The share of a bone's motion that a landmark of the skin follows.

    Attributes
    ----------
    skin : str
    bone : str
        The landmark of the skull whose planned motion counts.
    segments : tuple of str
        Who carries it: the first of these that the plan moves.
    forwards, backwards : float
    """

    skin: str
    bone: str
    segments: tuple[str, ...]
    forwards: float
    backwards: float


_UPPER = ("maxilla",)
_LOWER = ("mandible_body", "mandible")
_CHIN = ("chin", *_LOWER)
# Of 32 patients after Le Fort I and sagittal split, scanned in three dimensions (PMC6173856, 2018):
# pronasale 17 % and labiale superius 21 % of a maxilla advanced, 14 % of one set back; labiale
# inferius 66 % of the mandible. Of 26 patients after a setback (Angle Orthod 80:896, 2010):
# cheilion 3.4 mm where soft pogonion moved 6.7. Of 62 after an advancement with genioplasty
# (Veltkamp et al. 2002): soft pogonion thinned by 0.8 mm while bone came forward by 11 mm.
# They are of the sagittal motion, and are taken here for all three directions.
RATIOS = (
    Ratio("pronasale", "supradentale", _UPPER, 0.17, 0.17),
    Ratio("labiale_superius", "supradentale", _UPPER, 0.21, 0.14),
    Ratio("cheilion_L", "infradentale", _LOWER, 0.51, 0.51),
    Ratio("cheilion_R", "infradentale", _LOWER, 0.51, 0.51),
    Ratio("labiale_inferius", "infradentale", _LOWER, 0.66, 0.66),
    Ratio("pogonion", "pogonion", _CHIN, 0.93, 0.93),
)
# Landmarks that jaws do not move.
STILL = ("nasion", "exocanthion_L", "exocanthion_R", "endocanthion_L", "endocanthion_R")
# Skin this far from the mouth stays, mm; so many of its points hold the spline.
FAR, ANCHORS = 80.0, 60
# Axis that points backwards.
BACK = 1


def predict_by_ratios(patient: BenchmarkPatient) -> Floats:
    """The displacement of each vertex of the skin, (v, 3) mm."""
    skin, landmarks = patient.skin, patient.landmarks
    mouth = 0.5 * (landmarks["cheilion_L"] + landmarks["cheilion_R"])
    far = np.linalg.norm(skin - mouth, axis=1) > FAR
    anchors = skin[far][:: max(1, int(far.sum()) // ANCHORS)]
    moved = np.array([landmarks[ratio.skin] for ratio in RATIOS])
    still = np.vstack([[landmarks[name] for name in STILL], anchors])
    moves = np.array([_move(patient, ratio) for ratio in RATIOS])
    spline = ThinPlateSpline(np.vstack([moved, still]), np.vstack([moved + moves, still]))
    displacement = spline(skin) - skin
    displacement[far] = 0.0
    return displacement


def _move(patient: BenchmarkPatient, ratio: Ratio) -> Floats:
    """How a landmark of the skin moves, mm."""
    place = patient.skull_landmarks[ratio.bone]
    matrix = patient.planned_motion(*ratio.segments)
    move = matrix[:3, :3] @ place + matrix[:3, 3] - place
    return (ratio.backwards if move[BACK] > 0.0 else ratio.forwards) * move
