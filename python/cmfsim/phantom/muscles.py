"""The muscles of one person: straps along their courses, with the true fibre directions.

Courses are those of the left side, in courses.json. Each fibre line is a list of rows x, y, z,
place, half thickness, half width, in mm of the drawn head. Place says how the point is put into the
tissue of the person at hand: up to 1 it is the fraction of the way from skin to bone (1: attached
to bone), above 1 the depth below the skin in mm, and 0 leaves the point where it is. Origins come
first. Courses after the usual textbooks of anatomy (Gray 1918; Netter); lengths and widths are
round figures of adults.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from cmfsim.phantom.grid import Field, gradient_at, to_surface
from cmfsim.phantom.head import Drawn
from cmfsim.phantom.parameters import JawWarp
from cmfsim.phantom.shapes import REACH, Box, Level, Tube, smooth_curve, smooth_max
from cmfsim.values.checks import Floats, as_rows, frozen


class Course(NamedTuple):
    """How one muscle runs: kind, fibre lines, whether there are two, whether the lines close."""

    kind: str
    paired: bool
    closed: bool
    lines: Sequence[Sequence[Sequence[float]]]


_TABLE = json.loads(files(__package__).joinpath("courses.json").read_text(encoding="utf-8"))
COURSES = MappingProxyType({name: Course(**entry) for name, entry in _TABLE.items()})
# Muscle stays this far below the skin, mm.
BELOW_SKIN = 0.6
# Neighbouring straps of one muscle melt over this width, mm.
MELT = 1.5
# Points per interval of a course.
STEPS = 5
# Rows per interval of a course that is put below the skin row by row.
DENSE_STEPS = 3
# Distance within which a fibre line counts as met, relative to the mean length of the lines.
SOFTENING = 0.01


@dataclass(frozen=True, eq=False)
class Muscle:
    """One muscle with its known fibres.

    Attributes
    ----------
    name : str
        Kind and side, such as "masseter_L"; without a side where it crosses the midline.
    side : str
        "L", "R" or "both".
    kind : str
        "strap", "fan", "ring" or "sheet".
    course : tuple of (n, 3) float64, mm
        Fibre lines in the person's space, from origin to insertion; a ring about an eye ends where
        it starts.
    origin, insertion : (k, 3) float64, mm
        First and last points of the lines.
    """

    name: str
    side: str
    kind: str
    course: tuple[Floats, ...]
    tubes: tuple[Tube, ...] = field(repr=False)
    tissue: Drawn = field(repr=False)

    @property
    def origin(self) -> Floats:
        """The first point of each line, (k, 3) mm."""
        return np.array([line[0] for line in self.course])

    @property
    def insertion(self) -> Floats:
        """The last point of each line, (k, 3) mm."""
        return np.array([line[-1] for line in self.course])

    def _fold(self, x: Level) -> Level:
        """The place on the drawn, left, side."""
        if self.side == "both":
            return np.abs(x)
        return -x if self.side == "R" else x

    @property
    def box(self) -> Box:
        """Where the muscle can lie, in the symmetric head."""
        low = np.min([tube.box.low for tube in self.tubes], axis=0)
        high = np.max([tube.box.high for tube in self.tubes], axis=0)
        if self.side == "both":
            low[0] = -high[0]
        elif self.side == "R":
            low[0], high[0] = -high[0], -low[0]
        return Box(tuple(low.tolist()), tuple(high.tolist()))

    def strap_level(self, x: Level, y: Level, z: Level) -> Level:
        """The level in the symmetric head of the straps alone, not yet clipped by skin and bone."""
        x = self._fold(x)
        value = self.tubes[0].level(x, y, z)
        for tube in self.tubes[1:]:
            value = smooth_max(value, tube.level(x, y, z), MELT)
        return value

    def drawn_level(self, x: Level, y: Level, z: Level) -> Level:
        """The level in the symmetric head: below the skin and outside the bones."""
        strap = self.strap_level(x, y, z)
        if strap.max() < -REACH:
            return strap
        return self.clipped(strap, *self.tissue.skin_and_bone(x, y, z))

    @staticmethod
    def clipped(strap: Level, skin: Level, bone: Level) -> Level:
        """A strap's level, kept below the skin and outside the bones."""
        level: Level = np.minimum(np.minimum(strap, skin - BELOW_SKIN), -bone)
        return level

    def level(self, points: ArrayLike) -> Floats:
        """The level at points, (n,) mm: positive inside the muscle.

        Parameters
        ----------
        points : (n, 3) float64, mm
        """
        rows = as_rows("points", points, 3)
        warp = self.tissue.warp
        value = warp.parameters.scale * self.drawn_level(*warp.inverse(*rows.T))
        return np.asarray(value, dtype=np.float64)

    def fibre(self, points: ArrayLike) -> Floats:
        """The unit directions of the fibres at points, (n, 3), from origin towards insertion.

        By definition the principal axis of the mean of a aᵀ over the fibre lines, a the tangent of
        a line where it is nearest, weighted by the inverse fourth power of the distance (softened
        by a hundredth of the mean length): on a line it is its tangent. Use it near the muscle: far
        away it is defined but has no meaning.

        Parameters
        ----------
        points : (n, 3) float64, mm
        """
        rows = as_rows("points", points, 3)
        lengths = [np.linalg.norm(np.diff(line, axis=0), axis=1).sum() for line in self.course]
        softening = (SOFTENING * float(np.mean(lengths))) ** 2
        total = np.zeros((len(rows), 3, 3))
        nearest = np.full(len(rows), np.inf)
        sense = np.zeros((len(rows), 3))
        for line in self.course:
            distance2, along = _closest_direction(line, rows)
            weight = (distance2 + softening) ** -2.0
            total += weight[:, None, None] * along[:, :, None] * along[:, None, :]
            closer = distance2 < nearest
            nearest[closer], sense[closer] = distance2[closer], along[closer]
        direction = np.linalg.eigh(total)[1][:, :, 2]
        back = (direction * sense).sum(axis=1) < 0.0
        return np.where(back[:, None], -direction, direction)


def _tangents(line: Floats) -> Floats:
    """The unit tangents at the points of a polyline: of the parabola through three of them."""
    closed = np.allclose(line[0], line[-1])
    rows = np.vstack([line[-2], line, line[1]]) if closed else line
    place = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(rows, axis=0), axis=1))])
    slope = np.gradient(rows, place, axis=0, edge_order=2)
    tangents = slope[1:-1] if closed else slope
    units: Floats = tangents / np.linalg.norm(tangents, axis=1)[:, None]
    return units


def _closest_direction(line: Floats, points: Floats) -> tuple[Floats, Floats]:
    """Squared distance to a polyline and its unit tangent at the closest point."""
    tangents = _tangents(line)
    best = np.full(len(points), np.inf)
    along = np.zeros((len(points), 3))
    for i in range(len(line) - 1):
        step = line[i + 1] - line[i]
        t = np.clip((points - line[i]) @ step / max(float(step @ step), 1e-12), 0.0, 1.0)
        d2 = ((points - line[i] - t[:, None] * step) ** 2).sum(axis=1)
        closer = d2 < best
        best = np.where(closer, d2, best)
        blend = (1.0 - t)[:, None] * tangents[i] + t[:, None] * tangents[i + 1]
        along[closer] = blend[closer]
    return best, along / np.linalg.norm(along, axis=1)[:, None]


def make_muscles(tissue: Drawn) -> Mapping[str, Muscle]:
    """All muscles of a person by name, on both sides."""
    lines = [_dense(line, course) for course in COURSES.values() for line in course.lines]
    lengths = [len(line) for line in lines]
    table = np.vstack(lines)
    soft = JawWarp(tissue.warp.parameters, soft=True)
    table[:, :3] = soft.forward(table[:, :3])
    table[:, :3] = _placed(tissue, table[:, :3], table[:, 3])
    muscles: dict[str, Muscle] = {}
    start = 0
    for name, course in COURSES.items():
        tubes = []
        for _ in course.lines:
            tubes.append(_strap(tissue, table[start : start + lengths[0]], course))
            start += lengths.pop(0)
        for side in ("L", "R") if course.paired else ("both",):
            muscle = f"{name}_{side}" if course.paired else name
            fibres = tuple(_line(tissue, tube, side, course) for tube in tubes)
            muscles[muscle] = Muscle(muscle, side, course.kind, fibres, tuple(tubes), tissue)
    return MappingProxyType(muscles)


def _dense(line: Sequence[Sequence[float]], course: Course) -> Floats:
    """More rows, where all lie superficially: a sheet must follow the skin between them."""
    rows = np.array(line, dtype=np.float64)
    if course.kind != "sheet" and not (rows[:, 3] > 1.0).all():
        return rows
    dense = smooth_curve(rows, DENSE_STEPS, closed=course.closed)
    return dense[:-1] if course.closed else dense


def _line(tissue: Drawn, tube: Tube, side: str, course: Course) -> Floats:
    """A fibre line in the person's space."""
    points = tube.points
    mirror = points * np.array([-1.0, 1.0, 1.0])
    if side == "R":
        points = mirror
    elif side == "both" and course.kind == "ring":
        # The left half runs from the upper to the lower midline, the right half back again.
        points = np.vstack([points, mirror[-2::-1]])
    return frozen(tissue.warp.forward(points))


def _strap(tissue: Drawn, rows: Floats, course: Course) -> Tube:
    """The tube along one line, flat towards the skin."""
    curve = smooth_curve(np.delete(rows, 3, axis=1), STEPS, closed=course.closed)
    points = curve[:, :3]
    normals = gradient_at(_skin(tissue), points)
    # Thin across the fibres: what of the skin's direction runs along them is left out.
    along = np.gradient(points, axis=0)
    along /= np.linalg.norm(along, axis=1)[:, None]
    normals -= (normals * along).sum(axis=1)[:, None] * along
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    return Tube(points, normals, curve[:, 3], curve[:, 4])


def _skin(tissue: Drawn) -> Field:
    return lambda x, y, z: tissue.skin_and_bone(x, y, z)[0]


def _placed(tissue: Drawn, points: Floats, place: Floats) -> Floats:
    """Course points placed between skin and bone, as their rows describe."""
    depth = np.where(place > 1.0, place, 0.0)
    share = np.where(place > 1.0, 0.0, place)
    moves = place > 0.0

    def level(share: Floats, depth: Floats) -> Callable[[Level, Level, Level], Level]:
        # (1 − f) skin + f bone vanishes at the fraction f of the way: bone is minus a distance.
        def value(x: Level, y: Level, z: Level) -> Level:
            skin, bone = tissue.skin_and_bone(x, y, z)
            return (1.0 - share) * skin + share * bone - depth

        return value

    placed = points.copy()
    field = level(share[moves], depth[moves])
    placed[moves] = to_surface(field, points[moves], fresh=6, rounds=16, longest=4.0)
    return placed
