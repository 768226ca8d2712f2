"""Definitions of the measures, in measures.csv: a formula and the sites to which it applies.

Angles are those between three points in space. The E-line (Ricketts 1968) runs from the tip of the
nose to the chin; distances from it are taken in the sagittal plane, positive in front. Heights are
differences along S. The facial thirds and the chin-throat length follow Legan and Burstone (1980).
"""

import csv
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.resources import files
from types import MappingProxyType
from typing import Any

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


def measures_of(group: str) -> tuple[Measure, ...]:
    """The measures of a group of measures.csv, in its order."""
    text = files(__package__).joinpath("measures.csv").read_text(encoding="utf-8")
    rows = [dict[str, Any](row) for row in csv.DictReader(text.splitlines())]
    return tuple(
        Measure(**{**row, "sites": tuple(row["sites"].split())})
        for row in rows
        if row.pop("group") == group
    )


def value_of(
    measure: Measure, formula: Callable[..., float], places: Mapping[str, Floats]
) -> float | None:
    """A measure by its formula of places, mm or degrees; None if one of its sites is missing."""
    if not all(name in places for name in measure.sites):
        return None
    return formula(*(np.asarray(places[name], dtype=np.float64) for name in measure.sites))


MEASURES = measures_of("face")


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
    return {m.key: value_of(m, FORMULAS[m.formula], places) for m in MEASURES}
