"""How deep surfaces lie behind planes of a head's frame: images of a skull from front and side."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import third_party
from cmfsim.values.checks import Floats

# Edge of a cell, mm.
STEP = 0.75


@dataclass(frozen=True, eq=False)
class DepthMap:
    """The first coordinate that a ray meets, over the two others.

    low: (2,), mm. Centre of the first cell.
    values: (n, k), mm. Signed coordinate along the view, the nearest is the least; NaN where a ray
        meets nothing.
    """

    low: Floats
    values: Floats

    @property
    def rows(self) -> Floats:
        """The first coordinate of the cells, (n,) mm."""
        rows: Floats = self.low[0] + STEP * np.arange(self.values.shape[0])
        return rows

    @property
    def columns(self) -> Floats:
        """The second coordinate of the cells, (k,) mm."""
        columns: Floats = self.low[1] + STEP * np.arange(self.values.shape[1])
        return columns

    def at(self, u: float, v: float) -> float:
        """The value of the cell at a place; NaN outside."""
        i, j = round((u - self.low[0]) / STEP), round((v - self.low[1]) / STEP)
        n, k = self.values.shape
        return float(self.values[i, j]) if 0 <= i < n and 0 <= j < k else np.nan

    def column(self, u: float, half: float = 1.2) -> Floats:
        """The values along the second coordinate at a place of the first, (k,): medians."""
        return _medians(self.values[np.abs(self.rows - u) <= half], 0)

    def window(
        self, u: tuple[float, float], v: tuple[float, float]
    ) -> tuple[Floats, Floats, Floats]:
        """First and second coordinate and value of the cells of a window that have one, (n,)."""
        rows = (self.rows >= u[0]) & (self.rows <= u[1])
        columns = (self.columns >= v[0]) & (self.columns <= v[1])
        values = self.values[np.ix_(rows, columns)]
        first, second = np.meshgrid(self.rows[rows], self.columns[columns], indexing="ij")
        known = np.isfinite(values)
        return first[known], second[known], values[known]


def _medians(values: Floats, axis: int) -> Floats:
    found = np.full(values.shape[1 - axis], np.nan)
    known = np.isfinite(values).any(axis=axis)
    taken = values[:, known] if axis == 0 else values[known]
    found[known] = np.nanmedian(taken, axis=axis)
    return found


def depth_map(
    points: Floats,
    view: tuple[int, int, int],
    sign: float,
    reach: tuple[float, float, float, float],
) -> DepthMap:
    """The depth map of points that lie densely on a surface.

    points: (n, 3), mm.
    view: three of 0, 1, 2. The axes of the map's rows and columns, and the axis that is looked
        along.
    sign: 1 looks along the axis, −1 against it.
    reach: mm. First and last place of the rows, then of the columns.
    """
    low = np.array([reach[0], reach[2]])
    shape = (int((reach[1] - reach[0]) / STEP) + 1, int((reach[3] - reach[2]) / STEP) + 1)
    i = np.round((points[:, view[0]] - low[0]) / STEP).astype(np.int64)
    j = np.round((points[:, view[1]] - low[1]) / STEP).astype(np.int64)
    inside = (i >= 0) & (j >= 0) & (i < shape[0]) & (j < shape[1])
    values = np.full(shape, np.inf)
    # One number for each cell is looked up faster than two.
    cells = i[inside] * shape[1] + j[inside]
    np.minimum.at(values.reshape(-1), cells, sign * points[inside, view[2]])
    return DepthMap(low, _filled(values))


def _filled(values: Floats) -> Floats:
    """Cells that the points missed, and those that saw through to what lies behind, closed."""
    ndimage = third_party("scipy.ndimage", "landmarks are proposed", "imaging")
    # A closing of one cell: pits of single cells are gaps between points.
    eroded = ndimage.grey_opening(values, size=(3, 3))
    known: NDArray[np.bool_] = np.isfinite(eroded)
    return np.where(known, eroded, np.nan)
