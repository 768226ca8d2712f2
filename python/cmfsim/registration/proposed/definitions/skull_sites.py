"""Each landmark of the skull where its own definition holds, in the frame of an average head."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmfsim.registration.proposed.definitions.depth_maps import STEP, DepthMap, depth_map
from cmfsim.registration.proposed.definitions.profile import (
    farthest_from_chord,
    local_midline,
    smoothed,
    upper_end,
)
from cmfsim.registration.proposed.definitions.side_sites import (
    ORBIT_Z,
    SideView,
    Sites,
    find_orbit,
    find_side_sites,
)
from cmfsim.values.checks import Floats
from cmfsim.values.landmark_sites import REFERENCE_PLACES


@dataclass(frozen=True, eq=False)
class SkullViews:
    """Depth maps of the bones in the frame of an average head: x left, y back, z up, mm.

    cranium_front, mandible_front: Over x and z, from in front: y.
    cranium_sides, mandible_sides: Over y and z, from the left and from the right: the negative
        distance from the midline.
    mandible: (n, 3). Points of the mandible; empty where it is not known apart.
    cranium: (n, 3).
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
        right = depth_map(points[points[:, 0] < 0.0], (1, 2, 0), 1.0, SIDE_REACH)
        return left, right

    return SkullViews(
        depth_map(cranium, (0, 2, 1), 1.0, FRONT_REACH),
        depth_map(mandible, (0, 2, 1), 1.0, FRONT_REACH),
        sides(cranium),
        sides(mandible),
        cranium,
        mandible,
    )


def find_skull_sites(views: SkullViews) -> Sites:
    """The sites that are found, (3,) each, average-head mm."""
    found: Sites = {}
    # Nose and orbits of an uneven face lie beside the plane of symmetry of the whole cranium.
    front = views.cranium_front
    middle = local_midline(front, ORBIT_Z) or 0.0
    sides = [
        SideView(letter, side, middle, front, outer, jaw, views.mandible * [side, 1.0, 1.0])
        for letter, side, outer, jaw in zip(
            "LR", (1.0, -1.0), views.cranium_sides, views.mandible_sides, strict=True
        )
    ]
    orbits = [find_orbit(view) for view in sides]
    _midface(views, middle, [orbit.z for orbit in orbits if orbit is not None], found)
    _jaw_profile(views, found)
    for view, orbit in zip(sides, orbits, strict=True):
        find_side_sites(view, orbit, found)
    return found


def _midface(views: SkullViews, middle: float, eyes: list[float], found: Sites) -> None:
    front = views.cranium_front
    z = front.columns
    centre = float(np.mean(eyes)) if eyes else 20.0
    top = smoothed(front.column(middle, 1.6), 1.0)
    rhinion = _nasal_end(z, top, centre)
    if rhinion is not None:
        found["rhinion"] = np.array([middle, top[rhinion], z[rhinion]])
        high = min(z[rhinion] + 48.0, centre + 34.0)
        deepest = farthest_from_chord(z, top, (z[rhinion], high), -1.0)
        if deepest is not None:
            # The suture is at the upper end of a flat hollow, where the brow begins.
            deepest = upper_end(z, top, (z[rhinion], high), deepest, FLAT)
            found["nasion"] = np.array([middle, top[deepest], z[deepest]])
            # A forehead that is cut off shows the glabella as long as it goes on above it.
            end = min(z[deepest] + 32.0, float(z[np.isfinite(top)].max()) - 1.0)
            brow = None
            if end > z[deepest] + LEAST_FOREHEAD:
                brow = farthest_from_chord(z, top, (z[deepest], end), 1.0)
            if brow is not None:
                found["glabella"] = np.array([middle, top[brow], z[brow]])
                above = int(np.argmin(np.abs(z - z[brow] - 15.0)))
                if np.isfinite(top[above]):
                    found["supraglabella"] = np.array([middle, top[above], z[above]])
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


# Height of the crown of the upper incisors up to the bone, and of the rounding of a ridge without
# teeth up to its front, mm.
UPPER_CROWN, BARE_RIDGE = 12.0, 2.0
# The edge of a crown is where it is foremost within this of its end, mm.
EDGE = 3.0
# From the edge of the upper incisors to the floor of the nose Legan and Burstone (1980) measured
# 30.5 ± 2.1 mm in men and 27.5 ± 1.7 mm in women: what is this much lower has no incisors, mm.
LEAST_WITH_TEETH = 20.0
# The floor is where the bone beside the septum falls back by so much, mm; so far from the midline.
FLOOR_DROP, BESIDE_SEPTUM = 10.0, (4.0, 6.0, 8.0)
# That of the lower ones in parts of the height of the jaw at the chin: 0.26 and 0.28 on two real
# heads, on which it is 7.8 and 11.4 mm; at least so many mm, as of a chin that is cut off.
LOWER_SHARE, LOWER_CROWN = 0.27, 8.2


def _upper_alveolus(views: SkullViews, found: Sites) -> None:
    front = views.cranium_front
    z = front.columns
    lean = local_midline(front, (-40.0, -20.0)) or 0.0
    line = smoothed(front.column(lean, 2.2), 1.0)
    teeth = np.isfinite(line) & (line < -60.0) & (z < -15.0) & (z > -75.0)
    if not teeth.any():
        return
    # The longest run downwards: nasal bones may end in the same range.
    start, edge, longest = len(z), 0, 0
    while teeth[:start].any():
        top = int(np.flatnonzero(teeth[:start]).max())
        start = _run_end(teeth, top)
        if top - start >= longest:
            edge, longest = start, top - start
    crown = BARE_RIDGE if _is_bare(front, lean, edge) else UPPER_CROWN
    neck = int(np.argmin(np.abs(z - z[edge] - crown)))
    if not np.isfinite(line[neck]):
        return
    found["supradentale"] = np.array([lean, line[neck], z[neck]])
    found["_upper_edge"] = np.array([lean, _crown(line, z, edge), z[edge]])
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
    found["mid_philtrum"] = np.array([lean, line[at], z[at]])


def _crown(line: Floats, z: Floats, edge: int) -> float:
    """How far forwards a crown reaches at its edge: the last cell may show what lies behind."""
    return float(np.nanmin(line[np.abs(z - z[edge]) <= EDGE]))


def _is_bare(front: DepthMap, lean: float, edge: int) -> bool:
    """Whether the upper jaw has lost its incisors: its edge is near the floor of the nose.

    And where, below the rest of the face, an average head has a ridge and not crowns: a short
    upper jaw with teeth is as near to the floor as a long one without.
    """
    ridge, crowns = (
        abs(front.columns[edge] + above - REFERENCE_PLACES["skull"]["supradentale"][2])
        for above in (BARE_RIDGE, UPPER_CROWN)
    )
    return bool(ridge < crowns) and _to_nasal_floor(front, lean, edge) <= LEAST_WITH_TEETH


def _to_nasal_floor(front: DepthMap, lean: float, edge: int) -> float:
    """From the edge of the upper jaw up to the floor of the nose, mm; infinite without one."""
    z = front.columns
    heights = []
    for x in [lean + side * across for side in (-1.0, 1.0) for across in BESIDE_SEPTUM]:
        line = smoothed(front.column(x, 1.0), 0.6)[edge:]
        back = line > np.fmin.accumulate(line) + FLOOR_DROP
        heights.append(z[edge + int(np.argmax(back))] - z[edge] if back.any() else np.inf)
    return float(np.median(heights))


def _run_end(known: NDArray[np.bool_], start: int) -> int:
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
    lean = local_midline(front, (heights.max() - 20.0, heights.max() - 2.0)) or 0.0
    chin_lean = local_midline(front, (heights.min() - 2.0, heights.min() + 18.0), lean)
    chin_lean = lean if chin_lean is None else chin_lean
    line = smoothed(front.column(lean, 2.2), 0.8)
    known = np.isfinite(line) & (line < -35.0)
    if not known.any():
        return
    top, bottom = int(np.flatnonzero(known).max()), int(np.flatnonzero(known).min())
    crown = max(LOWER_CROWN, LOWER_SHARE * (z[top] - z[bottom]))
    neck = int(np.argmin(np.abs(z - z[top] + crown)))
    found["_lower_edge"] = np.array([lean, _crown(line, z, top), z[top]])
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
