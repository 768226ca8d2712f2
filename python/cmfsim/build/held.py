"""Which bodies of a mesh are held, and the mesh without those that are not."""

from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim._core import TetMesh
from cmfsim.case import Finding, NodeKinds
from cmfsim.errors import MeshInputError

__all__ = ["held_part"]

# Held nodes that a body needs: three hold it unless they are in line.
LEAST_HELD = 3


def held_part(mesh: TetMesh, kinds: NodeKinds) -> tuple[TetMesh, NodeKinds, tuple[Finding, ...]]:
    """The mesh without bodies that neither bone nor plane holds, and a finding for them.

    Raises
    ------
    MeshError
        (also `ValueError`) Nothing of it is held.
    """
    tets = np.asarray(mesh.tets)
    n_bodies, body = _bodies(tets, mesh.n_nodes)
    held = np.bincount(body[np.isin(kinds.kind, (1, 2))], minlength=n_bodies)
    loose = held < LEAST_HELD
    if not loose.any():
        return mesh, kinds, ()
    if loose.all():
        raise MeshInputError(
            "no part of the tissue is held: no node lies on the posterior plane or on a bone; "
            "check that bones and skin are in one frame, and the posterior plane"
        )
    keep_tet = ~loose[body[tets[:, 0]]]
    keep_node = ~loose[body]
    number = np.cumsum(keep_node) - 1
    kept = TetMesh(np.asarray(mesh.nodes)[keep_node], number[tets[keep_tet]])
    volume = float(np.asarray(mesh.volumes)[~keep_tet].sum())
    place = np.asarray(mesh.nodes)[~keep_node].mean(axis=0)
    finding = Finding(
        "warning",
        "tissue-not-held",
        f"{int(loose.sum())} bodies of tissue of {volume:.0f} mm³ in all touch no bone and were "
        "left out",
        f"mesh, about ({place[0]:.0f}, {place[1]:.0f}, {place[2]:.0f}) mm",
        "nothing says where they would go",
        "check skin and bone near there; a larger bone threshold or closing may have parted them",
    )
    parted = NodeKinds(kinds.kind[keep_node], kinds.segment[keep_node], kinds.segments)
    return kept, parted, (finding,)


def _bodies(tets: NDArray[Any], n_nodes: int) -> tuple[int, NDArray[np.int32]]:
    """Number of bodies, and the body of each node."""
    sparse = import_module("scipy.sparse")
    rows = np.repeat(tets[:, 0], 3)
    columns = tets[:, 1:].reshape(-1)
    ones = np.ones(len(rows), dtype=bool)
    graph = sparse.coo_matrix((ones, (rows, columns)), shape=(n_nodes, n_nodes))
    count, body = import_module("scipy.sparse.csgraph").connected_components(graph, directed=False)
    return int(count), body
