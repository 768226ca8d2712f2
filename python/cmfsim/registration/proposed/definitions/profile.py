"""The midline of a face: where it runs, and the features of the profile along it."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cmfsim.registration.proposed.definitions.depth_maps import STEP, DepthMap
from cmfsim.values.checks import Floats

# How far from the plane of symmetry the midline of a jaw is looked for, mm; the second, if it leans
# farther than the first.
LEANS = (9.0, 18.0)
# Half the width over which both sides are compared, and cells that are left out at the middle, mm.
HALF_WIDTH, CORE = 26.0, 1.5
# Differences between the sides count up to this, mm: a tooth that one side lacks must not pull.
MOST_DIFFERENCE = 4.0
# Weight of the distance from the plane of symmetry, mm of difference per mm².
PULL = 0.004
# A bulge is flat: its middle is that of what lies within this of its farthest point, mm.
BULGE = 0.4


def smoothed(values: Floats, sigma: float) -> Floats:
    """Values along a line after a Gaussian blur of `sigma` mm that leaves gaps out."""
    reach = max(1, int(np.ceil(3.0 * sigma / STEP)))
    kernel = np.exp(-0.5 * (STEP * np.arange(-reach, reach + 1) / sigma) ** 2)
    known = np.isfinite(values)
    total = np.convolve(np.where(known, values, 0.0), kernel, mode="same")
    weight = np.convolve(known.astype(np.float64), kernel, mode="same")
    result = np.full(len(values), np.nan)
    result[known] = total[known] / weight[known]
    return result


def local_midline(front: DepthMap, band: tuple[float, float], about: float = 0.0) -> float | None:
    """Where the sides of a band of the front view mirror each other, mm; None where too little."""
    columns = (front.columns >= band[0]) & (front.columns <= band[1])
    strip = front.values[:, columns]
    if np.isfinite(strip).sum() * STEP * STEP < 200.0:
        return None
    for lean in LEANS:
        middles = about + np.arange(-lean, lean + 0.01, 0.5 * STEP)
        scores = [
            _unevenness(front, strip, middle) + PULL * (middle - about) ** 2 for middle in middles
        ]
        best = int(np.argmin(scores))
        if 0 < best < len(scores) - 1:
            a, b, c = scores[best - 1 : best + 2]
            bend = a - 2.0 * b + c
            return float(middles[best] + (0.5 * (a - c) / bend if bend > 0.0 else 0.0) * 0.5 * STEP)
    return None


def _unevenness(front: DepthMap, strip: Floats, middle: float) -> float:
    """How much the two sides of a strip differ about a middle, mm on average."""
    offsets = np.arange(CORE, HALF_WIDTH, STEP)
    right = _rows(front, strip, middle - offsets)
    left = _rows(front, strip, middle + offsets)
    gap = np.abs(left - right)
    gap[np.isnan(left) != np.isnan(right)] = MOST_DIFFERENCE
    gap = np.minimum(gap[np.isfinite(gap)], MOST_DIFFERENCE)
    return float(gap.mean()) if len(gap) else MOST_DIFFERENCE


def _rows(front: DepthMap, strip: Floats, places: Floats) -> Floats:
    """The rows of a strip at places between the cells, (n, k)."""
    where = (places - front.low[0]) / STEP
    low = np.clip(np.floor(where).astype(np.int64), 0, len(strip) - 2)
    share = (where - low)[:, None]
    heights: Floats = (1.0 - share) * strip[low] + share * strip[low + 1]
    return heights


def farthest_from_chord(
    heights: Floats, depths: Floats, ends: Sequence[float], outwards: float
) -> int | None:
    """The index of the point of a profile farthest from the chord between two heights.

    `outwards` is 1 for the foremost (least depth), −1 for the deepest point. None where an end or
    all between them is missing.
    """
    inside, gaps = _from_chord(heights, depths, ends)
    return None if not len(inside) else int(inside[np.argmax(outwards * gaps)])


def most_outside(
    heights: Floats, depths: Floats, ends: Sequence[float], reach: tuple[float, float]
) -> float | None:
    """The height of the middle of a bulge: what lies farthest in front of the chord between two.

    Looked for within `reach` alone. None where an end or all between them is missing.
    """
    inside, gaps = _from_chord(heights, depths, ends)
    near = (heights[inside] >= reach[0]) & (heights[inside] <= reach[1])
    if not near.any():
        return None
    bulge = near & (gaps >= gaps[near].max() - BULGE)
    return float(heights[inside[bulge]].mean())


def upper_end(
    heights: Floats, depths: Floats, ends: Sequence[float], deepest: int, flat: float
) -> int:
    """The index of the upper end of a hollow's bottom: not `flat` mm shallower than its deepest."""
    inside, gaps = _from_chord(heights, depths, ends)
    k = int(np.flatnonzero(inside == deepest)[0])
    while k + 1 < len(inside) and gaps[k + 1] <= gaps[inside == deepest][0] + flat:
        k += 1
    return int(inside[k])


def _from_chord(
    heights: Floats, depths: Floats, ends: Sequence[float]
) -> tuple[NDArray[np.int64], Floats]:
    """The points between two heights, and how far in front of the chord between them each lies."""
    low, high = min(ends), max(ends)
    inside = np.flatnonzero((heights >= low) & (heights <= high) & np.isfinite(depths))
    if len(inside) < 3:
        return inside[:0], heights[:0]
    z, y = heights[inside], depths[inside]
    if z[0] > low + 3.0 or z[-1] < high - 3.0:
        return inside[:0], heights[:0]
    chord = y[0] + (y[-1] - y[0]) * (z - z[0]) / (z[-1] - z[0])
    gaps: Floats = chord - y
    return inside, gaps
