"""Cells of VTK's files by type: XML and older ones number them alike."""

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError
from cmfsim.io.meshes.plain_mesh import CELL_CORNERS, Cells

Integers = NDArray[np.int64]
# VTK's numbers (vtkCellType.h); other cells keep their number as their name.
NAMES = {
    1: "vertex", 3: "line", 5: "triangle", 9: "quad", 10: "tetra", 12: "hexahedron", 13: "wedge",
    14: "pyramid", 21: "line3", 22: "triangle6", 24: "tetra10",
}  # fmt: skip


def cells_by_type(
    types: Integers, counts: Integers, corners: Integers
) -> tuple[tuple[Cells, ...], tuple[Integers, ...]]:
    """Cells grouped by type, and the number of each in the file.

    types: (m,) int64.
    counts: (m,) int64. Number of corners of each cell.
    corners: (sum of counts,) int64.
    Raises `CaseError`: A cell with another number of corners than its type has.
    """
    starts = np.cumsum(counts) - counts
    blocks, rows = list[Cells](), list[Integers]()
    for number in dict.fromkeys(types.tolist()):
        name = NAMES.get(number, f"VTK cell {number}")
        of_type = np.flatnonzero(types == number)
        # Polygons and the like differ in their number of corners.
        for size in np.unique(counts[of_type]):
            mine = of_type[counts[of_type] == size]
            wanted = CELL_CORNERS.get(name)
            if wanted is not None and size != wanted:
                raise CaseInputError(
                    f"cell {mine[0]} is a {name} with {size} corners: {wanted} are needed"
                )
            blocks.append(Cells(name, corners[starts[mine][:, None] + np.arange(size)]))
            rows.append(mine)
    return tuple(blocks), tuple(rows)
