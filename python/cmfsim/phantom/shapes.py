"""Building blocks of anatomy: smooth curves, and levels that are positive inside and melt together.

A level is close to the signed distance in mm near its surface. Coordinates come as three arrays
that broadcast, so that a grid is evaluated from its axes and what depends on one axis alone is
computed once per line. Shapes further than REACH from the requested box are skipped. They could not
have moved what is near a surface, so that levels there do not depend on which points are asked
together; far outside a level is merely negative.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim import _core
from cmfsim.values.checks import Floats

# Values of a level, or coordinates, in float32 on grids and float64 at points.
Level = NDArray[np.floating]
# Shapes further away than this are left out, mm: twice the widest melt, so that not even a melt of
# melts feels them.
REACH = 24.0
# No section of a loft is larger than this, mm.
LARGEST_RADIUS = 150.0
# The level where no shape is near, mm.
FAR = -REACH
# Smallest length that is divided by, mm.
TINY = 1e-6


def smooth_max(a: Level, b: Level, melt: float) -> Level:
    """The larger level, rounded where they differ by less than `melt` mm; never the smaller.

    The quadratic polynomial h² melt/4 with h = 1 − |a − b|/melt is C¹ and of local support.
    """
    highest: Level = np.maximum(a, b)
    if melt <= 0.0:
        return highest
    h = np.maximum(1.0 - np.abs(a - b) / melt, 0.0)
    return highest + h * h * (0.25 * melt)


def clipped(share: Level) -> Level:
    """The value in [0, 1] closest to a share.

    `np.clip` takes nearly twice as long for the few points of a brick or a ray.
    """
    return np.minimum(np.maximum(share, 0.0), 1.0)


def smooth_step(value: Level | float, start: float, end: float) -> Level:
    """0 up to `start`, 1 from `end` on, C¹ between; `end` may lie below `start`."""
    t = clipped((np.asarray(value) - start) / (end - start))
    return t * t * (3.0 - 2.0 * t)


def smooth_curve(points: ArrayLike, steps: int = 4, *, closed: bool = False) -> Floats:
    """Points on the Catmull–Rom curve through rows of numbers (n, k), `steps` per interval.

    A closed curve returns to its first row, which is not repeated in `points`, but in the result.
    """
    rows = np.asarray(points, dtype=np.float64)
    if closed:
        padded = np.vstack([rows[-1:], rows, rows[:2]])
    else:
        ends = 2.0 * rows[0] - rows[1], 2.0 * rows[-1] - rows[-2]
        padded = np.vstack([ends[0], rows, ends[1]])
    before, start, end, after = padded[:-3], padded[1:-2], padded[2:-1], padded[3:]
    t = (np.arange(steps) / steps)[:, None, None]
    curve = 0.5 * (
        2.0 * start
        + t * (end - before)
        + t**2 * (2.0 * before - 5.0 * start + 4.0 * end - after)
        + t**3 * (3.0 * (start - end) + after - before)
    )
    return np.vstack([curve.transpose(1, 0, 2).reshape(-1, rows.shape[1]), end[-1:]])


def turn_about_z(degrees: float) -> Floats:
    """Rows are the axes of something turned about the z axis by the right-hand rule."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]], dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Table:
    """A smooth function of one coordinate through values (n,) at ascending places, mm.

    rounding: mm. Standard deviation of the Gaussian that rounds the corners.
    """

    places: Sequence[float]
    values: Sequence[float]
    rounding: float = 5.0

    def __post_init__(self) -> None:
        step = 0.5
        margin = 4.0 * self.rounding
        fine = np.arange(self.places[0] - margin, self.places[-1] + margin + step, step)
        width = np.arange(-margin, margin + step, step)
        kernel = np.exp(-0.5 * (width / self.rounding) ** 2)
        raw = np.interp(fine, self.places, self.values)
        reach = len(width) // 2
        padded = np.pad(raw, reach, mode="edge")
        smooth = np.convolve(padded, kernel / kernel.sum(), mode="valid")[: len(fine)]
        object.__setattr__(self, "_fine", (fine, smooth, np.gradient(smooth, step)))

    def _look_up(self, z: Level, column: int) -> Level:
        fine: tuple[Floats, Floats, Floats] = self.__dict__["_fine"]
        found: Level = np.interp(z, fine[0], fine[column])
        return found.astype(z.dtype)

    def at(self, z: Level) -> Level:
        """The value at places."""
        return self._look_up(z, 1)

    def slope(self, z: Level) -> Level:
        """The derivative at places, per mm."""
        return self._look_up(z, 2)


@dataclass(frozen=True)
class Box:
    """An axis-aligned box, mm."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def grown(self, margin: float) -> "Box":
        """The box with a margin on every side."""
        x, y, z = self.low
        u, v, w = self.high
        return Box((x - margin, y - margin, z - margin), (u + margin, v + margin, w + margin))


EVERYWHERE = Box((-np.inf, -np.inf, -np.inf), (np.inf, np.inf, np.inf))


class Shape(Protocol):
    """Something with an inside."""

    @property
    def box(self) -> Box:
        """Where the level can be above 0."""

    def level(self, x: Level, y: Level, z: Level) -> Level:
        """The level at points, positive inside, mm."""


def _root(total: Level, n: Level | float) -> Level:
    """total^(1/n) for totals above 0; log and exp are faster than the power of float32."""
    if isinstance(n, float) and n == 2.0:
        return np.sqrt(total)
    return np.exp(np.log(np.maximum(total, TINY)) / n)


@dataclass(frozen=True, eq=False)
class Egg:
    """A superellipsoid whose radii differ between the lower and the upper side of each axis, mm.

    low, high: (3,). Radii towards smaller and larger coordinates; `high` as `low` where left out.
    power: 2 is an ellipsoid, more is boxier.
    turn: (3, 3) or None. Rows are the egg's own axes.
    """

    centre: Sequence[float]
    low: Sequence[float]
    high: Sequence[float] | None = None
    power: float = 2.0
    turn: Floats | None = None

    @property
    def box(self) -> Box:
        """Where the level can be above 0."""
        c = np.asarray(self.centre)
        high = self.low if self.high is None else self.high
        if self.turn is not None:
            reach = float(max(*self.low, *high)) * (1.8 if self.power > 2.0 else 1.0)
            lows, highs = c - reach, c + reach
        else:
            lows, highs = np.subtract(c, self.low), np.add(c, high)
        return Box(tuple(lows.tolist()), tuple(highs.tolist()))

    def level(self, x: Level, y: Level, z: Level) -> Level:
        """Value over gradient length of the homogeneous form: (1 − g)/|∇g|."""
        parts = [x - self.centre[0], y - self.centre[1], z - self.centre[2]]
        if self.turn is not None:
            u, v, w = parts
            parts = [row[0] * u + row[1] * v + row[2] * w for row in self.turn.tolist()]
        high = self.low if self.high is None else self.high
        n = self.power
        total: Level = np.zeros(1, dtype=x.dtype)
        slope: Level = np.zeros(1, dtype=x.dtype)
        for part, low, up in zip(parts, self.low, high, strict=True):
            radius = low if low == up else np.where(part < 0.0, low, up).astype(x.dtype)
            q = np.abs(part) / radius
            power = q * q if n == 2.0 else q**n
            total = total + power
            slope = slope + (power / np.maximum(q, TINY) / radius) ** 2
        g = _root(total, n)
        # ∇g = g^(1−n) (q^(n−1)/r); near the centre the level stays below the smallest radius.
        slope_length = np.sqrt(slope) * g / np.maximum(total, TINY)
        smallest = float(min(*self.low, *high))
        return np.where(
            g < 0.25, (1.0 - g) * smallest, (1.0 - g) / np.maximum(slope_length, TINY)
        ).astype(x.dtype)


@dataclass(frozen=True, eq=False)
class Reaches:
    """Boxes (n, 3), mm, of many things, grown by how far each matters, to find those near a box."""

    low: Floats
    high: Floats

    @classmethod
    def of_line(cls, points: Floats, radius: Floats) -> "Reaches":
        """The boxes of the segments of a tube."""
        low, high = points - radius[:, None], points + radius[:, None]
        return cls(np.minimum(low[:-1], low[1:]) - REACH, np.maximum(high[:-1], high[1:]) + REACH)

    def near(self, x: Level, y: Level, z: Level) -> list[int]:
        """The things that matter where the points lie."""
        low = np.array([x.min(), y.min(), z.min()])
        high = np.array([x.max(), y.max(), z.max()])
        meets = (self.low <= high) & (self.high >= low)
        return np.flatnonzero(meets.all(axis=1)).tolist()


@dataclass(frozen=True, eq=False)
class Tube:
    """A tube of elliptic or round section along a polyline (n, 3), mm.

    normals: (n, 3). Unit vectors along which the section is thin.
    thick, wide: (n,) mm. Half axes of the section, along the normal and across it.
    """

    points: Floats
    normals: Floats
    thick: Floats
    wide: Floats

    @classmethod
    def round(cls, rows: Floats) -> "Tube":
        """A tube of changing radius: (n, 4) place and radius, mm."""
        upwards = np.tile([0.0, 0.0, 1.0], (len(rows), 1))
        return cls(rows[:, :3], upwards, rows[:, 3], rows[:, 3])

    @cached_property
    def _reach(self) -> Floats:
        return np.maximum(self.thick, self.wide)

    @cached_property
    def _segments(self) -> tuple[Reaches, Floats]:
        """Where each segment matters, and its ends as the core takes them, (n − 1, 2, 8)."""
        ends = np.column_stack([self.points, self.normals, self.thick, self.wide])
        pairs = np.stack([ends[:-1], ends[1:]], axis=1)
        return Reaches.of_line(self.points, self._reach), pairs

    @property
    def box(self) -> Box:
        """Where the level can be above 0."""
        reach = self._reach[:, None]
        return Box(
            tuple((self.points - reach).min(axis=0).tolist()),
            tuple((self.points + reach).max(axis=0).tolist()),
        )

    def level(self, x: Level, y: Level, z: Level) -> Level:
        """The level of the section through the closest point of the polyline."""
        reaches, ends = self._segments
        places = np.stack(np.broadcast_arrays(x, y, z), axis=-1, dtype=np.float64)
        near = ends[reaches.near(x, y, z)]
        levels = _core.tube_levels(places.reshape(-1, 3), near, FAR)
        return levels.reshape(places.shape[:-1]).astype(x.dtype, copy=False)


@dataclass(frozen=True, eq=False)
class Plane:
    """The half-space behind a point (3,), mm, as seen along the outward unit normal (3,)."""

    point: Sequence[float]
    normal: Sequence[float]

    @property
    def box(self) -> Box:
        """Everywhere: a half-space has no end."""
        return EVERYWHERE

    def level(self, x: Level, y: Level, z: Level) -> Level:
        """The distance behind the plane."""
        p, n = self.point, self.normal
        depth: Level = (p[0] - x) * n[0] + (p[1] - y) * n[1] + (p[2] - z) * n[2]
        return depth


@dataclass(frozen=True, eq=False)
class Loft:
    """A body whose horizontal sections are superellipses that change with height.

    middle: mm. y of the widest place of every section.
    front, back, width, power: Of z: y of the foremost and hindmost point, half width, exponent.
    """

    middle: float
    front: Table
    back: Table
    width: Table
    power: Table
    box: Box

    def level(self, x: Level, y: Level, z: Level) -> Level:
        """Value over gradient length of the homogeneous form of the section."""
        n, w = self.power.at(z), self.width.at(z)
        forward = y < self.middle
        f = np.where(forward, self.middle - self.front.at(z), self.back.at(z) - self.middle)
        df = np.where(forward, -self.front.slope(z), self.back.slope(z))
        qx = np.maximum(np.abs(x) / w, TINY)
        qy = np.maximum(np.abs(y - self.middle) / f, TINY)
        px, py = qx**n, qy**n
        total = np.maximum(px + py, TINY)
        g = _root(total, n)
        gx, gy = px / qx / w, py / qy / f
        gz = px * self.width.slope(z) / w + py * df / f
        slope = np.sqrt(gx * gx + gy * gy + gz * gz) * g / total
        # Deep inside, where the form is flat, the level stays below its largest radius.
        level: Level = (1.0 - g) / np.maximum(slope, 1.0 / LARGEST_RADIUS)
        return level.astype(x.dtype, copy=False)


@dataclass(frozen=True, eq=False)
class Engraving:
    """A groove or ridge along a curve (n, 2) of x and z, mm, on the face as seen from in front.

    width: mm. Half width, where the groove ends with no corner.
    depth: (n,) mm. How far the surface moves in; negative moves out.
    behind: mm. y beyond which nothing is engraved.
    """

    curve: Floats
    width: float
    depth: Floats
    behind: float = -40.0

    @property
    def box(self) -> Box:
        """Where something is engraved."""
        (x, z), (u, w) = self.curve.min(axis=0) - self.width, self.curve.max(axis=0) + self.width
        return Box((x, -200.0, z), (u, self.behind, w))

    def shift(self, x: Level, y: Level, z: Level) -> Level:
        """How far the level sinks."""
        near: Level = np.full(np.broadcast_shapes(x.shape, z.shape), np.inf, dtype=x.dtype)
        depth: Level = np.zeros_like(near)
        for i in range(len(self.curve) - 1):
            (ax, az), (bx, bz) = self.curve[i].tolist(), self.curve[i + 1].tolist()
            ux, uz = bx - ax, bz - az
            px, pz = x - ax, z - az
            t = clipped((px * ux + pz * uz) / max(ux * ux + uz * uz, TINY))
            d2 = (px - t * ux) ** 2 + (pz - t * uz) ** 2
            value = self.depth[i] + t * (self.depth[i + 1] - self.depth[i])
            depth = np.where(d2 < near, value, depth)
            near = np.minimum(near, d2)
        bump = np.maximum(1.0 - near / self.width**2, 0.0) ** 2
        fade = smooth_step(y, self.behind, self.behind - 10.0)
        shift: Level = depth * bump * fade
        return shift.astype(x.dtype, copy=False)


@dataclass(frozen=True, eq=False)
class Step:
    """What one shape does to the shapes before it, rounded over `melt` mm.

    how: "join" adds the shape, "cut" takes it away, "meet" keeps what lies in both.
    """

    how: str
    shape: Shape
    melt: float = 0.0


@dataclass(frozen=True, eq=False)
class Within:
    """What of a shape lies at least `depth` mm below the surface of another."""

    shape: Shape
    outer: Shape
    depth: float

    @property
    def box(self) -> Box:
        """Where the level can be above 0."""
        return self.shape.box

    def level(self, x: Level, y: Level, z: Level) -> Level:
        """The lesser of both levels."""
        inside = self.outer.level(x, y, z) - self.depth
        level: Level = np.minimum(self.shape.level(x, y, z), inside)
        return level


@dataclass(frozen=True, eq=False)
class Blend:
    """Shapes joined, cut and engraved one after another."""

    steps: tuple[Step | Engraving, ...]
    box: Box

    @cached_property
    def _reaches(self) -> Reaches:
        """Where each step matters: within REACH of its box."""
        low, high = [], []
        for step in self.steps:
            if isinstance(step, Engraving):
                box, margin = step.box, 0.0
            elif step.how == "meet":
                box, margin = EVERYWHERE, 0.0
            else:
                box, margin = step.shape.box, REACH
            low.append(np.subtract(box.low, margin))
            high.append(np.add(box.high, margin))
        return Reaches(np.array(low), np.array(high))

    def level(self, x: Level, y: Level, z: Level) -> Level:
        """The level after the last step."""
        shape = np.broadcast_shapes(x.shape, y.shape, z.shape)
        value: Level = np.full(shape, FAR, dtype=x.dtype)
        for i in self._reaches.near(x, y, z):
            step = self.steps[i]
            if isinstance(step, Engraving):
                value = value - step.shift(x, y, z)
                continue
            other = step.shape.level(x, y, z)
            if step.how == "join":
                value = smooth_max(value, other, step.melt)
            elif step.how == "cut":
                value = -smooth_max(-value, other, step.melt)
            else:
                value = -smooth_max(-value, -other, step.melt)
        return value.astype(x.dtype, copy=False)
