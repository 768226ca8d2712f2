"""The sheet between the lips: from the mouth's line on the skin back to the dental arches.

In the horizontal plane its rows run from the line towards a centre inside the arches, so that no
two of them cross; they end a little way past the bone or teeth that they meet.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.meshing.lips.crease import MIDDLE, MouthFrame, MouthLine, SkinProfiles, smoothed, solid
from cmfsim.values.anatomy import Anatomy
from cmfsim.values.checks import Floats
from cmfsim.values.surface_data import SurfaceData, area_vectors

# Distance of the centre of the rows behind the foremost point of the mouth's line, mm: about the
# radius of an arch in front.
CENTRE = 30.0
# Bone is searched for within these distances above and below a row, and along it, mm.
BONE_HEIGHT, BONE_LENGTH = 5.0, 28.0
# Teeth on either side bridge gaps of up to this many columns in a row.
BRIDGED = 4
# Bone at the height of a row ends it if it lies at most this far behind the nearest bone, mm: lower
# teeth under the edges of the upper ones.
OVERJET = 12.0
# Least share of rows that must meet bone.
LEAST_MET = 0.6
# Step of a row from the skin backwards, mm, and of the search for bone.
STEP, BONE_STEP = 1.0, 0.5
# How far the sheet extends in front of the lips, mm.
IN_FRONT = 2.0
# The red of the lips extends at most this far above and below their line, mm.
RED = 10.0
# An opening between the lips counts as a gap up to this height, mm.
HIGHEST_GAP = 14.0
# Step of the search for the edges of a gap, mm.
FINE = 0.25
# Length over which heights are smoothed from column to column, in columns.
SMOOTH = 4.0
# Least depth of a gap, and the distance in front of its end at which its opening is measured, mm.
LEAST_GAP, WITHIN = 3.0, 1.0


@dataclass(frozen=True, eq=False)
class LipSheet:
    """The sheet between the lips, open, its normals up, and what is known of it.

    thickness: mm. Median length of its rows from the mouth's line to the arches: of the lips.
    opening: mm. Median height of the gap between the lips in the middle of the mouth, close to its
        end; 0 where they are closed.
    """

    surface: SurfaceData
    thickness: float
    opening: float


def lip_sheet(
    anatomy: Anatomy, frame: MouthFrame, profiles: SkinProfiles, line: MouthLine, depth: float
) -> LipSheet | str:
    """The sheet from the mouth's line to the arches; or why there is none.

    Where the skin shows a gap between the lips the sheet is its mid-surface, and goes on behind its
    end at the same height.

    depth: mm. How far the sheet extends behind the teeth, into the cleft between the tooth rows.
    """
    base = np.column_stack([line.across, line.ahead])
    centre = np.array([0.5 * (line.across[0] + line.across[-1]), line.ahead.max() - CENTRE])
    behind = float(np.ptp(line.ahead))
    if behind >= CENTRE:
        return f"the line where the lips should meet runs {behind:.0f} mm into an open mouth"
    inwards = centre - base
    # Rows beside the centre run straight inwards and do not turn forward again.
    inwards[:, 1] = np.minimum(inwards[:, 1], 0.0)
    inwards = inwards / np.linalg.norm(inwards, axis=1)[:, None]
    met = _bone_met(anatomy, frame, line, base, inwards)
    if met is None:
        return "no teeth or bone lie behind the line where the lips meet"
    thickness, at_height = met
    # Teeth on either side of a gap between them bridge it.
    nearest = smoothed(-_widened(-thickness, BRIDGED), np.ones(len(thickness)), SMOOTH)
    nearest = np.maximum(nearest, 0.0)
    back = np.maximum(nearest + depth, np.where(at_height <= nearest + OVERJET, at_height + 1.0, 0))
    back = _widened(back, BRIDGED // 2)
    front = _in_front(profiles, line)
    n_front, n_back = (int(np.ceil(float(part.max()) / STEP)) for part in (front, back))
    share = np.concatenate([np.linspace(-1.0, 0.0, n_front + 1), np.linspace(0, 1, n_back + 1)[1:]])
    away = share * np.where(share < 0.0, front[:, None], back[:, None])
    plane = base[:, None] + away[..., None] * inwards[:, None]
    heights, opening = _heights(anatomy, frame, line, plane, away)
    places = np.concatenate([plane, heights[..., None]], axis=-1)
    vertices = frame.out_of(places.reshape(-1, 3))
    triangles = _grid_triangles(*heights.shape)
    surface = SurfaceData(vertices, facing(vertices, triangles, frame.axes[2]))
    return LipSheet(surface, float(np.median(thickness)), opening)


def _bone_met(
    anatomy: Anatomy, frame: MouthFrame, line: MouthLine, base: Floats, inwards: Floats
) -> tuple[Floats, Floats] | None:
    """How far along each row the nearest bone lies, at heights about its own and at its own, mm.

    The latter is infinite where there is none.
    """
    along = BONE_STEP * np.arange(int(BONE_LENGTH / BONE_STEP) + 1)
    rise = np.arange(-BONE_HEIGHT, BONE_HEIGHT + 0.5)
    plane = base[:, None] + along[:, None] * inwards[:, None]
    shape = (len(base), len(rise), len(along))
    places = np.empty((*shape, 3))
    places[..., :2] = plane[:, None]
    places[..., 2] = (line.heights[:, None] + rise)[..., None]
    points = frame.out_of(places.reshape(-1, 3))
    bone = np.zeros(len(points), dtype=bool)
    for level in anatomy.bones.values():
        bone |= level.sample(points) > 0.0
    bone = bone.reshape(shape)
    first = np.where(bone.any(axis=2), along[np.argmax(bone, axis=2)], np.inf)
    nearest = first.min(axis=1)
    found = np.isfinite(nearest)
    if np.count_nonzero(found) < LEAST_MET * len(found):
        return None
    nearest = np.interp(line.across, line.across[found], nearest[found])
    return nearest, first[:, len(rise) // 2]


def _widened(values: Floats, reach: int) -> Floats:
    """The largest value within a number of positions on either side."""
    padded = np.pad(values, reach, mode="edge")
    highest: Floats = np.max([padded[k : k + len(values)] for k in range(2 * reach + 1)], axis=0)
    return highest


def _in_front(profiles: SkinProfiles, line: MouthLine) -> Floats:
    """How far the lips protrude in front of the line, plus a margin, mm."""
    found = []
    for across, ahead, height in zip(line.across, line.ahead, line.heights, strict=True):
        column = int(np.argmin(np.abs(profiles.across - across)))
        near = np.abs(profiles.heights - height) <= RED
        found.append(max(float(profiles.ahead[column, near].max()) - ahead, 0.0) + IN_FRONT)
    return np.array(found)


def _heights(
    anatomy: Anatomy, frame: MouthFrame, line: MouthLine, plane: Floats, away: Floats
) -> tuple[Floats, float]:
    """The heights of the sheet at points of the plane, and the opening in its middle, mm."""
    n_columns, n_rows = plane.shape[:2]
    count = round(0.5 * HIGHEST_GAP / FINE)
    fine = np.linspace(-count * FINE, count * FINE, 2 * count + 1)
    level_at = line.heights[:, None, None] + fine
    places = np.concatenate(
        [np.broadcast_to(plane[:, :, None], (n_columns, n_rows, len(fine), 2)),
         np.broadcast_to(level_at, (n_columns, n_rows, len(fine)))[..., None]], axis=-1
    )  # fmt: skip
    level = solid(anatomy, frame.out_of(places.reshape(-1, 3))).reshape(places.shape[:3])
    low, high = _air_about(level, fine)
    bounded = np.isfinite(low) & np.isfinite(high)
    # Only what the front opens into: behind, hollows of the mouth may follow.
    bounded &= np.arange(n_rows) < _first_closed(bounded, away)[:, None]
    middle = np.where(bounded, 0.5 * (low + high), 0.0)
    heights = np.empty((n_columns, n_rows))
    sizes = []
    for column in range(n_columns):
        known = np.flatnonzero(bounded[column])
        offset = np.zeros(n_rows)
        if len(known):
            offset = np.interp(away[column], away[column, known], middle[column, known])
            end = away[column, known[-1]]
            inner = known[away[column, known] <= end - WITHIN]
            deep = len(inner) and end - away[column, known[0]] >= LEAST_GAP
            if abs(line.across[column] - line.across.mean()) <= MIDDLE:
                sizes.append(float((high - low)[column, inner[-1]]) if deep else 0.0)
        heights[column] = line.heights[column] + offset
    even = np.ones(n_columns)
    smooth = np.stack([smoothed(heights[:, k], even, SMOOTH) for k in range(n_rows)], axis=1)
    return smooth, float(np.median(sizes)) if sizes else 0.0


def _first_closed(bounded: NDArray[np.bool_], away: Floats) -> NDArray[np.intp]:
    """The first row, from the mouth's line on backwards, at which no gap is left in a column."""
    closed = ~bounded & (away >= 0.0)
    first: NDArray[np.intp] = np.where(
        closed.any(axis=1), np.argmax(closed, axis=1), bounded.shape[1]
    )
    return first


def _air_about(level: Floats, fine: Floats) -> tuple[Floats, Floats]:
    """Lower and upper end of the air about the middle of vertical lines; NaN where it has none."""
    centre = len(fine) // 2
    air = level < 0.0
    ends = []
    for side in (slice(centre, None, -1), slice(centre, None)):
        values, at, free = level[..., side], fine[side], air[..., side]
        first = np.argmax(~free, axis=-1)
        found = (~free).any(axis=-1) & (first > 0)
        before = np.maximum(first - 1, 0)
        here = np.take_along_axis(values, first[..., None], -1)[..., 0]
        there = np.take_along_axis(values, before[..., None], -1)[..., 0]
        drop = np.where(here > there, here - there, 1.0)
        ends.append(np.where(found, at[first] - (at[first] - at[before]) * here / drop, np.nan))
    return ends[0], ends[1]


def _grid_triangles(n_columns: int, n_rows: int) -> NDArray[np.intp]:
    """The triangles of a grid of vertices, the diagonals of its halves mirrored."""
    number = np.arange(n_columns * n_rows).reshape(n_columns, n_rows)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    left = (np.arange(n_columns - 1) >= (n_columns - 1) / 2)[:, None]
    one = np.where(left[..., None], np.stack([a, b, c], -1), np.stack([a, b, d], -1))
    two = np.where(left[..., None], np.stack([a, c, d], -1), np.stack([b, c, d], -1))
    return np.concatenate([one.reshape(-1, 3), two.reshape(-1, 3)])


def facing(vertices: Floats, triangles: NDArray[Any], up: Floats) -> NDArray[Any]:
    """The triangles (t, 3), turned if their normals look down on the whole; `up`: (3,)."""
    down = float((area_vectors(vertices, triangles) @ up).sum()) < 0.0
    return triangles[:, ::-1] if down else triangles
