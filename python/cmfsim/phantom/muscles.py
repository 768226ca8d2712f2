"""The muscles of one person: straps along their courses, with the true fibre directions.

Courses are those of the left side. Each fibre line is a list of rows x, y, z, place, half
thickness, half width, in mm of the drawn head. Place says how the point is put into the tissue of
the person at hand: up to 1 it is the fraction of the way from skin to bone (1: attached to bone),
above 1 the depth below the skin in mm, and 0 leaves the point where it is. Origins come first.
Courses after the usual textbooks of anatomy (Gray 1918; Netter); lengths and widths are round
figures of adults.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from cmfsim.phantom.grid import Field, gradient_at, to_surface
from cmfsim.phantom.parameters import FaceWarp, JawWarp
from cmfsim.phantom.shapes import REACH, Box, Level, Tube, smooth_curve, smooth_max
from cmfsim.values.checks import Floats, as_rows, frozen

Row = tuple[float, float, float, float, float, float]


class Course(NamedTuple):
    """How one muscle runs: kind, fibre lines, whether there are two, whether the lines close."""

    kind: str
    lines: tuple[tuple[Row, ...], ...]
    paired: bool = True
    closed: bool = False


def _ring(
    x: float, z: float, half_x: float, half_z: float, *, place: float, thick: float, wide: float
) -> tuple[Row, ...]:
    """Rows about an eye, from the inner corner over the upper lid."""
    turns = (
        (-1, 0), (-0.71, 0.71), (0, 1), (0.71, 0.71), (1, 0), (0.71, -0.71), (0, -1),
        (-0.71, -0.71),
    )  # fmt: skip
    # The face falls back by 0.45 mm per mm towards the temple here.
    return tuple(
        (x + half_x * a, -84.0 + 0.45 * (half_x * a + 4.0), z + half_z * b, place, thick, wide)
        for a, b in turns
    )


COURSES = MappingProxyType({
    "masseter": Course("strap", (
        ((52, -61, -7, 1, 3.0, 6), (54, -52, -28, 0.62, 4.0, 7), (49, -40, -57, 0.95, 3.0, 6)),
        ((57, -53, -5, 1, 3.0, 6), (56, -43, -28, 0.62, 4.5, 7), (49, -31, -56, 0.95, 3.0, 7)),
        ((61, -42, -3, 1, 3.0, 6), (57, -34, -26, 0.62, 4.5, 7), (50, -23, -48, 0.95, 3.0, 7)),
    )),
    "temporalis": Course("fan", (
        ((52, -54, 60, 0.9, 1.6, 11), (56, -50, 40, 0.75, 2.8, 11), (56, -42, 14, 0, 3.4, 7),
         (48, -36, -6, 0, 2.0, 3)),
        ((60, -36, 74, 0.9, 1.6, 12), (62, -36, 48, 0.75, 2.8, 11), (57, -38, 14, 0, 3.4, 7),
         (48, -36, -6, 0, 2.0, 3)),
        ((66, -14, 78, 0.9, 1.6, 13), (66, -20, 50, 0.75, 2.8, 11), (57.5, -34, 14, 0, 3.4, 7),
         (48, -35, -6, 0, 2.0, 3)),
        ((69, 8, 72, 0.9, 1.6, 13), (68, -6, 42, 0.75, 2.8, 11), (57.5, -30, 13, 0, 3.4, 7),
         (48, -34, -6, 0, 2.0, 3)),
        ((70, 22, 54, 0.9, 1.6, 13), (68, 2, 32, 0.75, 2.8, 11), (57.5, -26, 12, 0, 3.4, 7),
         (48, -34, -6, 0, 2.0, 3)),
    )),
    "medial_pterygoid": Course("strap", (
        ((23, -40, -14, 0, 2.5, 6), (29, -34, -33, 0, 3.5, 7), (36, -29, -52, 0, 2.5, 7)),
        ((23, -35, -12, 0, 2.5, 6), (29, -29, -30, 0, 3.5, 7), (36, -23, -48, 0, 2.5, 7)),
    )),
    "buccinator": Course("sheet", (
        ((32, -50, -29, 0.95, 1.0, 4), (37, -64, -34, 0.85, 1.3, 5), (33, -75, -40, 0.8, 1.3, 4),
         (28.5, -83, -43, 0.6, 1.2, 2)),
        ((35, -44, -43, 0.9, 1.0, 5), (37, -62, -45, 0.85, 1.3, 5), (33, -75, -45, 0.8, 1.3, 4),
         (28.5, -83, -45, 0.6, 1.2, 2)),
        ((34, -50, -56, 0.95, 1.0, 4), (36, -64, -54, 0.85, 1.3, 5), (33, -75, -49, 0.8, 1.3, 4),
         (28.5, -83, -46.5, 0.6, 1.2, 2)),
    )),
    "orbicularis_oris": Course("ring", (
        ((0, -103, -32.5, 0.45, 1.5, 3.6), (10, -101, -33.2, 0.45, 1.5, 3.6),
         (20, -94, -36.5, 0.45, 1.5, 3.4), (27, -87, -45, 0.5, 1.5, 2.6),
         (21, -91, -53, 0.45, 1.5, 3.4), (11, -96, -56.5, 0.45, 1.5, 3.6),
         (0, -98, -57.2, 0.45, 1.5, 3.6)),
        ((0, -101, -39.5, 0.38, 1.5, 3.2), (9, -99, -39.6, 0.38, 1.5, 3.2),
         (18, -93, -41.6, 0.4, 1.5, 2.6), (23.5, -88, -45, 0.5, 1.5, 2.2),
         (17, -93, -48.8, 0.4, 1.5, 2.6), (9, -97, -50.6, 0.38, 1.5, 3.2),
         (0, -99, -51, 0.38, 1.5, 3.2)),
    ), paired=False),
    "orbicularis_oculi": Course("ring", (
        _ring(32, 18, 14.5, 8.5, place=2.0, thick=0.8, wide=3.0),
        _ring(32.5, 18, 19, 14, place=2.4, thick=0.9, wide=3.2),
        _ring(33, 18, 23, 19.5, place=2.6, thick=0.9, wide=3.4),
    ), closed=True),
    "zygomaticus_major": Course("strap", (
        ((50, -66, -8, 1, 1.6, 3.4), (42, -75, -23, 0.4, 1.7, 3.2),
         (29.5, -84, -43, 0.45, 1.5, 2.4)),
    )),
    "zygomaticus_minor": Course("strap", (
        ((42, -72, -5, 1, 1.2, 2.4), (33, -82, -18, 0.4, 1.3, 2.4), (20, -94, -34, 0.35, 1.2, 2.2)),
    )),
    "levator_labii_superioris": Course("strap", (
        ((29, -77, 0, 1, 1.2, 5.0), (24, -84, -14, 0.6, 1.3, 4.4), (15, -97, -33, 0.4, 1.2, 3.4)),
    )),
    "levator_labii_alaeque_nasi": Course("strap", (
        ((9.5, -87, 16, 1, 1.0, 2.0), (14, -88, 2, 0.6, 1.1, 2.2), (19, -90, -14, 0.45, 1.1, 2.4),
         (11, -99, -32, 0.35, 1.0, 2.4)),
    )),
    "levator_anguli_oris": Course("strap", (
        ((25, -77, -13, 1, 1.3, 4.2), (28, -80, -28, 0.75, 1.5, 3.6),
         (28.5, -84, -42, 0.6, 1.3, 2.4)),
    )),
    "depressor_anguli_oris": Course("fan", (
        ((23, -76, -75, 0.9, 1.2, 4.0), (27, -81, -60, 0.4, 1.4, 3.4),
         (28.5, -84, -47, 0.4, 1.3, 2.0)),
        ((31, -68, -70, 0.9, 1.2, 4.0), (30, -78, -58, 0.4, 1.4, 3.4),
         (29, -83.5, -47, 0.4, 1.3, 2.0)),
    )),
    "depressor_labii_inferioris": Course("strap", (
        ((19, -80, -75, 0.95, 1.2, 4.4), (15, -89, -64, 0.6, 1.4, 4.4),
         (9, -97, -54, 0.5, 1.2, 4.0)),
    )),
    "mentalis": Course("strap", (
        ((5, -87, -62, 1, 2.4, 3.2), (6, -92, -72, 0.5, 2.8, 3.6), (6.5, -97, -78, 0.2, 2.0, 3.6)),
    )),
    "risorius": Course("strap", (
        ((53, -54, -41, 0.3, 0.9, 4.6), (42, -70, -45, 0.35, 1.0, 4.0),
         (29.5, -84, -45.5, 0.4, 1.0, 2.4)),
    )),
    "platysma": Course("sheet", (
        ((12, -28, -116, 3, 1.0, 9), (13, -32, -98, 3, 1.0, 9), (14, -38, -84, 3, 1.0, 9),
         (16, -48, -79, 3, 1.0, 9), (20, -68, -83, 3, 1.0, 8), (24, -84, -72, 3, 1.0, 6)),
        ((26, -24, -116, 3, 1.0, 9), (26, -26, -97, 3, 1.0, 9), (27, -31, -82, 3, 1.0, 9),
         (30, -41, -75, 3, 1.0, 9), (35, -60, -76, 3, 1.0, 8), (33, -76, -62, 3, 1.0, 6)),
        ((38, -14, -116, 3, 1.0, 9), (37, -17, -95, 3, 1.0, 9), (38, -22, -80, 3, 1.0, 9),
         (43, -30, -70, 3, 1.0, 9), (49, -44, -68, 3, 1.0, 8), (42, -68, -55, 3, 1.0, 6)),
        ((47, 2, -116, 3, 1.0, 9), (46, -3, -95, 3, 1.0, 9), (46, -8, -80, 3, 1.0, 9),
         (50, -17, -68, 3, 1.0, 9), (57, -28, -62, 3, 1.0, 8), (50, -58, -50, 3, 1.0, 6)),
    )),
    "frontalis": Course("sheet", (
        ((8, -82, 92, 0.5, 1.2, 10), (8, -93, 70, 0.5, 1.3, 10), (8, -96, 47, 0.45, 1.2, 9)),
        ((20, -79, 92, 0.5, 1.2, 10), (20, -90, 70, 0.5, 1.3, 10), (20, -95, 47, 0.45, 1.2, 9)),
        ((32, -73, 90, 0.5, 1.2, 10), (33, -83, 68, 0.5, 1.3, 10), (33, -89, 46, 0.45, 1.2, 9)),
        ((43, -65, 84, 0.5, 1.2, 8), (45, -74, 64, 0.5, 1.2, 9), (46, -79, 44, 0.45, 1.2, 8)),
    )),
    "procerus": Course("strap", (
        ((0, -101, 12, 0.6, 0.9, 3.6), (0, -95, 28, 0.55, 1.1, 4.0), (0, -97, 47, 0.4, 1.0, 4.6)),
    ), paired=False),
    "nasalis": Course("strap", (
        ((15, -86, -17, 0.95, 1.0, 2.6), (14, -93, -5, 0.5, 1.1, 3.4), (8.5, -99, 3, 0.5, 1.0, 3.6),
         (0.5, -107, 6, 0.5, 0.9, 3.6)),
    )),
    "corrugator": Course("strap", (
        ((6, -94, 41, 0.95, 1.2, 2.2), (17, -93, 44, 0.65, 1.3, 2.4), (30, -87, 48, 0.4, 0.9, 2.4)),
    )),
})  # fmt: skip


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


class Tissue(Protocol):
    """What muscles must know of the head that they lie in."""

    @property
    def warp(self) -> FaceWarp:
        """From the person's space to the symmetric head."""

    def skin_and_bone(self, x: Level, y: Level, z: Level) -> tuple[Level, Level]:
        """The levels of the skin, and of all bones and teeth, in the symmetric head."""


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
    tissue: Tissue = field(repr=False)

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


def make_muscles(tissue: Tissue) -> Mapping[str, Muscle]:
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


def _dense(line: tuple[Row, ...], course: Course) -> Floats:
    """More rows, where all lie superficially: a sheet must follow the skin between them."""
    rows = np.array(line, dtype=np.float64)
    if course.kind != "sheet" and not (rows[:, 3] > 1.0).all():
        return rows
    dense = smooth_curve(rows, DENSE_STEPS, closed=course.closed)
    return dense[:-1] if course.closed else dense


def _line(tissue: Tissue, tube: Tube, side: str, course: Course) -> Floats:
    """A fibre line in the person's space."""
    points = tube.points
    mirror = points * np.array([-1.0, 1.0, 1.0])
    if side == "R":
        points = mirror
    elif side == "both" and course.kind == "ring":
        # The left half runs from the upper to the lower midline, the right half back again.
        points = np.vstack([points, mirror[-2::-1]])
    return frozen(tissue.warp.forward(points))


def _strap(tissue: Tissue, rows: Floats, course: Course) -> Tube:
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


def _skin(tissue: Tissue) -> Field:
    return lambda x, y, z: tissue.skin_and_bone(x, y, z)[0]


def _placed(tissue: Tissue, points: Floats, place: Floats) -> Floats:
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
