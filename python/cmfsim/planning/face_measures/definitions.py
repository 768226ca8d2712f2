"""Definitions of the measures: a formula and the sites to which it applies.

Angles are those between three points in space. The E-line (Ricketts 1968) runs from the tip of the
nose to the chin; distances from it are taken in the sagittal plane, positive in front. Heights are
differences along S. The facial thirds and the chin-throat length follow Legan and Burstone (1980).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from cmfsim.values.checks import Floats


@dataclass(frozen=True)
class Measure:
    """One measure of the face.

    Attributes
    ----------
    key : str
        Short stable name, such as "nasolabial_angle".
    label : str
        Common name.
    unit : str
        "°" or "mm".
    formula : str
        A key of `FORMULAS`.
    sites : tuple of str
        Arguments of the formula, in order.
    about : str
        Description.
    norm : str
        Mean ± standard deviation of adults without deformity, as published; empty if none is given.
    source : str
        Author and year of the norm.

    Examples
    --------
    >>> import cmfsim
    >>> [measure.label for measure in cmfsim.MEASURES if measure.unit == "°"]
    ['Nasolabial angle', 'Mentolabial angle', 'Facial convexity']
    """

    key: str
    label: str
    unit: str
    formula: str
    sites: tuple[str, ...]
    about: str
    norm: str = ""
    source: str = ""


def _angle(a: Floats, vertex: Floats, b: Floats) -> float:
    """The angle at `vertex`, degrees; exact also near 0 and 180 (Kahan 2006)."""
    u, v = a - vertex, b - vertex
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(u, v)), u @ v)))


def _in_front(point: Floats, upper: Floats, lower: Floats) -> float:
    """Distance of a point in front of a line in the sagittal plane, mm."""
    (py, pz), (dy, dz) = (point - upper)[1:], (lower - upper)[1:]
    return float((py * dz - pz * dy) / np.hypot(dy, dz))


def _distance(a: Floats, b: Floats) -> float:
    return float(np.linalg.norm(a - b))


def _height(a: Floats, b: Floats) -> float:
    """Height of `a` above `b` along S, mm."""
    return float(a[2] - b[2])


FORMULAS: Mapping[str, Callable[..., float]] = MappingProxyType(
    {"angle": _angle, "in_front": _in_front, "distance": _distance, "height": _height}
)

MEASURES = (
    Measure(
        "nasolabial_angle", "Nasolabial angle", "°", "angle",
        ("columella", "subnasale", "labiale_superius"),
        "at subnasale, between columella and labiale superius", "102 ± 8",
        "Legan and Burstone 1980",
    ),
    Measure(
        "mentolabial_angle", "Mentolabial angle", "°", "angle",
        ("labiale_inferius", "sublabiale", "pogonion"),
        "at sublabiale, between labiale inferius and pogonion",
    ),
    Measure(
        "convexity_angle", "Facial convexity", "°", "angle", ("glabella", "subnasale", "pogonion"),
        "at subnasale, between glabella and pogonion; 180° is straight", "168 ± 4",
        "Legan and Burstone 1980",
    ),
    Measure(
        "upper_lip_to_e_line", "Upper lip to E-line", "mm", "in_front",
        ("labiale_superius", "pronasale", "pogonion"),
        "labiale superius in front of the line from pronasale to pogonion",
    ),
    Measure(
        "lower_lip_to_e_line", "Lower lip to E-line", "mm", "in_front",
        ("labiale_inferius", "pronasale", "pogonion"),
        "labiale inferius in front of the line from pronasale to pogonion",
    ),
    Measure(
        "incisor_show", "Incisor show", "mm", "height", ("stomion_superius", "upper_incisor"),
        "height of the upper lip's edge above the edge of the upper incisors", "2 ± 2",
        "Legan and Burstone 1980",
    ),
    Measure(
        "interlabial_gap", "Interlabial gap", "mm", "height", ("upper_lip_edge", "lower_lip_edge"),
        "height from the edge of the lower lip to that of the upper lip", "2 ± 2",
        "Legan and Burstone 1980",
    ),
    Measure(
        "middle_third", "Middle third", "mm", "height", ("glabella", "subnasale"),
        "height from subnasale to glabella",
    ),
    Measure(
        "lower_third", "Lower third", "mm", "height", ("subnasale", "menton"),
        "height from menton to subnasale",
    ),
    Measure(
        "upper_lip_length", "Upper lip length", "mm", "height", ("subnasale", "stomion_superius"),
        "height from stomion superius to subnasale",
    ),
    Measure(
        "lower_lip_and_chin", "Lower lip and chin", "mm", "height", ("stomion_inferius", "menton"),
        "height from menton to stomion inferius",
    ),
    Measure(
        "chin_throat_length", "Chin–throat length", "mm", "distance", ("menton", "cervical_point"),
        "from menton to the cervical point",
    ),
    Measure(
        "nasal_width", "Width of the nose", "mm", "distance", ("alare_L", "alare_R"),
        "between the alaria",
    ),
    Measure(
        "mouth_width", "Width of the mouth", "mm", "distance", ("cheilion_L", "cheilion_R"),
        "between the corners of the mouth",
    ),
)  # fmt: skip


def measure_sites(places: Mapping[str, Floats]) -> dict[str, float | None]:
    """The value of each measure, from named sites; None if one of its sites is missing.

    Parameters
    ----------
    places : mapping of str to (3,) float64, mm, LPS

    Returns
    -------
    dict of str to float or None
        By `Measure.key`, mm or degrees.

    Examples
    --------
    >>> import cmfsim, numpy as np
    >>> mouth = {"cheilion_L": np.array([25, 0, 0]), "cheilion_R": np.array([-25, 0, 0])}
    >>> cmfsim.measure_sites(mouth)["mouth_width"]
    50.0
    """
    found: dict[str, float | None] = {}
    for measure in MEASURES:
        if all(name in places for name in measure.sites):
            sites = [np.asarray(places[name], dtype=np.float64) for name in measure.sites]
            found[measure.key] = FORMULAS[measure.formula](*sites)
        else:
            found[measure.key] = None
    return found
