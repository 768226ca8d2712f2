"""Each landmark of the skull where its own definition holds, in the frame of an average head."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cmfsim.checks import Floats
from cmfsim.extras import third_party
from cmfsim.registration.proposed.depth_maps import STEP, DepthMap, depth_map
from cmfsim.registration.proposed.profile import (
    farthest_from_chord,
    local_midline,
    smoothed,
    upper_end,
)

__all__ = ["SkullViews", "find_skull_sites", "skull_views"]


@dataclass(frozen=True, eq=False)
class SkullViews:
    """Depth maps of the bones in the frame of an average head: x left, y back, z up, mm.

    Attributes
    ----------
    cranium_front, mandible_front : DepthMap
        Over x and z, from in front: y.
    cranium_sides, mandible_sides : tuple of DepthMap
        Over y and z, from the left and from the right: the negative distance from the midline.
    mandible : (n, 3) float64
        Points of the mandible; empty where it is not known apart.
    cranium : (n, 3) float64
    """

    cranium_front: DepthMap
    mandible_front: DepthMap
    cranium_sides: tuple[DepthMap, DepthMap]
    mandible_sides: tuple[DepthMap, DepthMap]
    cranium: Floats
    mandible: Floats


FRONT_REACH = (-90.0, 90.0, -130.0, 110.0)
SIDE_REACH = (-130.0, 60.0, -130.0, 110.0)


def skull_views(cranium: Floats, mandible: Floats) -> SkullViews:
    """The views of points that lie densely on cranium and mandible."""

    def sides(points: Floats) -> tuple[DepthMap, DepthMap]:
        left = depth_map(points[points[:, 0] > 0.0], (1, 2, 0), -1.0, SIDE_REACH)
        right = depth_map(
            points[points[:, 0] < 0.0] * [-1.0, 1.0, 1.0], (1, 2, 0), -1.0, SIDE_REACH
        )
        return left, right

    return SkullViews(
        depth_map(cranium, (0, 2, 1), 1.0, FRONT_REACH),
        depth_map(mandible, (0, 2, 1), 1.0, FRONT_REACH),
        sides(cranium),
        sides(mandible),
        cranium,
        mandible,
    )


Sites = dict[str, Floats]


def find_skull_sites(views: SkullViews) -> Sites:
    """The sites that are found, (3,) each, average-head mm."""
    found: Sites = {}
    orbits = [_orbit(views.cranium_front, side) for side in (1.0, -1.0)]
    _midface(views, orbits, found)
    _jaw_profile(views, found)
    for orbit, side, letter in zip(orbits, (1.0, -1.0), "LR", strict=True):
        if orbit is not None:
            _about_orbit(views, orbit, side, letter, found)
    for side, letter in ((1.0, "L"), (-1.0, "R")):
        _beside(views, side, letter, found)
    return found


@dataclass(frozen=True)
class _Orbit:
    """The opening of an orbit in the front view."""

    x: float
    z: float
    low: float
    high: float


# The front of the face beside the nose, as a line over the distance from the midline, mm, and how
# far behind it the orbit's floor begins.
FACE_AT, FACE_SLOPE, HOLLOW = -87.0, 0.45, 9.0
ORBIT_X, ORBIT_Z = (12.0, 54.0), (-16.0, 52.0)
LEAST_ORBIT = 300.0
# The lateral rim slopes back: the hollow ends before it, and its middle is so far out, mm.
LATERAL_RIM = 0.5


def _orbit(front: DepthMap, side: float) -> _Orbit | None:
    ndimage = third_party("scipy.ndimage", "landmarks are proposed", "imaging")
    x = side * front.rows
    room = ((x > ORBIT_X[0]) & (x < ORBIT_X[1]))[:, None] & (
        (front.columns > ORBIT_Z[0]) & (front.columns < ORBIT_Z[1])
    )[None]
    face = FACE_AT + FACE_SLOPE * np.maximum(x - 15.0, 0.0)[:, None]
    depth = np.where(np.isfinite(front.values), front.values, 60.0)
    hollow = room & (depth > face + HOLLOW)
    labels, count = ndimage.label(ndimage.binary_opening(hollow, iterations=3))
    if count == 0:
        return None
    sizes = ndimage.sum_labels(np.ones(labels.shape), labels, range(1, count + 1))
    largest = int(np.argmax(sizes)) + 1
    if sizes[largest - 1] * STEP * STEP < LEAST_ORBIT:
        return None
    i, j = np.nonzero(labels == largest)
    across, height = x[i], front.columns[j]
    xs = np.quantile(across, [0.02, 0.98])
    zs = np.quantile(height, [0.02, 0.98])
    middle = float(xs.mean()) + LATERAL_RIM
    near = np.abs(across - middle) < 3.0
    return _Orbit(middle, float(zs.mean()), float(height[near].min()), float(height[near].max()))


def _midface(views: SkullViews, orbits: list[_Orbit | None], found: Sites) -> None:
    front = views.cranium_front
    z = front.columns
    eye = [o.z for o in orbits if o is not None]
    centre = float(np.mean(eye)) if eye else 20.0
    top = smoothed(front.column(0.0, 1.6), 1.0)
    rhinion = _nasal_end(z, top, centre)
    if rhinion is not None:
        found["rhinion"] = np.array([0.0, top[rhinion], z[rhinion]])
        high = min(z[rhinion] + 48.0, centre + 34.0)
        deepest = farthest_from_chord(z, top, (z[rhinion], high), -1.0)
        if deepest is not None:
            # The suture is at the upper end of a flat hollow, where the brow begins.
            deepest = upper_end(z, top, (z[rhinion], high), deepest, FLAT)
            found["nasion"] = np.array([0.0, top[deepest], z[deepest]])
            # A forehead that is cut off shows the glabella as long as it goes on above it.
            end = min(z[deepest] + 32.0, float(z[np.isfinite(top)].max()) - 1.0)
            brow = None
            if end > z[deepest] + LEAST_FOREHEAD:
                brow = farthest_from_chord(z, top, (z[deepest], end), 1.0)
            if brow is not None:
                found["glabella"] = np.array([0.0, top[brow], z[brow]])
                above = int(np.argmin(np.abs(z - z[brow] - 15.0)))
                if np.isfinite(top[above]):
                    found["supraglabella"] = np.array([0.0, top[above], z[above]])
    _upper_alveolus(views, found)


# Bone above the nasion from which the glabella can be told, mm.
LEAST_FOREHEAD = 24.0
# How much the bottom of the hollow of the nasion may rise and still count as flat, mm.
FLAT = 0.5
# The bony nose ends where the profile falls back by so much within the step below, mm.
NASAL_DROP, NASAL_STEP = 6.0, 2.5


def _nasal_end(z: Floats, top: Floats, centre: float) -> int | None:
    """The index of the tip of the nasal bones: the foremost above the first drop downwards."""
    step = max(1, int(NASAL_STEP / STEP))
    for k in range(int(np.argmin(np.abs(z - centre - 6.0))), step, -1):
        if z[k] < centre - 35.0:
            return None
        if not np.isfinite(top[k]):
            return None
        below = top[k - step]
        if not np.isfinite(below) or below - top[k] > NASAL_DROP:
            upper = slice(k, k + int(6.0 / STEP))
            foremost = float(np.nanmin(top[upper]))
            return k + int(np.flatnonzero(top[upper] < foremost + 0.8).min())
    return None


# Height of the crown of the upper and lower incisors up to the bone, mm.
UPPER_CROWN, LOWER_CROWN = 12.0, 8.2


def _upper_alveolus(views: SkullViews, found: Sites) -> None:
    front = views.cranium_front
    z = front.columns
    middle = local_midline(front, (-40.0, -20.0))
    lean = 0.0 if middle is None else middle
    line = smoothed(front.column(lean, 2.2), 1.0)
    teeth = np.isfinite(line) & (line < -60.0) & (z < -15.0) & (z > -75.0)
    if not teeth.any():
        return
    # Connected downwards from the alveolus.
    edge = _run_end(teeth, int(np.flatnonzero(teeth).max()))
    neck = int(np.argmin(np.abs(z - z[edge] - UPPER_CROWN)))
    if not np.isfinite(line[neck]):
        return
    found["supradentale"] = np.array([lean, line[neck], z[neck]])
    found["_upper_edge"] = np.array([lean, line[edge], z[edge]])
    spine = neck
    while (
        spine + 1 < len(z)
        and np.isfinite(line[spine + 1])
        and (line[spine + 1] - line[neck] < 14.0 and line[spine + 1] - line[spine] < 2.5)
        and z[spine + 1] < z[neck] + 24.0
    ):
        spine += 1
    half = z[neck] + 0.38 * (z[spine] - z[neck])
    at = int(np.argmin(np.abs(z - half)))
    found["_spine"] = np.array([lean, line[spine], z[spine]])
    found["mid_philtrum"] = np.array([lean, line[at], z[at]])


def _run_end(known: Floats, start: int) -> int:
    """The last index of a run of true cells downwards, over gaps of two cells."""
    k = start
    while k > 3 and known[k - 3 : k].any():
        k -= 1
    while not known[k]:
        k += 1
    return k


def _jaw_profile(views: SkullViews, found: Sites) -> None:
    front = views.mandible_front
    z = front.columns
    if not len(views.mandible):
        return
    whole = front.column(0.0, 6.0)
    heights = z[np.isfinite(whole) & (whole < -35.0)]
    if not len(heights):
        return
    lean = local_midline(front, (heights.max() - 20.0, heights.max() - 2.0))
    lean = 0.0 if lean is None else lean
    chin_lean = local_midline(front, (heights.min() - 2.0, heights.min() + 18.0), lean)
    chin_lean = lean if chin_lean is None else chin_lean
    line = smoothed(front.column(lean, 2.2), 0.8)
    known = np.isfinite(line) & (line < -35.0)
    if not known.any():
        return
    top, bottom = int(np.flatnonzero(known).max()), int(np.flatnonzero(known).min())
    neck = int(np.argmin(np.abs(z - z[top] + LOWER_CROWN)))
    found["_lower_edge"] = np.array([lean, line[top], z[top]])
    found["infradentale"] = np.array([lean, line[neck], z[neck]])
    chin = smoothed(front.column(chin_lean, 2.2), 0.8)
    low = views.mandible[
        (np.abs(views.mandible[:, 0] - chin_lean) < 1.5)
        & (views.mandible[:, 1] < line[bottom] + 25.0)
    ]
    if len(low) < 20:
        return
    lowest = low[np.argsort(low[:, 2])[: max(8, len(low) // 100)]].mean(axis=0)
    found["menton"] = np.array([chin_lean, lowest[1], low[:, 2].min()])
    # The chin below the deepest point, that below the teeth: found in turn, twice.
    chin_at = int(np.argmin(np.abs(z - z[bottom] - 7.0)))
    for _ in range(3):
        fold = farthest_from_chord(z, chin, (z[neck], z[chin_at]), -1.0)
        if fold is None:
            return
        chord = farthest_from_chord(z, chin, (z[fold], z[bottom] + 2.0), 1.0)
        if chord is None:
            return
        chin_at = chord
    share = (z[fold] - z[chin_at]) / max(z[neck] - z[chin_at], 1.0)
    across = chin_lean + share * (lean - chin_lean)
    found["supramentale"] = np.array([across, chin[fold], z[fold]])
    found["pogonion"] = np.array([chin_lean, chin[chin_at], z[chin_at]])


# The lower border of the cheekbone is looked for so far out, as a factor on the orbit's middle.
MALAR_OUT = 1.055


def _about_orbit(views: SkullViews, orbit: _Orbit, side: float, letter: str, found: Sites) -> None:
    front = views.cranium_front
    z = front.columns
    line = smoothed(front.column(side * orbit.x, 1.6), 0.8)

    def point(index: int) -> Floats:
        return np.array([side * orbit.x, line[index], z[index]])

    above = np.flatnonzero((z >= orbit.high - 1.0) & (z <= orbit.high + 12.0) & np.isfinite(line))
    if len(above):
        upper = above[np.argmax(-line[above] - 0.8 * z[above])]
        found[f"supraorbital_{letter}"] = point(upper)
        bulge = int(np.argmin(np.abs(z - z[upper] - 32.5)))
        if np.isfinite(line[bulge]):
            found[f"frontal_eminence_{letter}"] = point(bulge)
    below = np.flatnonzero((z <= orbit.low + 1.0) & (z >= orbit.low - 10.0) & np.isfinite(line))
    if len(below):
        lower = below[np.argmax(-line[below] + 0.7 * z[below])]
        found[f"suborbital_{letter}"] = point(lower)
        malar = int(np.argmin(np.abs(z - z[lower] + 18.5)))
        depth = front.at(MALAR_OUT * side * orbit.x, z[malar])
        if np.isfinite(depth):
            found[f"inferior_malar_{letter}"] = np.array(
                [MALAR_OUT * side * orbit.x, depth, z[malar]]
            )
        _lateral_orbit(views, found[f"suborbital_{letter}"], side, letter, found)


# The cheekbone beside the orbit lies so far behind and above its lower rim, mm.
LATERAL_BEHIND, LATERAL_ABOVE = 12.0, 4.5


def _lateral_orbit(views: SkullViews, rim: Floats, side: float, letter: str, found: Sites) -> None:
    outer = views.cranium_sides[0 if side > 0.0 else 1]
    y, z = rim[1] + LATERAL_BEHIND, rim[2] + LATERAL_ABOVE
    across = -outer.at(y, z)
    if np.isfinite(across):
        found[f"lateral_orbit_{letter}"] = np.array([side * across, y, z])


# Where the condyle of an average head, levelled, can lie, mm, how high its top must reach there, and
# how many points it must have.
CONDYLE_Y, CONDYLE_Z, LEAST_TOP, LEAST_CONDYLE = (-30.0, 10.0), (-30.0, 18.0), -10.0, 100


def _beside(views: SkullViews, side: float, letter: str, found: Sites) -> None:
    k = 0 if side > 0.0 else 1
    outer, jaw = views.cranium_sides[k], views.mandible_sides[k]
    mandible = views.mandible * [side, 1.0, 1.0]
    half = mandible[mandible[:, 0] > 10.0]
    if not len(half):
        return
    condyle = _condyle(half)
    if condyle is not None:
        _arch(outer, condyle, side, letter, found)
    _jaw_angle(half, side, letter, found)
    _teeth_line(outer, jaw, mandible, side, letter, found)


def _condyle(half: Floats) -> Floats | None:
    """The lateral pole of the condyle at the height of its top; None where the jaw has none."""
    y, z = half[:, 1], half[:, 2]
    near = half[(y > CONDYLE_Y[0]) & (y < CONDYLE_Y[1]) & (z > CONDYLE_Z[0]) & (z < CONDYLE_Z[1])]
    if len(near) < LEAST_CONDYLE:
        return None
    top = float(near[:, 2].max())
    if top < LEAST_TOP:
        return None
    head = near[near[:, 2] > top - 14.0]
    pole = head[head[:, 0] > head[:, 0].max() - 1.0].mean(axis=0)
    return np.array([pole[0], pole[1], top])


def _ridge(outer: DepthMap, y: float, z: float, reach: float) -> Floats | None:
    """The outermost point over height near a place, (3,) with x positive."""
    v, w, depth = outer.window((y - 1.0, y + 1.0), (z - reach, z + reach))
    if not len(depth):
        return None
    best = int(np.argmin(depth + 0.15 * np.abs(w - z)))
    return np.array([-depth[best], v[best], w[best]])


def _arch(outer: DepthMap, condyle: Floats, side: float, letter: str, found: Sites) -> None:
    flip = np.array([side, 1.0, 1.0])
    root = _ridge(outer, condyle[1], condyle[2] + 6.0, 5.0)
    if root is not None:
        found[f"supraglenoid_{letter}"] = root * flip
        middle = _ridge(outer, root[1] - 19.5, root[2] - 1.5, 7.0)
        if middle is not None:
            found[f"zygomatic_arch_{letter}"] = middle * flip


def _jaw_angle(half: Floats, side: float, letter: str, found: Sites) -> None:
    """The gonion: the point of the outline farthest from the line of condyle and menton."""
    menton = found.get("menton")
    if menton is None:
        return
    condyle = half[np.argmax(half[:, 1] + 0.3 * half[:, 2])]
    along = menton[1:] - condyle[1:]
    along = along / np.linalg.norm(along)
    away = np.array([-along[1], along[0]])
    away = away if away[0] > 0.0 else -away
    reach = (half[:, 1:] - condyle[1:]) @ away
    tip = half[reach > reach.max() - 0.8]
    at = tip.mean(axis=0)
    lateral = tip[:, 0].max()
    found[f"gonion_{letter}"] = np.array([side * 0.5 * (at[0] + lateral), at[1], at[2]])


def _teeth_line(
    outer: DepthMap, jaw: DepthMap, mandible: Floats, side: float, letter: str, found: Sites
) -> None:
    """Sites beside the second molars, and on the ramus at the height of the teeth."""
    flip = np.array([side, 1.0, 1.0])
    upper, lower = found.get("_upper_edge"), found.get("_lower_edge")
    neck, low = found.get("supradentale"), found.get("infradentale")
    if upper is None or lower is None or neck is None or low is None:
        return
    level = lower[2] + 4.0
    for _ in range(3):
        border = _ramus_front(jaw, level)
        if border is None:
            return
        molar = neck[1] + 0.815 * (border - neck[1])
        row = mandible[
            (np.abs(mandible[:, 1] - molar) < 4.0)
            & (np.abs(mandible[:, 0]) > 12.0)
            & (np.abs(mandible[:, 0]) < 32.0)
        ]
        if len(row) < 10:
            return
        level = float(np.quantile(row[:, 2], 0.995)) - 0.8
    found[f"occlusal_line_{letter}"] = np.array([-jaw.at(border, level), border, level]) * flip
    for name, view, y, z in (
        ("supra_m2", outer, molar, level + 13.0),
        ("sub_m2", jaw, molar + 4.5, level - 19.5),
    ):
        across = -view.at(y, z)
        if np.isfinite(across):
            found[f"{name}_{letter}"] = np.array([across, y, z]) * flip


def _ramus_front(jaw: DepthMap, level: float) -> float | None:
    """Where the outer face of the ramus begins at a height, 2.5 mm behind its front border."""
    y, _, depth = jaw.window((-80.0, 5.0), (level - 1.0, level + 1.0))
    if not len(depth):
        return None
    outside = -depth > np.quantile(-depth, 0.9) - 8.0
    return float(y[outside].min()) + 2.5
