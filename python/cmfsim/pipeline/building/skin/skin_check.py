"""Whether the skin shows a face where the skull has one: a nose, and tissue over bone."""

from collections.abc import Iterator, Mapping

import numpy as np

from cmfsim.values.anatomy import Anatomy
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding

# Sites of the skull that skin covers whatever the lips do.
COVERED = ("nasion", "mid_philtrum", "pogonion", "suborbital_L", "suborbital_R")
# Skin alone is 1.5 mm thick: less of all tissue in front of bone is none, mm.
LEAST_TISSUE = 1.2
# The nose stands out by more than this from the line from rhinion to mid-philtrum, mm, where nasion
# and mid-philtrum are 59 mm apart as in an average head; 26 to 28 in two real heads.
LEAST_NOSE, NOSE_HEIGHT = 9.0, 59.0
# How far in front of bone skin is looked for, in steps, mm.
FARTHEST, STEP = 50.0, 0.5


def check_skin(anatomy: Anatomy, skull: Mapping[str, Floats]) -> Iterator[Finding]:
    """Warnings where nose or tissue is missing in front of the skull."""
    front = _front(skull)
    if front is None:
        return
    bare = {
        name: depth
        for name in COVERED
        if name in skull and (depth := _tissue(anatomy, skull[name], front)) < LEAST_TISSUE
    }
    if bare:
        yield _missing(
            "tissue in front of bone is missing at "
            + ", ".join(f"{name} ({depth:.1f} mm)" for name, depth in bare.items())
        )
    if not {"rhinion", "mid_philtrum", "nasion"} <= skull.keys():
        return
    top, bottom = skull["rhinion"], skull["mid_philtrum"]
    size = float(np.linalg.norm(skull["nasion"] - bottom)) / NOSE_HEIGHT
    line = [top + share * (bottom - top) for share in np.linspace(0.2, 0.9, 8)]
    nose = max(_tissue(anatomy, point, front, last=True) for point in line)
    if nose < LEAST_NOSE * size:
        yield _missing(
            f"the skin has no nose: it stands out by {nose:.1f} mm between rhinion and upper lip "
            f"({LEAST_NOSE * size:.0f} mm at least are expected)"
        )


def _front(skull: Mapping[str, Floats]) -> Floats | None:
    """The direction in which the face looks, from pairs of sites and the midline."""
    pairs = [n[:-2] for n in skull if n.endswith("_L") and f"{n[:-2]}_R" in skull]
    if not pairs or not {"nasion", "supradentale"} <= skull.keys():
        return None
    left = np.sum([skull[f"{n}_L"] - skull[f"{n}_R"] for n in pairs], axis=0)
    front: Floats = np.cross(left, skull["nasion"] - skull["supradentale"])
    length = float(np.linalg.norm(front))
    return front / length if length > 0.0 else None


def _tissue(anatomy: Anatomy, point: Floats, front: Floats, *, last: bool = False) -> float:
    """How far the head reaches in front of a point, to the first or the last end of it, mm."""
    steps = np.arange(0.0, FARTHEST, STEP)
    inside = np.asarray(anatomy.skin.sample(point + steps[:, None] * front)) > 0.0
    if last:
        return float(steps[np.flatnonzero(inside)[-1]]) if inside.any() else 0.0
    return FARTHEST if inside.all() else float(steps[int(np.argmin(inside))])


def _missing(what: str) -> Finding:
    return Finding("skin-implausible", what, where="skin")
