"""The constrained bodies of a mesh, and the mesh without the others."""

import numpy as np

from cmfsim._core import TetMesh
from cmfsim.errors import MeshInputError
from cmfsim.surfaces.topology import tet_bodies
from cmfsim.values.finding import Finding
from cmfsim.values.node_kinds import NodeKinds
from cmfsim.values.surface_data import used_nodes

# Held nodes that a body needs: three hold it unless they are in line.
LEAST_HELD = 3
# What is left out below this volume nobody will miss, mm³.
SPECKS = 100.0


def held_part(mesh: TetMesh, kinds: NodeKinds) -> tuple[TetMesh, NodeKinds, tuple[Finding, ...]]:
    """The mesh without bodies that neither bone nor plane holds, and a finding for them.

    A body hangs together by the faces of its tets: what an edge or a node joins to the rest swings
    about it.

    Raises `MeshError`: Nothing of it is held.
    """
    tets = mesh.tets
    body = tet_bodies(tets)
    n_bodies = int(body.max(initial=-1)) + 1
    holds = np.isin(kinds.kind, (1, 2))
    corner = holds[tets]
    # Each held node once for each body that it is in.
    held = np.unique(np.repeat(body, 4)[corner.ravel()] * mesh.n_nodes + tets[corner])
    loose = np.bincount(held // mesh.n_nodes, minlength=n_bodies) < LEAST_HELD
    if not loose.any():
        return mesh, kinds, ()
    if loose.all():
        raise MeshInputError(
            "the tissue is not attached anywhere: no node is on the posterior plane or on a "
            "bone; check that bones and skin are in one frame, and check the posterior plane"
        )
    dropped = loose[body]
    used, left = used_nodes(tets[~dropped])
    kept = TetMesh(mesh.nodes[used], left)
    volume = float(mesh.volumes[dropped].sum())
    place = mesh.nodes[tets[dropped]].reshape(-1, 3).mean(axis=0)
    speck = volume < SPECKS
    finding = Finding(
        "tissue-not-held",
        f"{int(loose.sum())} bodies of tissue of {volume:.3g} mm³ in total touch no bone "
        "and were removed",
        severity="note" if speck else "warning",
        where=f"mesh, about ({place[0]:.0f}, {place[1]:.0f}, {place[2]:.0f}) mm",
        fix="nothing to do: they are specks outside the face"
        if speck
        else "check skin and bone nearby; a larger bone threshold or closing may have cut them off",
    )
    return kept, kinds.of_nodes(used), (finding,)
