"""A scene of a block of tissue that uses everything: fixed, joined, sliding, gaps and loads."""

import numpy as np

import cmfsim
from benches.scenes import meshes

NODES, TETS = meshes.box((3, 3, 3), (9.0, 9.0, 6.0), jitter=0.1)
LOW = meshes.nodes_where(NODES[:, 2] == 0.0)
HIGH = meshes.nodes_where(NODES[:, 2] == 6.0)
SIDE = meshes.nodes_where((NODES[:, 0] == 0.0) & (NODES[:, 2] > 0.0) & (NODES[:, 2] < 6.0))


def floor():
    vertices, triangles = meshes.plane(40.0, 2)
    return cmfsim.SurfaceData(vertices, triangles, crease_angle=45.0)


def tissue(kind):
    m = len(TETS)
    rng = np.random.default_rng(0)
    fibre = meshes.unit_vectors(m)
    if kind == "isotropic":
        return cmfsim.TissueData(kind, young=rng.uniform(0.1, 1.0, m), poisson=0.4)
    if kind == "transversely_isotropic":
        return cmfsim.TissueData(
            kind, young_along=0.8, young_across=rng.uniform(0.1, 0.5, m), poisson=0.4, fibre=fibre
        )
    if kind == "stiffness":
        one = cmfsim.Tissue.isotropic(0.3, 0.4).stiffness()[0]
        return cmfsim.TissueData(kind, stiffness=one)
    return cmfsim.TissueData(
        "preset",
        preset="kim2010-swapped",
        fraction=rng.uniform(0, 1, m),
        fibre=fibre,
        mixing="stiffness",
    )


def scene(kind="isotropic", **changes):
    """A scene that uses everything: fixed, joined, sliding, gaps, loads, a moved surface."""
    contact = floor()
    values = {
        "nodes": NODES,
        "tets": TETS,
        "tissue": tissue(kind),
        "fixed": SIDE,
        "segments": {
            "bone \x1b[31m/..": cmfsim.SegmentData(joined=HIGH),
            "floor": cmfsim.SegmentData(sliding=LOW, contact=contact, gap=np.full(len(LOW), 0.1)),
        },
        "plan": {
            "bone \x1b[31m/..": np.tile([0.2, 0.1, -0.2], (len(HIGH), 1)),
            "floor": cmfsim.MovedSurface(contact, np.asarray(contact.vertices) + [0.1, 0, 0.05]),
        },
        "loads": np.random.default_rng(1).normal(0, 1e-3, NODES.shape),
        "options": cmfsim.SolverOptions(method="cholesky", contact_iterations=80),
    }
    return cmfsim.Scene(**(values | changes))
