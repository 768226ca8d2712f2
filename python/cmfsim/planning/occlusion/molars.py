"""First molars of a tooth row: the sixth teeth from the midline, between gaps of the crowns.

The row is unrolled along the line through its crowns. Between teeth, crowns are lower and narrower
than in their middles. The gaps of a side are placed where both are, at widths like those of
ordinary teeth; dynamic programming finds the best places.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import third_party
from cmfsim.planning.occlusion.rows import ToothRow
from cmfsim.values.checks import Floats

# Mesiodistal widths of crowns from the central incisor to the second molar, mm: Wheeler's Dental
# Anatomy (Nelson 2015), table 1-1.
WIDTHS = {
    "upper": (8.5, 6.5, 7.5, 7.0, 7.0, 10.0, 9.0),
    "lower": (5.0, 5.5, 7.0, 7.0, 7.0, 11.0, 10.5),
}
SIDES = (("L", 1), ("R", -1))
PREMOLAR, FIRST_MOLAR = 4, 5
# Sizes of a person's teeth against these, and by how much a single tooth differs, as shares.
SIZES, UNEVEN, MOST_UNEVEN = np.arange(0.84, 1.17, 0.04), 0.06, 0.18
# How far the gap of the central incisors lies from the edge of the bone between them, mm.
MIDLINE = 2.5
# Steps along the row, and the distance of a gap from the middles of its teeth, mm.
STEP, HALF_TOOTH = 0.25, 3.0
# The top of a crown in which its width is taken, mm, and half of the widest crown.
TOP, HALF_CROWN = 3.5, 8.0
# Depth of a gap, mm, height and width together: the most that counts, and the least.
DEEPEST, SHALLOWEST = 2.0, 0.4
# What uneven widths cost, mm of depth at one standard deviation.
COST = 0.3
# By how much the gaps of a full row are deeper than those of one without a premolar, mm on average.
CLEARER = 0.1
# Angles about the middle of the arch in which the line is fitted, degrees, and its degree.
SECTOR, LINE_DEGREE, EDGE_DEGREE = 2.0, 6, 4


@dataclass(frozen=True, eq=False)
class _Unrolled:
    """A row along the line through its crowns: places, their points, and depths of gaps, mm."""

    along: Floats
    points: Floats
    gaps: Floats


def first_molars(row: ToothRow) -> dict[str, Floats | str]:
    """The middle of the first molar's crown, (3,) mm, by side, "L" or "R"; or why there is none.

    Raises `CaseError`: The bone has no teeth.
    """
    if row not in _FOUND:
        unrolled, widths = _unrolled(row), WIDTHS[row.arch.jaw]
        _FOUND[row] = {side: _molar(unrolled, widths, sign) for side, sign in SIDES}
    return _FOUND[row]


# Of rows that are in use: the page and the report need them more than once.
_FOUND: WeakKeyDictionary[ToothRow, dict[str, Floats | str]] = WeakKeyDictionary()


def _molar(row: _Unrolled, widths: Sequence[float], side: int) -> Floats | str:
    """The middle of the molar at one side."""
    order = np.argsort(side * row.along)
    along, gaps = (side * row.along)[order], row.gaps[order]
    score, ends = _placed(along, gaps, widths)
    if not len(ends):
        return "the row ends before it"
    if gaps[ends].min() < SHALLOWEST:
        return f"the gaps between crowns are {gaps[ends].min():.1f} mm deep, not {SHALLOWEST:g}"
    fewer = [*widths[:PREMOLAR], *widths[PREMOLAR + 1 :]]
    if _placed(along, gaps, fewer)[0] > score - CLEARER:
        return "a tooth in front of it may be missing"
    middle = 0.5 * (along[ends[FIRST_MOLAR]] + along[ends[FIRST_MOLAR + 1]])
    return np.array([np.interp(middle, along, row.points[order, k]) for k in range(3)])


def _placed(along: Floats, gaps: Floats, widths: Sequence[float]) -> tuple[float, NDArray[np.intp]]:
    """The mean depth of gaps at their best places, less what uneven widths cost; their indices.

    The first is that of the midline. No index where the row is too short.
    """
    widths = widths[:-1]
    best, found = -np.inf, np.zeros(0, dtype=np.intp)
    for size in SIZES:
        score = np.where(np.abs(along) <= MIDLINE, gaps, -np.inf)
        cost = COST * ((size - 1.0) / UNEVEN) ** 2
        back = []
        for width in widths:
            low, high = (
                round(size * width * (1.0 + e) / STEP) for e in (-MOST_UNEVEN, MOST_UNEVEN)
            )
            steps = np.arange(low, high + 1)
            cost_of = COST * ((steps * STEP / (size * width) - 1.0) / UNEVEN) ** 2
            source = np.arange(len(along))[:, None] - steps
            from_there = np.where(source >= 0, score[np.maximum(source, 0)], -np.inf) - cost_of
            choice = np.argmax(from_there, axis=1)
            back.append(np.take_along_axis(source, choice[:, None], axis=1)[:, 0])
            score = np.take_along_axis(from_there, choice[:, None], axis=1)[:, 0] + gaps
        end = int(np.argmax(score))
        total = float(score[end] - cost) / (len(widths) + 1)
        if total > best:
            ends = [end]
            for step in reversed(back):
                ends.append(int(step[ends[-1]]))
            best, found = total, np.array(ends[::-1], dtype=np.intp)
    return best, found


def _unrolled(row: ToothRow) -> _Unrolled:
    """The row unrolled, from the right to the left."""
    arch = row.arch
    axes = _upright(row)
    places = (_samples(row) - arch.middle) @ axes.T
    line, turns = _line(places)
    flat = np.column_stack([line * np.sin(turns), line * np.cos(turns)])
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(flat, axis=0), axis=1))])
    tip = axes @ (arch.tip - arch.middle)
    length -= np.interp(np.arctan2(tip[0], tip[1]), turns, length)
    along = STEP * np.arange(np.ceil(length[0] / STEP), np.floor(length[-1] / STEP) + 1)
    centres = np.column_stack([np.interp(along, length, flat[:, k]) for k in range(2)])
    ahead = np.gradient(centres, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1)[:, None]
    spatial = third_party("scipy.spatial", "first molars are found", "imaging")
    nearest = spatial.cKDTree(centres).query(places[:, :2])[1]
    off = places[:, :2] - centres[nearest]
    beside = off[:, 0] * ahead[nearest, 1] - off[:, 1] * ahead[nearest, 0]
    # What lies beyond the ends of the line has its end as the nearest place.
    kept = (np.abs(beside) < HALF_CROWN) & (np.abs((off * ahead[nearest]).sum(axis=1)) < 2.0 * STEP)
    nearest, beside, height = nearest[kept], beside[kept], places[kept, 2]
    top = _widest(len(along), nearest, height)
    edge = np.polynomial.Chebyshev.fit(along[np.isfinite(top)], top[np.isfinite(top)], EDGE_DEGREE)
    high = height > edge(along)[nearest] - TOP
    wide = [_widest(len(along), nearest[high], sign * beside[high]) for sign in (1.0, -1.0)]
    top, width = (_filled(values) for values in (top, wide[0] + wide[1]))
    gaps = DEEPEST * np.tanh((_dips(top) + _dips(width)) / DEEPEST)
    points = np.column_stack([centres, top]) @ axes + arch.middle
    return _Unrolled(along, points, gaps)


def _upright(row: ToothRow) -> Floats:
    """Unit vectors at right angles: to the left, ahead, and from the roots to the bite."""
    across, ahead, out = row.arch.axes()
    across = across - (across @ out) * out
    across /= np.linalg.norm(across)
    ahead = ahead - (ahead @ out) * out - (ahead @ across) * across
    return np.stack([across, ahead / np.linalg.norm(ahead), -out])


def _samples(row: ToothRow) -> Floats:
    """Vertices of the crowns, and points inside their triangles."""
    vertices, crowns = row.surface.vertices, row.crowns
    triangles = row.surface.triangles[crowns[row.surface.triangles].all(axis=1)]
    corners = vertices[triangles]
    shares = (np.ones(3) + 3.0 * np.eye(4, 3)) / np.array([6.0, 6.0, 6.0, 3.0])[:, None]
    inner = np.einsum("kc,tcx->ktx", shares, corners).reshape(-1, 3)
    return np.concatenate([vertices[crowns], inner])


def _line(places: Floats) -> tuple[Floats, Floats]:
    """The radius of the line through the crowns about the middle, with its angles."""
    turn, radius = np.arctan2(places[:, 0], places[:, 1]), np.hypot(places[:, 0], places[:, 1])
    sector = np.round(np.degrees(turn) / SECTOR).astype(int)
    found = []
    for number in np.unique(sector):
        inside = sector == number
        high = inside & (places[:, 2] > np.percentile(places[inside, 2], 98) - TOP)
        if high.sum() >= 4:
            found.append((np.radians(number * SECTOR), *np.percentile(radius[high], [2, 98])))
    turns, inner, outer = np.array(found).T
    fitted = np.polynomial.Chebyshev.fit(turns, 0.5 * (inner + outer), LINE_DEGREE)
    fine = np.linspace(turns[0], turns[-1], 1000)
    return fitted(fine), fine


def _widest(count: int, place: NDArray[np.intp], values: Floats) -> Floats:
    """The largest value at each place and its neighbours; −inf where there is none."""
    found = np.full(count + 2, -np.inf)
    for shift in (0, 1, 2):
        np.maximum.at(found, place + shift, values)
    return found[1:-1]


def _filled(values: Floats) -> Floats:
    """Values with those that are missing interpolated."""
    known = np.isfinite(values)
    return np.interp(np.arange(len(values)), np.flatnonzero(known), values[known])


def _dips(values: Floats) -> Floats:
    """How far each value lies below those half a tooth to both sides, on average."""
    reach = int(HALF_TOOTH / STEP)
    wide = np.pad(values, reach, mode="edge")
    return 0.5 * (wide[: -2 * reach] + wide[2 * reach :]) - values
