"""The frame of a mouth, and the line where its lips meet: the deepest points across the skin.

Where the lips stand apart this is the end of the gap, and where they are closed the crease between
them. Profiles are taken in planes along the mouth's frame; a path through all of them, found by
dynamic programming, follows the crease past places where another fold is deeper for a moment.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmfsim.values.anatomy import Anatomy, DentalArch
from cmfsim.values.checks import Floats

# Grid of the profiles, mm: planes across, places along a profile, and steps of a ray into the head.
COLUMN, STEP, RAY = 1.0, 0.5, 0.5
# Profiles are taken up to this far to either side of the middle, mm: half the widest mouth, plus a
# margin.
ASIDE = 40.0
# Rays start this far in front of the arches and end this far behind their fronts, mm.
AHEAD, BEHIND = 45.0, 40.0
# Profiles extend this far above and below the fronts of the arches, mm, to leave room for the ends
# of chords.
ROOM = 10.0
# Half the length of the chords from lip to lip under which the depth of a crease is measured, mm.
CHORD = 8.0
# A crease is at least this deep in the middle of the mouth, mm. It ends at the corners, where it is
# shallower than the second figure or than half its median depth in the middle, whichever is less.
MIDDLE_DEPTH, CORNER_DEPTH = 0.5, 1.2
# Half the width of the part of the mouth that counts as its middle, mm.
MIDDLE = 10.0
# Half the width of the narrowest mouth, mm.
NARROWEST = 12.0
# Largest slope of the path from plane to plane, mm per mm, and the slope that costs as much as 1 mm
# of depth.
MOST_SLOPE, COSTLY_SLOPE = 1.5, 1.6
# Length over which the line is smoothed, mm: fine enough for the bow of the upper lip.
SMOOTH = 4.0


@dataclass(frozen=True, eq=False)
class MouthFrame:
    """Axes of a mouth, with its origin half-way between the fronts of the two arches; mm.

    axes: (3, 3). Rows: unit vectors to the left, ahead and up, at right angles. The frame is
        left-handed in LPS, where ahead is −y.
    reach_up, reach_down: Heights of the fronts of both arches: between them the lips meet.
    half_width: Half the distance between the second molars.
    molars: Forward position of the second molars relative to the origin; negative.
    """

    origin: Floats
    axes: Floats
    reach_up: float
    reach_down: float
    half_width: float
    molars: float

    def into(self, points: Floats) -> Floats:
        """Coordinates to the left, ahead and up of points in space, (n, 3) mm."""
        return (points - self.origin) @ self.axes.T

    def out_of(self, places: Floats) -> Floats:
        """The points in space of coordinates to the left, ahead and up, (n, 3) mm."""
        return self.origin + places @ self.axes


def mouth_frame(arches: Mapping[str, DentalArch]) -> MouthFrame:
    """The frame of a mouth from its "upper" and "lower" dental arch."""
    upper, lower = arches["upper"], arches["lower"]
    up = upper.out - lower.out
    up = up / np.linalg.norm(up)
    left = upper.left - upper.right
    left = left + lower.left - lower.right
    left = left - (left @ up) * up
    left = left / np.linalg.norm(left)
    tips = [upper.tip, lower.tip]
    molars = 0.5 * (upper.middle + lower.middle)
    origin = 0.5 * (tips[0] + tips[1])
    ahead = np.cross(left, up)
    ahead = ahead * np.sign(ahead @ (origin - molars))
    return MouthFrame(
        origin,
        np.stack([left, ahead, up]),
        float((tips[0] - origin) @ up),
        float((tips[1] - origin) @ up),
        0.5 * (upper.half_width + lower.half_width),
        float((molars - origin) @ ahead),
    )


@dataclass(frozen=True, eq=False)
class SkinProfiles:
    """How far ahead the skin lies in front of a mouth.

    across: (p,), mm, to the left, symmetric about the middle.
    heights: (q,), mm.
    ahead: (p, q), mm, of the foremost tissue or bone; the ray's end where there is none.
    depth: (p, q), mm. Its depth under the chords between points at most `CHORD` above and below.
    """

    across: Floats
    heights: Floats
    ahead: Floats
    depth: Floats

    def at(self, across: Floats, heights: Floats) -> Floats:
        """How far ahead the skin lies at places, (n,) mm."""
        column = np.clip((across - self.across[0]) / COLUMN, 0.0, len(self.across) - 1.001)
        low = column.astype(int)
        part = column - low
        ends = [
            [np.interp(h, self.heights, self.ahead[k]) for k, h in zip(row, heights, strict=True)]
            for row in (low, low + 1)
        ]
        point: Floats = (1.0 - part) * np.array(ends[0]) + part * np.array(ends[1])
        return point


@dataclass(frozen=True, eq=False)
class MouthLine:
    """The line where lips meet on the skin, from right to left, (k,) mm in the mouth's frame."""

    across: Floats
    ahead: Floats
    heights: Floats

    def between(self, right: float, left: float, profiles: SkinProfiles) -> "MouthLine":
        """The line between corners, mm to the left; beyond its ends over the skin at one height."""
        columns = profiles.across
        inner = columns[(columns > right + 0.5 * COLUMN) & (columns < left - 0.5 * COLUMN)]
        at = np.concatenate([[right], inner, [left]])
        heights = np.interp(at, self.across, self.heights)
        beyond = (at < self.across[0]) | (at > self.across[-1])
        ahead = np.interp(at, self.across, self.ahead)
        return MouthLine(at, np.where(beyond, profiles.at(at, heights), ahead), heights)


def skin_profiles(anatomy: Anatomy, frame: MouthFrame) -> SkinProfiles:
    """The profiles of the skin in front of a mouth; cavities open to the front are outside."""
    count = round(ASIDE / COLUMN)
    across = np.linspace(-COLUMN * count, COLUMN * count, 2 * count + 1)
    low, high = frame.reach_down - ROOM, frame.reach_up + ROOM
    heights = np.arange(low, high, STEP, dtype=np.float64)
    rays = np.arange(AHEAD, -BEHIND, -RAY, dtype=np.float64)
    places = np.stack(np.meshgrid(across, heights, rays, indexing="ij"), axis=-1)
    points = frame.out_of(places[..., [0, 2, 1]].reshape(-1, 3))
    level = solid(anatomy, points).reshape(places.shape[:3])
    ahead = _first_inside(level, rays)
    return SkinProfiles(across, heights, ahead, _chord_depth(ahead))


def solid(anatomy: Anatomy, points: Floats) -> Floats:
    """The level of tissue and bone at points, positive inside; cavities are outside."""
    level = anatomy.skin.sample(points)
    if anatomy.air is not None:
        level = np.minimum(level, -anatomy.air.sample(points))
    return level


def _first_inside(level: Floats, rays: Floats) -> Floats:
    """Where rays first enter tissue or bone, interpolated; their end if they do not."""
    inside = level > 0.0
    hit = inside.any(axis=2)
    first = np.argmax(inside, axis=2)
    before = np.maximum(first - 1, 0)
    here = np.take_along_axis(level, first[..., None], axis=2)[..., 0]
    there = np.take_along_axis(level, before[..., None], axis=2)[..., 0]
    part = np.where(here > there, here / np.where(here > there, here - there, 1.0), 0.0)
    ahead = rays[first] + part * (rays[before] - rays[first])
    places: Floats = np.where(hit, ahead, rays[-1])
    return places


def _chord_depth(ahead: Floats) -> Floats:
    """The depth of each point of the profiles under the highest chord above it, mm."""
    reach = round(CHORD / STEP)
    n = ahead.shape[1]
    highest = np.full(ahead.shape, -np.inf)
    for up in range(1, reach + 1):
        for down in range(1, reach + 1):
            chord = (down * ahead[:, up + down :] + up * ahead[:, : n - up - down]) / (up + down)
            inner = slice(down, n - up)
            highest[:, inner] = np.maximum(highest[:, inner], chord)
    return np.maximum(highest - ahead, 0.0)


def crease_line(profiles: SkinProfiles, frame: MouthFrame) -> MouthLine | None:
    """The line where the lips meet, found in the profiles; None if they show no crease.

    It ends at the corners of the mouth, where the crease ends, and lies between the arches' fronts.
    """
    heights = profiles.heights
    between = (heights >= frame.reach_down) & (heights <= frame.reach_up)
    depth = np.where(between, profiles.depth, -np.inf)
    path = _deepest_path(np.minimum(depth, CHORD))
    found = profiles.depth[np.arange(len(path)), path]
    middle = np.abs(profiles.across) <= MIDDLE
    if not (found[middle] >= MIDDLE_DEPTH).all():
        return None
    least = min(CORNER_DEPTH, 0.5 * float(np.median(found[middle])))
    ends = []
    for side in (-1.0, 1.0):
        outwards = np.flatnonzero((side * profiles.across >= 0.0) & (found < least))
        ends.append(min(side * profiles.across[outwards], default=ASIDE + COLUMN) - COLUMN)
    if min(ends) < NARROWEST:
        return None
    line = (profiles.across >= -ends[0]) & (profiles.across <= ends[1])
    rows = np.flatnonzero(line)
    places = np.array([_valley(profiles, row, int(path[row])) for row in rows.tolist()])
    weight = np.minimum(found[rows], MIDDLE_DEPTH)
    return MouthLine(
        profiles.across[rows],
        smoothed(places[:, 1], weight, SMOOTH / COLUMN),
        smoothed(places[:, 0], weight, SMOOTH / COLUMN),
    )


def _deepest_path(depth: Floats) -> NDArray[np.intp]:
    """One point of each profile: a deep path whose height changes little."""
    n_columns, n = depth.shape
    most = round(MOST_SLOPE * COLUMN / STEP)
    best = depth[0].copy()
    came = np.zeros((n_columns, n), dtype=np.intp)
    for column in range(1, n_columns):
        score = np.full(n, -np.inf)
        # Small steps first: of equally good paths the straighter one is kept.
        for step in sorted(range(-most, most + 1), key=abs):
            cost = (step * STEP / COLUMN / COSTLY_SLOPE) ** 2
            moved = np.full(n, -np.inf)
            source = slice(max(-step, 0), n - max(step, 0))
            moved[max(step, 0) : n - max(-step, 0)] = best[source] - cost
            better = moved > score
            score[better] = moved[better]
            came[column, better] = np.flatnonzero(better) - step
        best = score + depth[column]
    path = np.zeros(n_columns, dtype=np.intp)
    path[-1] = int(np.argmax(best))
    for column in range(n_columns - 1, 0, -1):
        path[column - 1] = came[column, path[column]]
    return path


def _valley(profiles: SkinProfiles, row: int, place: int) -> tuple[float, float]:
    """Height and forward position of the bottom of a profile's valley, interpolated."""
    depth = profiles.depth[row]
    near = slice(max(place - 3, 0), place + 4)
    # Gaps have flat ends: take the middle of what lies within 0.25 mm of the deepest point.
    weight = np.maximum(depth[near] - depth[near].max() + 0.25, 0.0)
    height = float((weight * profiles.heights[near]).sum() / weight.sum())
    ahead = profiles.ahead[row]
    return height, float(np.interp(height, profiles.heights, ahead))


def smoothed(values: Floats, weight: Floats, length: float) -> Floats:
    """Values along a line, smoothed over a length in steps (Whittaker 1923).

    The sum of weighted squares of what it changes, and of `length`⁴ times second differences, is
    least; outliers, past twice the median change, count for less.
    """
    n = len(values)
    if n < 4:
        return values.copy()
    second = np.diff(np.eye(n), 2, axis=0)
    stiff = (0.5 * length) ** 4 * second.T @ second
    kept = weight / max(float(np.max(weight)), 1e-9)
    kept = np.maximum(kept, 1e-6)
    smooth: Floats = values
    trust = np.ones(n)
    for _ in range(5):
        w = kept * trust
        smooth = np.asarray(np.linalg.solve(np.diag(w) + stiff, w * values))
        away = np.abs(values - smooth)
        limit = max(2.0 * float(np.median(away)), 0.1)
        trust = np.where(away > limit, limit / np.maximum(away, 1e-12), 1.0)
    return smooth
