"""A mesh as a file has it: points, cells by type, and values on both; checked whoever read it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding

# Largest coordinate, whatever its unit: a head in µm has 1e6. Far larger ones overflow in areas and
# volumes.
MAX_COORDINATE = 1e9

# Corners of a cell of each type that has straight edges.
CELL_CORNERS = {
    "vertex": 1, "line": 2, "triangle": 3, "quad": 4, "tetra": 4, "pyramid": 5, "wedge": 6,
    "hexahedron": 8,
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells of one type.

    type: "triangle", "tetra", ….
    data: (m, k) int64. Indices of points, from 0 on.
    """

    type: str
    data: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class PlainMesh:
    """Points and cells of a file.

    points: (n, 3).
    point_data: mapping of str to (n, …) array.
    cell_data: mapping of str to tuple of (m, …) array. One array for each entry of `cells`.
    frame: "LPS" or "RAS" where the file's header states it.
    findings: What was ignored on reading, although the file states it.
    Raises `CaseError`: A point that is not finite, a cell that names a point that is not there, an
        array of another length.
    """

    points: Floats
    cells: tuple[Cells, ...]
    point_data: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    cell_data: Mapping[str, tuple[NDArray[Any], ...]] = field(default_factory=dict)
    frame: str | None = None
    findings: tuple[Finding, ...] = ()

    def __post_init__(self) -> None:
        points = self.points
        if points.ndim != 2 or points.shape[1] != 3:
            raise CaseInputError(f"has points of shape {points.shape}: (n, 3) is needed")
        if not np.isfinite(points).all():
            row = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
            raise CaseInputError(f"point {row} is not finite: every coordinate must be finite")
        if points.size and float(np.abs(points).max()) > MAX_COORDINATE:
            bad, axis = np.argwhere(np.abs(points) > MAX_COORDINATE)[0]
            raise CaseInputError(
                f"point {bad} has the coordinate {points[bad, axis]:g}: at most {MAX_COORDINATE:g} "
                "is read, in any unit; is the file damaged?"
            )
        for block in self.cells:
            _check_block(block, len(points))
        for name, array in self.point_data.items():
            if len(array) != len(points):
                raise CaseInputError(
                    f"point data {name!r} has {len(array)} rows for {len(points)} points"
                )
        for name, arrays in self.cell_data.items():
            rows = [len(a) for a in arrays]
            needed = [len(block.data) for block in self.cells]
            if rows != needed:
                raise CaseInputError(f"cell data {name!r} has {rows} rows for {needed} cells")

    @property
    def cells_dict(self) -> dict[str, NDArray[np.int64]]:
        """All cells of each type."""
        types = dict.fromkeys(block.type for block in self.cells)
        return {
            t: np.concatenate([block.data for block in self.cells if block.type == t])
            for t in types
        }

    @property
    def found(self) -> str:
        """The types of cells that there are, as errors name them."""
        return ", ".join(sorted({block.type for block in self.cells if len(block.data)})) or (
            "nothing"
        )


def _check_block(block: Cells, count: int) -> None:
    wanted = CELL_CORNERS.get(block.type)
    if block.data.ndim != 2 or (wanted is not None and block.data.shape[1] != wanted):
        raise CaseInputError(f"has cells {block.type!r} of shape {block.data.shape}")
    bad = np.argwhere((block.data < 0) | (block.data >= count))
    if len(bad):
        row, column = bad[0]
        raise CaseInputError(
            f"{block.type} {row} names point {block.data[row, column]}, but there are {count} "
            f"points (allowed {f'0 to {count - 1}' if count else 'none'})"
        )
