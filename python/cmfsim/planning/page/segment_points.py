"""Points at which the motion of a segment is measured: incisors, canines, molars, chin."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from cmfsim.values.checks import Floats
from cmfsim.values.clinical_motion import NUMBERED, clinical_motion

# A landmark that several segments could have belongs to one within this of its surface, mm.
ON_SEGMENT = 6.0
# Canines stand at this share of half the width of the arch of second molars: intercanine to
# intermolar widths of 0.6 (Moyers 1988), on a parabola through incisors and molars.
CANINE_SHARE = 0.6
UPPER = (
    ("supradentale", "upper incisors"),
    ("upper_canine_L", "left upper canine"),
    ("upper_canine_R", "right upper canine"),
    ("supra_m2_L", "left upper second molar"),
    ("supra_m2_R", "right upper second molar"),
)
LOWER = (
    ("infradentale", "lower incisors"),
    ("lower_canine_L", "left lower canine"),
    ("lower_canine_R", "right lower canine"),
    ("sub_m2_L", "left lower second molar"),
    ("sub_m2_R", "right lower second molar"),
)
CHIN = (("pogonion", "pogonion"), ("menton", "menton"))
SITES: Mapping[str, tuple[tuple[str, str], ...]] = MappingProxyType(
    {
        "maxilla": UPPER,
        "midface": UPPER,
        "mandible": LOWER + CHIN,
        "mandible_body": LOWER + CHIN,
        "chin": CHIN,
        "ramus_left": (("gonion_L", "left gonion"),),
        "ramus_right": (("gonion_R", "right gonion"),),
    }
)
# Arches from which canines are estimated: front, left and right.
ARCHES = {
    "upper_canine": ("supradentale", "supra_m2_L", "supra_m2_R"),
    "lower_canine": ("infradentale", "sub_m2_L", "sub_m2_R"),
}


@dataclass(frozen=True, eq=False)
class SegmentPoint:
    """A point (3,), mm, before the operation, at which a segment's movement is stated."""

    label: str
    place: Floats


def segment_points(
    segment: str, landmarks: Mapping[str, Floats], vertices: Floats
) -> tuple[SegmentPoint, ...]:
    """The points of a segment: first that of its clinical motion, last its vertices' middle."""
    known = {**_canines(landmarks), **landmarks}
    stated = clinical_motion(segment, np.eye(4), landmarks=landmarks, vertices=vertices)
    points = []
    if stated.point is not None:
        points.append(SegmentPoint(stated.place, stated.point))
    for name, label in SITES.get(NUMBERED.sub("", segment), ()):
        place = known.get(name)
        if place is None or np.linalg.norm(vertices - place, axis=1).min() > ON_SEGMENT:
            continue
        if any(np.array_equal(place, point.place) for point in points):
            continue
        estimated = "" if name in landmarks else " (estimated)"
        points.append(SegmentPoint(f"{label}{estimated}", place))
    middle = vertices.mean(axis=0)
    if not any(np.allclose(middle, point.place) for point in points):
        points.append(SegmentPoint("middle of its surface", middle))
    return tuple(points)


def _canines(landmarks: Mapping[str, Floats]) -> dict[str, Floats]:
    """Canines on a parabola through incisors and second molars, where these are known."""
    found = {}
    for name, arch in ARCHES.items():
        if not all(site in landmarks for site in arch):
            continue
        tip, left, right = (landmarks[site] for site in arch)
        middle, half = 0.5 * (left + right), 0.5 * (left - right)
        back = (middle - tip) * CANINE_SHARE**2
        found[f"{name}_L"] = tip + back + CANINE_SHARE * half
        found[f"{name}_R"] = tip + back - CANINE_SHARE * half
    return found
