"""Sites of one side of the skull, by definition: about orbit, arch, ramus and molars."""

from dataclasses import dataclass

import numpy as np

from cmfsim.errors import third_party
from cmfsim.registration.proposed.definitions.depth_maps import STEP, DepthMap
from cmfsim.registration.proposed.definitions.profile import most_outside, smoothed
from cmfsim.values.checks import Floats

Sites = dict[str, Floats]
# What shows that the front of a ramus is hidden at the height of the teeth; with the side.
HIDDEN_RAMUS = "_hidden_ramus_"


@dataclass(frozen=True, eq=False)
class SideView:
    """One side of a skull, the right one mirrored: what is found has a positive x.

    letter: "L" or "R".
    side: 1 on the left, −1 on the right.
    middle: mm. Where the midline of nose and orbits lies in `front`.
    front, outer, jaw: The cranium from in front, not mirrored; cranium and mandible from this side.
    mandible: (n, 3). Points of the mandible, mirrored for the right side.
    """

    letter: str
    side: float
    middle: float
    front: DepthMap
    outer: DepthMap
    jaw: DepthMap
    mandible: Floats

    def put(self, found: Sites, name: str, place: Floats) -> None:
        """Adds a site of this side, unless its place is unknown."""
        if np.isfinite(place).all():
            found[f"{name}_{self.letter}"] = place * [self.side, 1.0, 1.0]


@dataclass(frozen=True)
class Orbit:
    """The opening of an orbit in the front view: its middle, and the ends of its middle column."""

    x: float
    z: float
    low: float
    high: float


# The front of the face beside the nose, as a line over the distance from the midline, mm, and how
# far behind it the orbit's floor begins.
FACE_AT, FACE_SLOPE, HOLLOW = -87.0, 0.45, 9.0
ORBIT_X, ORBIT_Z = (12.0, 54.0), (-16.0, 52.0)
# Area of an orbit at least, mm².
LEAST_ORBIT = 300.0
# The lateral rim slopes back: the hollow ends before it, and its middle is so far out, mm. In the
# middle between two real heads, in which 3 mm and none fit best.
LATERAL_RIM = 2.0


def find_orbit(view: SideView) -> Orbit | None:
    """The orbit of a side: the largest hollow beside the nose; None where there is none."""
    front = view.front
    ndimage = third_party("scipy.ndimage", "landmarks are proposed", "imaging")
    x = view.side * (front.rows - view.middle)
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
    near = height[np.abs(across - middle) < 3.0]
    return Orbit(middle + view.side * view.middle, float(zs.mean()), near.min(), near.max())


# The bulge of the forehead is where its profile lies farthest in front of a chord of this length
# that begins at the ridge over the orbit, between these heights above the ridge, mm. A bulge is
# flat, so that its middle is pulled by the share below towards its usual height above the ridge,
# which is taken alone where the forehead is cut off below the end of the chord, mm.
FOREHEAD_CHORD, FOREHEAD_REACH, TO_FOREHEAD = 60.0, (18.0, 50.0), 32.5
FOREHEAD_PULL = 1.0 / 3.0
# The forehead's profile is the median of a strip this wide to either side, smoothed over this, mm.
FOREHEAD_HALF, FOREHEAD_SIGMA = 4.0, 2.0
# From the lower rim of the orbit down to the lower border of the cheekbone, mm.
TO_MALAR = 18.5
# That border is looked for so far out, as a factor on the orbit's middle.
MALAR_OUT = 1.02
# The cheekbone beside the orbit lies so far behind and above its lower rim, mm.
LATERAL_BEHIND, LATERAL_ABOVE = 12.0, 4.5
# Rims are the farthest points in these directions: forwards, and so much down or up.
RIM_DOWN, RIM_UP = 0.8, 0.7


def find_side_sites(view: SideView, orbit: Orbit | None, found: Sites) -> None:
    """Adds the sites of a side to those of the midline."""
    if orbit is not None:
        _about_orbit(view, orbit, found)
    half = view.mandible[view.mandible[:, 0] > 10.0]
    if not len(half):
        return
    condyle = _condyle(half)
    if condyle is not None:
        _arch(view, condyle, found)
    _jaw_angle(view, half, found)
    _teeth_line(view, found)


def _about_orbit(view: SideView, orbit: Orbit, found: Sites) -> None:
    front = view.front
    z = front.columns
    line = smoothed(front.column(view.side * orbit.x, 1.6), 0.8)
    above = np.flatnonzero((z >= orbit.high - 1.0) & (z <= orbit.high + 12.0) & np.isfinite(line))
    if len(above):
        upper = above[np.argmax(-line[above] - RIM_DOWN * z[above])]
        view.put(found, "supraorbital", np.array([orbit.x, line[upper], z[upper]]))
        _forehead(view, orbit, float(z[upper]), found)
    below = np.flatnonzero((z <= orbit.low + 1.0) & (z >= orbit.low - 10.0) & np.isfinite(line))
    if len(below):
        lower = below[np.argmax(-line[below] + RIM_UP * z[below])]
        view.put(found, "suborbital", np.array([orbit.x, line[lower], z[lower]]))
        out, malar = MALAR_OUT * orbit.x, float(z[lower]) - TO_MALAR
        depth = front.at(view.side * out, malar)
        view.put(found, "inferior_malar", np.array([out, depth, malar]))
        y, up = float(line[lower]) + LATERAL_BEHIND, float(z[lower]) + LATERAL_ABOVE
        view.put(found, "lateral_orbit", np.array([-view.outer.at(y, up), y, up]))


def _forehead(view: SideView, orbit: Orbit, ridge: float, found: Sites) -> None:
    """The frontal eminence, from the height of the ridge over the orbit."""
    z = view.front.columns
    line = smoothed(view.front.column(view.side * orbit.x, FOREHEAD_HALF), FOREHEAD_SIGMA)
    reach = (ridge + FOREHEAD_REACH[0], ridge + FOREHEAD_REACH[1])
    found_at = most_outside(z, line, (ridge, ridge + FOREHEAD_CHORD), reach)
    height = usual = ridge + TO_FOREHEAD
    if found_at is not None:
        height = FOREHEAD_PULL * usual + (1.0 - FOREHEAD_PULL) * found_at
    bulge = int(np.argmin(np.abs(z - height)))
    view.put(found, "frontal_eminence", np.array([orbit.x, line[bulge], z[bulge]]))


# Where the condyle of a levelled head can lie, mm, how high its top must reach there, and how many
# points it must have.
CONDYLE_Y, CONDYLE_Z, LEAST_TOP, LEAST_CONDYLE = (-30.0, 10.0), (-30.0, 18.0), -10.0, 100


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


# The root of the zygomatic arch lies over the top of the condyle, and its widest point before and
# below that, mm; and how far a ridge is looked for up and down.
OVER_CONDYLE, BEFORE_ROOT, BELOW_ROOT = 6.0, 19.5, 1.5
ROOT_REACH, ARCH_REACH = 5.0, 7.0
# How much farther out a ridge must be for each mm that it lies off the expected height.
RIDGE_PULL = 0.15
# How often it is looked for farther on: up to 10 mm of the condyle may have been cut off with the
# cranium, and the place expected from its top is as much too low.
WINDOWS = 3


def _ridge(outer: DepthMap, y: float, z: float, reach: float) -> Floats | None:
    """The outermost point over height near a place, (3,) with x positive."""
    for _ in range(WINDOWS):
        v, w, depth = outer.window((y - 1.0, y + 1.0), (z - reach, z + reach))
        if not len(depth):
            return None
        best = int(np.argmin(depth + RIDGE_PULL * np.abs(w - z)))
        # What rises up to the border of the window is no ridge: that is farther on.
        if abs(w[best] - z) < reach - STEP:
            break
        z = float(w[best])
    return np.array([-depth[best], v[best], w[best]])


def _arch(view: SideView, condyle: Floats, found: Sites) -> None:
    root = _ridge(view.outer, condyle[1], condyle[2] + OVER_CONDYLE, ROOT_REACH)
    if root is None:
        return
    view.put(found, "supraglenoid", root)
    middle = _ridge(view.outer, root[1] - BEFORE_ROOT, root[2] - BELOW_ROOT, ARCH_REACH)
    if middle is not None:
        view.put(found, "zygomatic_arch", middle)


def _jaw_angle(view: SideView, half: Floats, found: Sites) -> None:
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
    view.put(found, "gonion", np.array([0.5 * (at[0] + lateral), at[1], at[2]]))


# Between the upper incisors and the front of the ramus, the upper second molar stands at this share
# if the edge of the lower incisors is this far behind that of the upper ones, mm. Else the whole
# lower jaw, ramus and molars, is as much farther back or forwards.
# That is not known of a jaw whose incisors' crowns are less high than this, mm.
MOLAR_SHARE, OVERJET, LEAST_CROWN = 0.803, 6.0, 6.0
# From the plane where the molars meet up and down to the sites, and how far back the lower is, mm.
OVER_MOLARS, UNDER_MOLARS, LOWER_BEHIND = 13.0, 19.5, 3.8
# The front of the ramus lies within 5.3 mm of where it is so far above the teeth, in two real heads
# in eight shapes each: what stands farther in front are crowns of metal and their streaks. They may
# also have erased it. mm.
ABOVE_CROWNS, MOST_AHEAD = 12.0, 6.0
# Where molars stand across, mm.
MOLAR_ROW = (12.0, 32.0)


def _teeth_line(view: SideView, found: Sites) -> None:
    """Sites beside the second molars, and on the ramus at the height of the teeth."""
    lower, neck = found.get("_lower_edge"), found.get("supradentale")
    if lower is None or neck is None:
        return
    upper = found.get("_upper_edge")
    behind = 0.0
    if upper is not None and float(neck[2] - upper[2]) > LEAST_CROWN:
        behind = float(lower[1] - upper[1]) - OVERJET
    across = np.abs(view.mandible[:, 0])
    teeth = view.mandible[(across > MOLAR_ROW[0]) & (across < MOLAR_ROW[1])]
    level = float(lower[2]) + 4.0
    border = molar = 0.0
    hidden = f"{HIDDEN_RAMUS}{view.letter}"
    for _ in range(3):
        front, above = (_ramus_front(view.jaw, level + up) for up in (0.0, ABOVE_CROWNS))
        found.pop(hidden, None)
        if above is not None and (front is None or front < above - MOST_AHEAD):
            front = above
            found[hidden] = np.array([0.0, front, level])
        if front is None:
            return
        border = front
        molar = float(neck[1]) + MOLAR_SHARE * (border - behind - float(neck[1]))
        row = teeth[np.abs(teeth[:, 1] - molar - behind) < 4.0]
        if len(row) < 10:
            return
        level = float(np.quantile(row[:, 2], 0.995)) - 0.8
    view.put(found, "occlusal_line", np.array([-view.jaw.at(border, level), border, level]))
    high = level + OVER_MOLARS
    view.put(found, "supra_m2", np.array([-view.outer.at(molar, high), molar, high]))
    back, low = molar + behind + LOWER_BEHIND, level - UNDER_MOLARS
    view.put(found, "sub_m2", np.array([-view.jaw.at(back, low), back, low]))


def _ramus_front(jaw: DepthMap, level: float) -> float | None:
    """Where the outer face of the ramus begins at a height, 3.3 mm behind its front border."""
    y, _, depth = jaw.window((-80.0, 5.0), (level - 1.0, level + 1.0))
    if not len(depth):
        return None
    outside = -depth > np.quantile(-depth, 0.9) - 8.0
    return float(y[outside].min()) + 3.3
