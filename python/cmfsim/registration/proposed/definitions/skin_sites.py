"""Each landmark of the skin where its own definition holds, supported by those of the skull."""

from collections.abc import Mapping
from itertools import pairwise

import numpy as np

from cmfsim.errors import third_party
from cmfsim.registration.proposed.definitions.depth_maps import STEP, DepthMap
from cmfsim.registration.proposed.definitions.profile import local_midline, smoothed
from cmfsim.values.checks import Floats

# The soft nasion lies so far below that of the bone, mm.
NASION_BELOW = 1.0
# The sides of the nose, within so far of its middle, mm, end where they slope less than this in a
# front view blurred by so much, mm; its wing is where they reach out within this of farthest, mm.
NOSE_REACH, WING_SLOPE, BLUR, WIDEST = 30.0, 1.3, 0.75, 0.5
# The wing lies so far behind the tip, and so far before that end and below it, mm: the mean of two
# real heads, from which each is 0.2 and 0.5 mm off.
WING_BEHIND, WING_BEFORE, WING_DOWN = 20.7, 1.6, 0.8
# The corners of the eye lie at these shares of the distance of the orbit's middle from the midline.
INNER_CORNER, OUTER_CORNER = 0.54, 1.46
# The slit of the eye lies so far below the middle of the orbit, mm.
EYE_BELOW = 2.5
# The line between closed lips is a groove as deep as this, mm, between blurs of two widths. It ends
# where it is half as deep as where it is deepest: so far from the middle, in a face of average
# breadth.
GROOVE, GROOVE_SIGMAS, MOUTH_REACH = (0.3, 4.0), (0.8, 4.0), (20.0, 37.0)
# A corner lies so far before that end and above it, mm: the mean of two real heads, from which each
# is 0.8 and 0.6 mm off. Without a groove it lies so far from the middle.
CORNER_BEFORE, CORNER_UP, MOUTH_CORNER = 1.2, 1.8, 26.6
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
        for step, letter in ((1, "L"), (-1, "R")):
            across, up = _mouth_corner(front, lean, float(height), step)
            _put(front, f"cheilion_{letter}", across, up, found)


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
    peaks = _peaks(out, LEAST_LIP)
    if len(peaks) < 2:
        return
    # The two that stand out most, from above.
    first, second = sorted(sorted(peaks, key=lambda k: -out[k])[:2])
    names = ("labiale_superius", "labiale_inferius")
    for name, k, beyond in zip(names, (first, second), VERMILION, strict=True):
        at = inside[k] + round(beyond / STEP)
        if np.isfinite(line[at]):
            found[name] = np.array([lean, line[at], z[at]])


def _peaks(line: Floats, least: float) -> list[int]:
    """The local maxima that rise from both sides by so much; the middle of one that is flat.

    Those of SciPy's `find_peaks` by prominence; loading `scipy.signal` takes half a second.
    """
    found = []
    changes = np.flatnonzero(np.diff(line)).tolist()
    for before, last in pairwise(changes):
        top, after = line[last], last + 1
        if max(line[before], line[after]) < top:
            higher = np.flatnonzero(line > top)
            low = higher[higher < last].max(initial=-1) + 1
            high = higher[higher > last].min(initial=len(line))
            if top - max(line[low:last].min(), line[after:high].min()) >= least:
                found.append((before + after) // 2)
    return found


def _mouth_corner(front: DepthMap, lean: float, height: float, side: int) -> tuple[float, float]:
    """Where the line between the lips ends on one side: across and in height."""
    ndimage = third_party("scipy.ndimage", "landmarks are proposed", "imaging")
    near = np.abs(front.columns - height) < MOUTH_REACH[1]
    first = int(np.argmin(np.abs(front.rows - lean)))
    rows = front.values[first::side, near][: round((MOUTH_REACH[1] + 5.0) / STEP)]
    depth = ndimage.gaussian_filter1d(np.where(np.isfinite(rows), rows, 0.0), 1.2 / STEP, axis=0)
    fine, coarse = (ndimage.gaussian_filter1d(depth, s / STEP, axis=1) for s in GROOVE_SIGMAS)
    groove, z = fine - coarse, front.columns[near]
    at = int(np.argmax(np.where(np.abs(z - height) < 6.0, groove[0], -np.inf)))
    path = []
    for row in groove:
        low = max(at - 2, 0)
        at = low + int(np.argmax(row[low : at + 3]))
        path.append(at)
    along = groove[np.arange(len(path)), path]
    deepest = int(np.argmax(along[: round(MOUTH_REACH[1] / STEP)]))
    ends = np.flatnonzero(along[deepest:] < 0.5 * along[deepest])
    end = deepest + int(ends[0]) if len(ends) else len(along)
    is_groove = GROOVE[0] < along[deepest] < GROOVE[1]
    if not is_groove or not MOUTH_REACH[0] < STEP * end < MOUTH_REACH[1]:
        return lean + side * MOUTH_CORNER, height
    across = abs(float(front.rows[first + side * end]) - lean) - 0.5 * STEP
    return lean + side * (across - CORNER_BEFORE), float(z[path[end]]) + CORNER_UP


def _wings(front: DepthMap, tip: Floats, base: float, found: Sites) -> None:
    """The most lateral points of the nose: where its steep sides reach farthest out.

    Where a side ends is clear across and in height, and not in depth, which is the usual one.
    """
    ndimage = third_party("scipy.ndimage", "landmarks are proposed", "imaging")
    heights = (front.columns >= base + 1.5) & (front.columns <= tip[2] + 4.0)
    middle, count = int(np.argmin(np.abs(front.rows - tip[0]))), round(NOSE_REACH / STEP)
    for side, letter in ((1, "L"), (-1, "R")):
        half = front.values[middle::side, heights][:count]
        half = np.where(np.isfinite(half), half, np.fmax.accumulate(half, axis=0))
        if not half.size or not np.isfinite(half).all():
            continue
        slope = np.gradient(ndimage.gaussian_filter(half, BLUR / STEP), STEP, axis=0)
        steepest = np.argmax(slope, axis=0)
        beyond = (np.arange(count)[:, None] > steepest) & (slope < WING_SLOPE)
        out = STEP * np.where(beyond.any(axis=0), np.argmax(beyond, axis=0), steepest)
        out = ndimage.gaussian_filter1d(out, BLUR / STEP)
        widest = out > out.max() - WIDEST
        height = front.columns[heights][widest].mean()
        across = front.rows[middle] + side * (out[widest].mean() - WING_BEFORE)
        found[f"alare_{letter}"] = np.array([across, tip[1] + WING_BEHIND, height - WING_DOWN])


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
