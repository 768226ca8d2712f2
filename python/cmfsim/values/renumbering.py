"""Meshes and surfaces after triangles or tets are dropped: the remaining nodes are renumbered."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


def used_nodes(cells: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The nodes that triangles or tets use, ascending, and the same cells in those numbers.

    cells: (c, 3) or (c, 4) unsigned or signed integers. Nodes, or vertices of a surface; none is
        negative.
    Returns `nodes`: (k,) int64. Rows to keep of whatever is stored by node.
    Returns `cells`: as `cells`, int64. Indices into `nodes`.

    Examples
    --------
    >>> import numpy as np
    >>> from cmfsim.values.renumbering import used_nodes
    >>> nodes, triangles = used_nodes(np.array([[7, 2, 4], [4, 2, 9]]))
    >>> nodes.tolist(), triangles.tolist()
    ([2, 4, 7, 9], [[2, 0, 1], [1, 0, 3]])
    """
    used = np.zeros(int(cells.max(initial=0)) + 1, dtype=bool)
    used[cells] = True
    number = np.cumsum(used, dtype=np.int64) - 1
    return np.flatnonzero(used).astype(np.int64), number[cells]
