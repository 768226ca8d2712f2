"""Two soft blocks pressed together, as in Hertz's problem, against contact solved by others.

The reference has its stiffness from scikit-fem and its contact forces from SciPy's non-negative
least squares: with the flexibility S of the nodes that may touch and the gaps b without contact,
forces λ ≥ 0 minimise ½ λᵀSλ + λᵀb (Signorini's problem, dual form).
"""

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
import scipy.sparse.linalg
import skfem
from skfem.models.elasticity import lame_parameters, linear_elasticity

import cmfsim
from benches.scenes import meshes

# Half width and height of each block, mm; radius of the upper one's underside; way of its lid.
WIDTH, HEIGHT, RADIUS, DOWN = 4.0, 3.0, 60.0, 0.06
CELLS = (16, 16, 6)
YOUNG, POISSON = (0.003, 0.012), 0.4


@pytest.fixture(scope="module")
def blocks():
    """Nodes, tets, Young's modulus of each tet, and the nodes of one block."""
    lower, tets = meshes.box(CELLS, (2.0 * WIDTH, 2.0 * WIDTH, HEIGHT))
    lower = lower - [WIDTH, WIDTH, 0.0]
    upper = lower + [0.0, 0.0, HEIGHT]
    # Its underside curves upwards from the middle; its lid is flat.
    away = (lower[:, :2] ** 2).sum(axis=1) / (2.0 * RADIUS)
    upper[:, 2] += away * (1.0 - lower[:, 2] / HEIGHT)
    young = np.repeat(YOUNG, len(tets))
    return np.vstack([lower, upper]), np.vstack([tets, tets + len(lower)]), young, len(lower)


def reference(nodes, tets, young, held, moved, pairs):
    """Displacements and contact forces: up on the first node of each pair, down on the other."""
    mesh = skfem.MeshTet(nodes.T.copy(), tets.T.astype(np.int64))
    basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementTetP1()), intorder=1)
    stiffness = sum(
        linear_elasticity(*lame_parameters(modulus, POISSON)).assemble(
            basis.with_elements(np.flatnonzero(young == modulus))
        )
        for modulus in YOUNG
    ).tocsc()
    u = np.zeros(3 * len(nodes))
    u[3 * moved + 2] = -DOWN
    fixed = (3 * np.concatenate([held, moved])[:, None] + np.arange(3)).ravel()
    free = np.setdiff1d(np.arange(len(u)), fixed)
    factor = scipy.sparse.linalg.splu(stiffness[free][:, free].tocsc())
    u[free] = factor.solve(-(stiffness @ u)[free])
    rows = np.arange(len(pairs))
    gaps = scipy.sparse.coo_array(
        (np.tile([1.0, -1.0], len(pairs)), (np.repeat(rows, 2), (3 * pairs + 2).ravel())),
        shape=(len(pairs), len(u)),
    ).tocsr()[:, free]
    moves = factor.solve(gaps.T.toarray())
    flexibility = gaps @ moves
    open_by = nodes[pairs[:, 0], 2] - nodes[pairs[:, 1], 2] + gaps @ u[free]
    root = scipy.linalg.cholesky(flexibility, lower=True)
    # ½ λᵀSλ + λᵀb is ½ |Lᵀλ + L⁻¹b|² but for a constant.
    forces, _ = scipy.optimize.nnls(
        root.T, -scipy.linalg.solve_triangular(root, open_by, lower=True)
    )
    u[free] += moves @ forces
    return u.reshape(-1, 3), forces


def blocks_in_contact(nodes, tets, young, base, lid, pair):
    """The solver for the blocks: nodes of the underside before the top of the lower block."""
    bottom, top = pair
    mesh = cmfsim.TetMesh(nodes, tets)
    tissue = cmfsim.Tissue.isotropic(young, POISSON)
    faces = mesh.boundary_triangles()
    below = faces[np.isin(faces, top).all(axis=1)]
    boundary = cmfsim.Boundary(fixed=base, joined={"lid": lid}, touching=[(bottom, below)])
    return cmfsim.StaticSolver(cmfsim.MassTensors(mesh, tissue), boundary, method="pcg")


def test_hertz_contact_of_two_soft_blocks(blocks):
    """Force, area of contact, pressure at each node and displacements equal the reference's."""
    nodes, tets, young, first = blocks
    z = nodes[:, 2]
    base, lid = np.flatnonzero(z == 0.0), np.flatnonzero(z > 2.0 * HEIGHT - 1e-9)
    top = np.flatnonzero(z[:first] == HEIGHT)
    bottom = top - top.min() + first
    assert np.array_equal(nodes[top, :2], nodes[bottom, :2])
    expected, forces = reference(nodes, tets, young, base, lid, np.stack([bottom, top], axis=1))
    solver = blocks_in_contact(nodes, tets, young, base, lid, (bottom, top))
    found = solver.solve({"lid": cmfsim.rigid_motion(translation=(0.0, 0.0, -DOWN))})
    assert found.touching_converged
    pressed = np.zeros(len(nodes))
    pressed[np.asarray(found.touching_nodes)] = np.asarray(found.touching_forces)
    assert pressed.sum() == pytest.approx(forces.sum(), rel=3e-3)
    assert np.array_equal(pressed[bottom] > 0.0, forces > 0.0)
    # Normals of deformed facets tilt by up to the strain, 2 %; the reference's stay upright.
    assert np.abs(pressed[bottom] - forces).max() < 0.01 * forces.max()
    assert np.abs(found.displacements - expected).max() < 0.01 * np.abs(expected).max()
    # A fifth of the underside touches: neither a point nor all of it.
    assert 0.1 < np.count_nonzero(forces) / len(forces) < 0.4


def test_blocks_that_part_by_a_nanometre_move_as_exactly_as_by_a_millimetre(blocks):
    """What counts as touching is no measure of the error of a motion that is smaller."""
    nodes, tets, young, first = blocks
    z = nodes[:, 2]
    base, lid = np.flatnonzero(z == 0.0), np.flatnonzero(z > 2.0 * HEIGHT - 1e-9)
    top = np.flatnonzero(z[:first] == HEIGHT)
    pair = (top - top.min() + first, top)
    solver = blocks_in_contact(nodes, tets, young, base, lid, pair)
    # The lid is lifted and widened.
    way = nodes[lid] * [0.05, 0.05, 0.0] + [0.0, 0.0, 1.0]
    small, large = (solver.solve({"lid": share * way}) for share in (1e-6, 1.0))
    assert not np.any(large.touching_forces)
    assert np.abs(1e6 * small.displacements - large.displacements).max() < 1e-4
