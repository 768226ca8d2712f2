"""Each landmark of the skin where its own definition holds, supported by those of the skull."""

from collections.abc import Mapping

import numpy as np

from cmfsim.errors import third_party
from cmfsim.registration.proposed.definitions.depth_maps import STEP, DepthMap
from cmfsim.registration.proposed.definitions.profile import local_midline, smoothed
from cmfsim.values.checks import Floats

# The soft nasion lies so far below that of the bone, mm.
NASION_BELOW = 1.0
# The wing of the nose is widest so far behind its tip, mm.
WING_BEHIND = 21.5
# The corners of the eye lie at these shares of the distance of the orbit's middle from the midline.
INNER_CORNER, OUTER_CORNER = 0.54, 1.46
# The slit of the eye lies so far below the middle of the orbit, mm.
EYE_BELOW = 2.5
# The corners of the mouth lie so far from its middle, mm, in a face of average breadth.
MOUTH_CORNER = 26.6
# A lip stands out from the dent beside it by this, mm.
LEAST_LIP = 0.15

# The borders of the vermilion lie beyond the foremost points of the lips, up and down, and the
# corner under the nose above the deepest point of its profile, mm.
VERMILION, CORNER_ABOVE = (1.5, -0.75), 1.5

Sites = dict[str, Floats]


def find_skin_sites(front: DepthMap, skull: Mapping[str, Floats]) -> Sites:
    """The sites of the skin that are found, (3,) each, average-head mm.

    front: Of the skin, over x and z: y.
    skull: mapping of str to (3,). What `find_skull_sites` found.
    """
    found: Sites = {}
    if "nasion" in skull:
        _put(front, "nasion", skull["nasion"][0], skull["nasion"][2] - NASION_BELOW, found)
    tip = _tip(front, skull)
    if tip is not None:
        found["pronasale"] = tip
        _below_nose(front, tip, skull, found)
    for side, letter in ((1.0, "L"), (-1.0, "R")):
        _eye(front, skull, side, letter, found)
    return found


def _put(front: DepthMap, name: str, x: float, z: float, found: Sites) -> None:
    """The point of the skin that a ray from in front meets."""
    _, _, y = front.window((x - 1.2, x + 1.2), (z - 1.2, z + 1.2))
    if len(y) > 3:
        found[name] = np.array([x, float(np.median(y)), z])


def _tip(front: DepthMap, skull: Mapping[str, Floats]) -> Floats | None:
    """The tip of the nose: the foremost skin between nasal bones and upper teeth."""
    top, bottom = skull.get("rhinion"), skull.get("mid_philtrum")
    high = 16.0 if top is None else top[2] + 3.0
    low = -28.0 if bottom is None else bottom[2] - 4.0
    x, z, y = front.window((-12.0, 12.0), (low, high))
    if not len(y):
        return None
    near = y < y.min() + 0.4
    return np.array([x[near].mean(), y.min(), z[near].mean()])


def _below_nose(front: DepthMap, tip: Floats, skull: Mapping[str, Floats], found: Sites) -> None:
    middle = local_midline(front, (tip[2] - 42.0, tip[2] - 14.0))
    lean = float(tip[0]) if middle is None else middle
    z = front.columns
    line = smoothed(front.column(lean, 1.2), 0.8)
    chin = skull.get("pogonion")
    if chin is None:
        return
    _put(front, "pogonion", float(chin[0]), float(chin[2]) + 1.0, found)
    if "pogonion" not in found:
        return
    lip = skull.get("supradentale")
    # The deepest corner between the tip of the nose and the lip over the upper teeth.
    lip_z = -36.0 if lip is None else float(lip[2]) - 4.0
    corner = _bulge(z, line, lip_z, float(tip[2]), -1.0)
    if corner is None:
        return
    above = corner + round(CORNER_ABOVE / STEP)
    found["subnasale"] = np.array([lean, line[above], z[above]])
    _wings(front, tip, float(z[corner]), found)
    _lips(front, lean, (float(chin[2]), float(z[corner])), found)
    if "labiale_superius" in found and "labiale_inferius" in found:
        height = 0.5 * (found["labiale_superius"][2] + found["labiale_inferius"][2])
        for side, letter in ((1.0, "L"), (-1.0, "R")):
            _put(front, f"cheilion_{letter}", lean + side * MOUTH_CORNER, height, found)


def _bulge(z: Floats, line: Floats, low: float, high: float, outwards: float) -> int | None:
    inside = np.flatnonzero((z >= low) & (z <= high) & np.isfinite(line))
    if len(inside) < 5:
        return None
    a, b = inside[0], inside[-1]
    chord = line[a] + (line[b] - line[a]) * (z[inside] - z[a]) / (z[b] - z[a])
    return int(inside[np.argmax(outwards * (chord - line[inside]))])


def _lips(front: DepthMap, lean: float, ends: tuple[float, float], found: Sites) -> None:
    """The lips stand out from the chord between chin and nose, with a dent between them."""
    z, line = front.columns, smoothed(front.column(lean, 1.2), 0.8)
    inside = np.flatnonzero((z >= ends[0]) & (z <= ends[1]) & np.isfinite(line))[::-1]
    if len(inside) < 20:
        return
    a, b = inside[0], inside[-1]
    chord = line[a] + (line[b] - line[a]) * (z[inside] - z[a]) / (z[b] - z[a])
    out = chord - line[inside]
    signal = third_party("scipy.signal", "landmarks are proposed", "imaging")
    # The local maxima that rise from both sides by a lip's least height.
    peaks = signal.find_peaks(out, prominence=LEAST_LIP)[0].tolist()
    if len(peaks) < 2:
        return
    # The two that stand out most, from above.
    first, second = sorted(sorted(peaks, key=lambda k: -out[k])[:2])
    names = ("labiale_superius", "labiale_inferius")
    for name, k, beyond in zip(names, (first, second), VERMILION, strict=True):
        at = inside[k] + round(beyond / STEP)
        if np.isfinite(line[at]):
            found[name] = np.array([lean, line[at], z[at]])


def _wings(front: DepthMap, tip: Floats, base: float, found: Sites) -> None:
    """The most lateral points of the nose in the plane through its wings."""
    plane = tip[1] + WING_BEHIND
    columns = np.flatnonzero((front.columns >= base + 1.5) & (front.columns <= tip[2] + 4.0))
    middle = int(np.argmin(np.abs(front.rows - tip[0])))
    for side, letter in ((1, "L"), (-1, "R")):
        best: Floats | None = None
        for column in columns:
            values = front.values[:, column]
            k = middle
            while 0 < k < len(values) - 1 and values[k + side] < plane:
                k += side
            x = front.rows[k]
            if abs(x - tip[0]) < 28.0 and (best is None or side * x > side * best[0]):
                best = np.array([x + 0.5 * side * STEP, plane, front.columns[column]])
        if best is not None:
            found[f"alare_{letter}"] = best


def _eye(
    front: DepthMap, skull: Mapping[str, Floats], side: float, letter: str, found: Sites
) -> None:
    upper, lower = skull.get(f"supraorbital_{letter}"), skull.get(f"suborbital_{letter}")
    if upper is None or lower is None:
        return
    middle = skull["nasion"][0] if "nasion" in skull else 0.0
    across = side * (0.5 * (upper[0] + lower[0]) - middle)
    height = 0.5 * (upper[2] + lower[2])
    for name, share in (("endocanthion", INNER_CORNER), ("exocanthion", OUTER_CORNER)):
        _put(front, f"{name}_{letter}", middle + side * share * across, height - EYE_BELOW, found)
