"""Cephalometry: angles and distances of the jaws and incisors in the lateral view.

Sites are projected onto the midsagittal plane, pairs at their middle, and named by their
abbreviations (`cmfsim.values.landmark_sites.CEPHALOMETRY`). Lengths are not enlarged, as those of a
radiograph are.

The occlusal plane runs through the middle of the edges of upper and lower incisors and the middle
of the first molars, where these sites are given; otherwise through the cusps that the bones show,
or it is estimated from their edges, `supradentale` and `infradentale`, `supra_m2` and `sub_m2`. The
Frankfort plane runs through porion and orbitale; without porion it is that of the average head,
registered to the cranium.
"""

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from cmfsim._core import rigid_fit
from cmfsim.errors import CaseInputError, LandmarkInputError, RegistrationError
from cmfsim.planning.face_measures.definitions import measures_of, value_of
from cmfsim.values.checks import Floats, as_point
from cmfsim.values.landmark_sites import REFERENCE_PLACES, is_lower_site, profile_sites

# Sites that are constructed: points of the Frankfort plane and of the occlusal plane.
FRANKFORT, OCCLUSAL = ("FH-back", "FH-front"), ("OP-back", "OP-front")
# The pairs of sites in whose middle the points of the occlusal plane lie, the best first.
BITES = (
    (("U6", "L6"), ("U1", "L1")),
    (("U-back", "L-back"), ("U-front", "L-front")),
    (("supra_m2", "sub_m2"), ("Pr", "Id")),
)


# With the labels of both sides exchanged, landmarks that fit the average head so much better were
# exchanged; sites of one side and the midline may fit equally well both ways.
EXCHANGED = 0.8


def _turn(a: Floats, b: Floats, c: Floats, d: Floats) -> float:
    """The angle from the direction a→b to c→d, degrees; positive from down to forwards."""
    u, v = b - a, d - c
    return float(np.degrees(np.arctan2(u[0] * v[1] - u[1] * v[0], u @ v)))


def _along(a: Floats, b: Floats, c: Floats, d: Floats) -> float:
    """How much further `c` lies along the direction a→b than `d`, mm."""
    return float((b - a) @ (c - d) / np.hypot(*(b - a)))


def _across(a: Floats, b: Floats, c: Floats, d: Floats) -> float:
    """How far `c` lies to the left of a→b from `d`, mm: ahead of a line that runs down."""
    (x, y), (v, w) = b - a, c - d
    return float((x * w - y * v) / np.hypot(x, y))


# Of points (forwards, up), (2,) mm, with what they give in words.
FORMULAS: Mapping[str, tuple[Callable[[Floats, Floats, Floats, Floats], float], str]] = {
    "turn": (_turn, "angle from {}–{} to {}–{}"),
    "along": (_along, "along {}–{}, {} in front of {}"),
    "across": (_across, "across {0}–{1}, from {3} to {2}; positive in front or above"),
}
# Steiner: Am J Orthod 39:729–755; Downs: Am J Orthod 34:812–840; Jacobson: Am J Orthod 67:125–138.
CEPHALOMETRIC_MEASURES = tuple(
    replace(measure, about=FORMULAS[measure.formula][1].format(*measure.sites))
    for measure in measures_of("cephalometry")
)


def cephalometry(
    landmarks: Mapping[str, ArrayLike], before: Mapping[str, ArrayLike] | None = None
) -> dict[str, float | None]:
    """The value of each of `CEPHALOMETRIC_MEASURES`; None if one of its sites is missing.

    Parameters
    ----------
    landmarks : mapping of str to (3,) float64, mm, LPS
        Labels of `SKULL_LANDMARKS`, or abbreviations: "S", "Po_L" and "Po_R" (or "Po"), "Gn", "U1"
        and "L1" (edges of the central incisors), "U1R" and "L1R" (tips of their roots), "U6", "L6".
    before : mapping of str to (3,) float64, mm, LPS, optional
        Those before the operation, which determine the midsagittal plane and the horizontal.

    Returns
    -------
    dict of str to float or None
        By `Measure.key`, mm or degrees.

    Raises
    ------
    LandmarkError
        (also `ValueError`) A landmark that is not three finite numbers; left and right swapped.

    Examples
    --------
    >>> import cmfsim
    >>> sites = {"N": (0, -90, 30), "A": (0, -94, -29), "B": (0, -90, -66)}
    >>> round(cmfsim.cephalometry(sites)["anb"], 2)
    3.88
    """
    places = projected(known_sites(landmarks), None if before is None else known_sites(before))
    return {m.key: value_of(m, FORMULAS[m.formula][0], places) for m in CEPHALOMETRIC_MEASURES}


def known_sites(landmarks: Mapping[str, ArrayLike]) -> dict[str, Floats]:
    """The landmarks as points, mm; `LandmarkError` unless each is three finite numbers."""
    try:
        return {name: as_point(f"landmark {name}", place) for name, place in landmarks.items()}
    except CaseInputError as error:
        raise LandmarkInputError(str(error)) from error


def missing_sites(landmarks: Mapping[str, ArrayLike]) -> dict[str, str]:
    """The sites that each measure lacks, by its key, in words; empty if it lacks none."""
    places = projected(landmarks)
    missing = {
        m.key: [name for name in dict.fromkeys(m.sites) if name not in places]
        for m in CEPHALOMETRIC_MEASURES
    }
    return {
        key: f"{', '.join(names)}: not given or found" if names else ""
        for key, names in missing.items()
    }


def head_axes(landmarks: Mapping[str, ArrayLike]) -> Floats:
    """The directions forwards and up of a head, (2, 3), in its midsagittal plane.

    The plane is normal to the mean direction between the two sides of the cranium, and forwards
    lies in the Frankfort plane of the average head registered to the cranium. With fewer than three
    sites of it, both are those of the coordinates.

    Raises `LandmarkError`: Left and right are swapped, from which no midsagittal plane follows.
    """
    average = REFERENCE_PLACES["skull"]
    names = [name for name in average if name in landmarks and not is_lower_site(name)]
    places = {name: np.asarray(landmarks[name], dtype=np.float64) for name in names}
    turn = np.eye(3)
    if len(names) >= 3:
        # Sites on a line tell no turn.
        with contextlib.suppress(RegistrationError):
            known, given = [average[name] for name in names], [*places.values()]
            fit = rigid_fit(known, given)
            turn = fit.matrix[:3, :3]
            exchanged = rigid_fit([average[_other_side(name)] for name in names], given)
            if exchanged.rms < EXCHANGED * fit.rms:
                raise LandmarkInputError(
                    "left and right are swapped in the landmarks of the cranium: L and R are the "
                    "patient's sides; swap the labels _L and _R, or if the whole head is mirrored, "
                    "export it again"
                )
    lefts = [name for name in names if name.endswith("_L") and f"{name[:-2]}_R" in places]
    across = sum((places[n] - places[f"{n[:-2]}_R"] for n in lefts), np.zeros(3))
    across = across if lefts else turn[:, 0]
    across = across / np.linalg.norm(across)
    forwards = -turn[:, 1] + (turn[:, 1] @ across) * across
    forwards = forwards / np.linalg.norm(forwards)
    return np.stack([forwards, np.cross(forwards, across)])


def _other_side(name: str) -> str:
    return name[:-1] + {"L": "R", "R": "L"}[name[-1]] if name[-2:] in ("_L", "_R") else name


def projected(
    landmarks: Mapping[str, ArrayLike], before: Mapping[str, ArrayLike] | None = None
) -> dict[str, Floats]:
    """The sites in the midsagittal plane, (forwards, up), with those that are constructed."""
    at_rest = landmarks if before is None else before
    plane = head_axes(at_rest)
    rest, places = (
        {name: plane @ place for name, place in profile_sites(sites).items()}
        for sites in (at_rest, landmarks)
    )
    places.update(occlusal_plane(places))
    # An orbit that is moved does not turn the horizontal.
    given = {"Po", "Or"} <= rest.keys()
    level = (rest["Po"], rest["Or"]) if given else (np.zeros(2), np.array([1.0, 0.0]))
    places.update(zip(FRANKFORT, level, strict=True))
    return places


def occlusal_plane(sites: Mapping[str, Floats]) -> dict[str, Floats]:
    """The points of the occlusal plane, from those of `profile_sites`; none where they lack."""
    for ends in BITES:
        if all(name in sites for pair in ends for name in pair):
            middles = [0.5 * (sites[upper] + sites[lower]) for upper, lower in ends]
            return dict(zip(OCCLUSAL, middles, strict=True))
    return {}
