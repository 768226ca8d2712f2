"""Sites at which a face is measured: given landmarks, and others found on the profile.

Sites that a case does not give are found by their definitions (Farkas 1994; Legan and Burstone
1980), once, on the profile before the operation. They are points of the tissue and move with the
skin; they are not found again on the moved face.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from cmfsim.errors import CaseInputError, LandmarkInputError
from cmfsim.planning.face_measures.definitions import MEASURES, measure_sites
from cmfsim.planning.face_measures.profile import midline_profile
from cmfsim.planning.occlusion.rows import bite_sites, patient_rows
from cmfsim.values.checks import Floats
from cmfsim.values.landmark_sites import label_key
from cmfsim.values.patient_model import PatientModel
from cmfsim.values.prediction import Prediction
from cmfsim.values.skin_motion import carried_points
from cmfsim.values.surface_data import MovedSurface

UPPER_INCISOR = "upper_incisor"
# Height of the glabella above the nasion, mm.
GLABELLA = (8.0, 35.0)
# Largest distance of menton behind pogonion, mm; range below it in which the throat is found, mm.
MENTON_BEHIND = 25.0
THROAT_BELOW = 45.0
# Shortest profile below menton from which the angle of the throat is determined, mm.
LEAST_THROAT = 20.0
# The edge of a lip is its furthest point towards the other lip; what lies deeper counts for less by
# this share of its depth, so that it is not sought inside the mouth.
LIP_DEPTH = 0.5
# Lips whose edges are closer than this, mm, are closed: their skin is connected and cannot open.
LEAST_GAP = 0.3


@dataclass(frozen=True, eq=False)
class BoneSite:
    """A site on bone or teeth.

    Attributes
    ----------
    place : (3,) float64, mm
        Before the operation.
    segment : str
        The segment with which it moves.
    """

    place: Floats
    segment: str


@dataclass(frozen=True, eq=False)
class FaceSites:
    """The sites of one face, before the operation.

    Attributes
    ----------
    skin : mapping of str to (3,) float64, mm
    bone : mapping of str to BoneSite
    absent : mapping of str to str
        Unknown sites that measures need, each with the reason.
    found : tuple of str
        Sites that were found on the profile or the bone instead of given by the case.
    """

    skin: Mapping[str, Floats]
    bone: Mapping[str, BoneSite]
    absent: Mapping[str, str]
    found: tuple[str, ...]

    def why_absent(self, sites: tuple[str, ...]) -> str:
        """Why a measure is not available; empty if it is."""
        reasons: dict[str, list[str]] = {}
        for name in sites:
            if name in self.absent:
                reasons.setdefault(self.absent[name], []).append(name.replace("_", " "))
        return "; ".join(
            f"{' and '.join(names)} {'is' if len(names) == 1 else 'are'} absent: {why}"
            for why, names in reasons.items()
        )


def face_sites(patient: PatientModel) -> FaceSites:
    """The sites of a patient's face before the operation.

    Parameters
    ----------
    patient : PatientModel
        Its skin landmarks are taken by name; those of `MEASURES` that they lack are found on the
        midline profile where that is possible.

    Returns
    -------
    FaceSites

    Examples
    --------
    >>> import cmfsim
    >>> sites = cmfsim.face_sites(patient)
    >>> sites.skin["columella"].round()
    array([...])
    """
    needed = dict.fromkeys(name for measure in MEASURES for name in measure.sites)
    keys = {label_key(name): name for name in needed}
    given = {
        keys.get(label_key(name), name): place
        for name, place in patient.landmarks.get("skin", {}).items()
    }
    skin = {name: given[name] for name in needed if name in given}
    absent: dict[str, str] = {}
    bone: dict[str, BoneSite] = {}
    on_profile = [name for name in needed if name not in skin and name in _FINDERS]
    try:
        profile = midline_profile(patient.face or patient.skin, given).points
    except LandmarkInputError as error:
        absent.update(dict.fromkeys(on_profile, str(error)))
    else:
        for name in on_profile:
            try:
                skin[name] = _FINDERS[name](profile, {**given, **skin})
            except LandmarkInputError as error:
                absent[name] = str(error)
    found = [name for name in on_profile if name in skin]
    try:
        edges = bite_sites(*patient_rows(patient))
    except CaseInputError as error:
        absent[UPPER_INCISOR] = str(error)
    else:
        if "U1" in edges:
            bone[UPPER_INCISOR] = BoneSite(*edges["U1"])
            found.append(UPPER_INCISOR)
        else:
            absent[UPPER_INCISOR] = "the upper tooth row has no cusps at the central incisors"
    for name in needed:
        if name not in skin and name not in bone:
            absent.setdefault(name, "the case has no such skin landmark")
    return FaceSites(skin, bone, absent, tuple(found))


def measure_face(prediction: Prediction, sites: FaceSites | None = None) -> dict[str, float | None]:
    """The measures of a predicted face; None if a site is missing.

    Parameters
    ----------
    prediction : Prediction
    sites : FaceSites, optional
        Sites of its patient; found if they are not given.

    Returns
    -------
    dict of str to float or None
        By `Measure.key`, mm or degrees.

    Examples
    --------
    >>> import cmfsim
    >>> measured = cmfsim.measure_face(prediction)
    >>> 90.0 < measured["nasolabial_angle"] < 150.0
    True
    """
    sites = sites or face_sites(prediction.patient)
    names = list(sites.skin)
    places: dict[str, Floats] = {}
    if names:
        before = np.array([sites.skin[name] for name in names])
        places.update(zip(names, before + prediction.carried(before), strict=True))
    places.update(moved_bone_sites(prediction, sites.bone))
    return measure_sites(places)


def moved_bone_sites(prediction: Prediction, bone: Mapping[str, BoneSite]) -> dict[str, Floats]:
    """Sites of bone after the operation, (3,) mm each; without those whose motion is not known."""
    found = {}
    for name, site in bone.items():
        motion = prediction.scene.plan.get(site.segment)
        if motion is None:
            found[name] = site.place
        elif isinstance(motion, MovedSurface):
            shifts = motion.moved_vertices - motion.surface.vertices
            found[name] = site.place + carried_points(motion.surface, shifts, site.place[None])[0]
        elif motion.shape == (4, 4):
            found[name] = motion[:3, :3] @ site.place + motion[:3, 3]
    return found


def _at(profile: Floats, known: Mapping[str, Floats], name: str) -> int:
    """The point of the profile nearest to a landmark."""
    if name not in known:
        raise LandmarkInputError(f"it is located by means of {name}, which the case does not have")
    return int(np.argmin(np.linalg.norm(profile - known[name], axis=1)))


def _between(profile: Floats, known: Mapping[str, Floats], upper: str, lower: str) -> Floats:
    """The part of the profile between two landmarks, from top to bottom."""
    first, last = _at(profile, known, upper), _at(profile, known, lower)
    if last - first < 2:
        raise LandmarkInputError(f"{upper} does not lie above {lower} on the profile")
    return profile[first : last + 1]


def _glabella(profile: Floats, known: Mapping[str, Floats]) -> Floats:
    above = profile[:, 2] - profile[_at(profile, known, "nasion"), 2]
    part = profile[(above >= GLABELLA[0]) & (above <= GLABELLA[1])]
    if not len(part):
        raise LandmarkInputError("the skin ends too close above nasion")
    foremost: Floats = part[np.argmin(part[:, 1])]
    return foremost


def _columella(profile: Floats, known: Mapping[str, Floats]) -> Floats:
    """Half-way along the profile from pronasale to subnasale."""
    part = _between(profile, known, "pronasale", "subnasale")
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(part, axis=0), axis=1))])
    return np.array([np.interp(0.5 * way[-1], way, part[:, axis]) for axis in range(3)])


def _lips(profile: Floats, known: Mapping[str, Floats]) -> tuple[Floats, Floats]:
    """The profiles of the upper and the lower lip, divided at the deepest point between them."""
    part = _between(profile, known, "labiale_superius", "labiale_inferius")
    deepest = _deepest(part, "the profile shows no cleft between the lips")
    return part[: deepest + 1], part[deepest:]


def _deepest(part: Floats, without: str) -> int:
    """The point of a part of the profile furthest behind, or above, the line between its ends.

    without: What the error says where that is one of the ends.
    """
    (dy, dz) = (part[-1] - part[0])[1:]
    away = part - part[0]
    deepest = int(np.argmax(away[:, 2] * dy - away[:, 1] * dz))
    if not 0 < deepest < len(part) - 1:
        raise LandmarkInputError(without)
    return deepest


def _stomia(profile: Floats, known: Mapping[str, Floats]) -> tuple[Floats, Floats]:
    """The edges of both lips."""
    upper, lower = _lips(profile, known)
    lowest = np.argmin(upper[:, 2] + LIP_DEPTH * upper[:, 1])
    return upper[lowest], lower[np.argmax(lower[:, 2] - LIP_DEPTH * lower[:, 1])]


def _open(profile: Floats, known: Mapping[str, Floats]) -> tuple[Floats, Floats]:
    """The edges of lips that are open."""
    upper, lower = _stomia(profile, known)
    if np.linalg.norm(upper - lower) < LEAST_GAP:
        raise LandmarkInputError("the lips are closed, and joined in this model")
    return upper, lower


def _sublabiale(profile: Floats, known: Mapping[str, Floats]) -> Floats:
    """The point between lower lip and chin furthest behind the line that connects them."""
    part = _between(profile, known, "labiale_inferius", "pogonion")
    fold: Floats = part[_deepest(part, "the profile has no fold between lower lip and chin")]
    return fold


def _menton(profile: Floats, known: Mapping[str, Floats]) -> Floats:
    """The profile from menton down, the lowest point under the chin."""
    part = profile[_at(profile, known, "pogonion") :]
    under = np.flatnonzero(part[:, 1] <= part[0, 1] + MENTON_BEHIND)
    # Ends where the profile first leaves the chin.
    under = under[: int(np.argmax(np.diff(under, append=len(part) + 1) > 1)) + 1]
    lowest = int(under[np.argmin(part[under, 2])])
    if lowest in (0, len(part) - 1):
        raise LandmarkInputError("the skin ends at the chin")
    return part[lowest:]


def _cervical_point(profile: Floats, known: Mapping[str, Floats]) -> Floats:
    """The point between chin and neck furthest above the line that connects them."""
    throat = _menton(profile, known)
    throat = throat[throat[:, 2] >= throat[0, 2] - THROAT_BELOW]
    if throat[0, 2] - throat[:, 2].min() < LEAST_THROAT:
        raise LandmarkInputError(
            f"the image does not show the skin {LEAST_THROAT:g} mm below menton, down the neck"
        )
    angle: Floats = throat[_deepest(throat, "there is no angle between chin and neck")]
    return angle


_FINDERS: Mapping[str, Callable[[Floats, Mapping[str, Floats]], Floats]] = {
    "glabella": _glabella,
    "columella": _columella,
    "stomion_superius": lambda profile, known: _stomia(profile, known)[0],
    "stomion_inferius": lambda profile, known: _stomia(profile, known)[1],
    "upper_lip_edge": lambda profile, known: _open(profile, known)[0],
    "lower_lip_edge": lambda profile, known: _open(profile, known)[1],
    "sublabiale": _sublabiale,
    "menton": lambda profile, known: _menton(profile, known)[0],
    "cervical_point": _cervical_point,
}
