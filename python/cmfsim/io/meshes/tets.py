"""Tets of any program: oriented, and without those that enclose no volume."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.errors import CaseInputError
from cmfsim.values.checks import Floats, Indices, as_index_rows, as_rows
from cmfsim.values.frozen import Frozen
from cmfsim.values.renumbering import used_nodes

# The limits of `TetMesh`: volume over longest edge cubed, and the longest edge, mm.
DEGENERATE_VOLUME, SHORTEST_EDGE = 1e-12, 1e-9


@dataclass(frozen=True, eq=False)
class RepairedTets(Frozen):
    """A mesh whose tets are oriented and enclose a volume.

    Attributes
    ----------
    nodes : (n, 3) float64, mm
        Those that a tet still uses.
    tets : (m, 4) uint32
        Positively oriented.
    kept_nodes : (n,) int64
        The number that each node had: `values[kept_nodes]` are those of the nodes.
    kept_tets : (m,) int64
        The same of each tet.
    n_turned : int
        Tets that were negatively oriented; two of their nodes changed places.
    n_dropped : int
        Tets without volume, which are gone.
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
    Dropped tets leave no hole as long as they are flat.

    Parameters
    ----------
    nodes : (n, 3) float64, mm
    tets : (m, 4) uint32

    Returns
    -------
    RepairedTets

    Raises
    ------
    CaseError
        (also `ValueError`) An index that is not there, a node that is not finite, no tet with a
        volume.

    Examples
    --------
    >>> import cmfsim
    >>> corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0]]
    >>> found = cmfsim.repair_tets(corners, [[0, 2, 1, 3], [0, 1, 2, 4]])
    >>> found.n_turned, found.n_dropped, len(found.nodes)
    (1, 1, 4)
    >>> float(cmfsim.TetMesh(found.nodes, found.tets).volumes[0])
    0.16666666666666666
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
