"""Tets of any program: oriented, and without those that enclose no volume."""

from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.errors import CaseInputError
from cmfsim.values.checks import Floats, Indices, as_index_rows, as_rows
from cmfsim.values.surface_data import used_nodes

# The limits of `TetMesh`: volume over longest edge cubed, and the longest edge, mm.
DEGENERATE_VOLUME, SHORTEST_EDGE = 1e-12, 1e-9


class RepairedTets(NamedTuple):
    """A mesh whose tets are oriented and enclose a volume.

    Attributes
    ----------
    nodes : (n, 3) float64, mm
    tets : (m, 4) uint32
    kept_nodes, kept_tets : (n,) and (m,) int64
        The number that each had: `values[kept_nodes]` are the values of these nodes.
    n_turned, n_dropped : int
        Tets that were negative, and tets without volume, which are gone.
    """

    nodes: Floats
    tets: Indices
    kept_nodes: NDArray[np.int64]
    kept_tets: NDArray[np.int64]
    n_turned: int
    n_dropped: int


def repair_tets(nodes: ArrayLike, tets: ArrayLike) -> RepairedTets:
    """Tets as `TetMesh` takes them, from those of another program, with the number of changes.

    Negative tets are turned. Tets without volume are dropped, then the nodes that no tet uses.

    Parameters
    ----------
    nodes : (n, 3) float64, mm
    tets : (m, 4) uint32

    Raises
    ------
    CaseError
        (also `ValueError`) An index that is not there, a node that is not finite, no volume.

    Examples
    --------
    >>> import cmfsim
    >>> corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0]]
    >>> found = cmfsim.repair_tets(corners, [[0, 2, 1, 3], [0, 1, 2, 4]])
    >>> found.n_turned, found.n_dropped, len(found.nodes)
    (1, 1, 4)
    """
    places = as_rows("nodes", nodes, 3)
    turned, volumes = oriented(places, as_index_rows("tets", tets, 4, len(places), "nodes"))
    corners = places[turned]
    pairs = combinations(range(4), 2)
    edge = np.max([np.linalg.norm(corners[:, a] - corners[:, b], axis=1) for a, b in pairs], axis=0)
    solid = (np.abs(volumes) > DEGENERATE_VOLUME * edge**3) & (edge >= SHORTEST_EDGE)
    if not solid.any():
        raise CaseInputError(f"none of {len(turned)} tets has a volume")
    used, numbered = used_nodes(turned[solid])
    return RepairedTets(
        places[used],
        numbered.astype(np.uint32),
        used,
        np.flatnonzero(solid),
        int(np.count_nonzero(volumes[solid] < 0.0)),
        int(np.count_nonzero(~solid)),
    )


def oriented(nodes: Floats, tets: Indices) -> tuple[Indices, Floats]:
    """Tets (m, 4) with the negative ones turned, and their volumes before, (m,) mm³.

    Programs differ in the order of nodes: which one a mesh has, its volumes say.
    """
    corners, turned = nodes[tets], tets.copy()
    volumes: Floats = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6.0
    negative = volumes < 0.0
    turned[negative] = turned[negative][:, [0, 1, 3, 2]]
    return turned, volumes
