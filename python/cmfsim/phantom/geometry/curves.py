"""Curves, tables and the smooth forms of maximum and step that shapes are drawn with."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.values.checks import Floats

# Values of a level, or coordinates, in float32 on grids and float64 at points.
Level = NDArray[np.floating]


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
    """Points on the Catmull–Rom curve through rows of numbers, `steps` per interval.

    points: (n, k). Places, and what belongs to them (radii), in any unit.
    closed: Whether the curve returns to its first point, which then is not repeated.
    Returns: ((n − 1) steps + 1, k), closed curves (n steps + 1, k).
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


def turn_about(axis: str, degrees: float) -> Floats:
    """Rows are the axes of something turned about a coordinate axis by the right-hand rule."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    rows = {
        "x": [[1, 0, 0], [0, c, s], [0, -s, c]],
        "y": [[c, 0, -s], [0, 1, 0], [s, 0, c]],
        "z": [[c, s, 0], [-s, c, 0], [0, 0, 1]],
    }
    return np.array(rows[axis], dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Table:
    """A smooth function of one coordinate through rounded table values.

    places, values: (n,). Ascending places, mm.
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
