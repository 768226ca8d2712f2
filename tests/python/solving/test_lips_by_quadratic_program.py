"""Lips in contact against a quadratic program that others solve, to eight digits.

At the solution, the normals that it reports and the closest points, computed here, make the gaps
linear in the displacements u. The program min ½ uᵀKu, all gaps ≥ 0, has its stiffness K from
scikit-fem and its forces λ ≥ 0 from SciPy's non-negative least squares: with the flexibility
S = G K⁻¹ Gᵀ and the gaps b without contact, they minimise ½ λᵀSλ + λᵀb.
"""

import numpy as np
import scipy.linalg
import scipy.optimize
import scipy.sparse.linalg

import cmfsim
from benches.scenes import meshes
from benches.scenes.independent import stiffness

# Half width and height of each lip, mm; radius of the underside of the upper one.
WIDTH, HEIGHT, RADIUS = 4.0, 3.0, 60.0
YOUNG, POISSON = (0.003, 0.012), 0.4
# The jaw presses, shears and tilts.
PLAN = cmfsim.rigid_motion((0.02, 0.01, -0.12), 2.0, (0.3, 1.0, 0.2), (0.0, 0.0, 2.0 * HEIGHT))


class Lips:
    """Two lips whose meshes do not match: 8 x 8 cells below, 7 x 7 above."""

    def __init__(self):
        size = (2.0 * WIDTH, 2.0 * WIDTH, HEIGHT)
        (lower, low_tets), (flat, up_tets) = (meshes.box((n, n, 3), size) for n in (8, 7))
        upper = flat + [-WIDTH, -WIDTH, HEIGHT]
        away = (upper[:, :2] ** 2).sum(axis=1) / (2.0 * RADIUS)
        upper[:, 2] += away * (1.0 - flat[:, 2] / HEIGHT)
        first = len(lower)
        self.nodes = np.vstack([lower - [WIDTH, WIDTH, 0.0], upper])
        self.tets = np.vstack([low_tets, up_tets + first])
        self.young = np.repeat(YOUNG, (len(low_tets), len(up_tets)))
        self.base = np.flatnonzero(lower[:, 2] == 0.0)
        self.lid = first + np.flatnonzero(flat[:, 2] == HEIGHT)
        below = np.flatnonzero(lower[:, 2] == HEIGHT)
        above = first + np.flatnonzero(flat[:, 2] == 0.0)
        self.mesh = cmfsim.TetMesh(self.nodes, self.tets)
        faces = self.mesh.boundary_triangles()
        upwards, downwards = (faces[np.isin(faces, nodes).all(axis=1)] for nodes in (below, above))
        self.pairs = [(above, upwards), (below, downwards)]
        tissue = cmfsim.Tissue.isotropic(self.young, POISSON)
        self.tensors = cmfsim.MassTensors(self.mesh, tissue)

    def solve(self):
        """Lips under the plan, far more exactly than a face needs."""
        boundary = cmfsim.Boundary(fixed=self.base, joined={"lid": self.lid}, touching=self.pairs)
        solver = cmfsim.StaticSolver(
            self.tensors, boundary, method="pcg", tolerance=1e-11, contact_tolerance=1e-12
        )
        return solver.solve({"lid": PLAN})

    def gaps(self, found):
        """Derivatives of the gap of each node that the solution reports, (k, 3 n)."""
        places = self.nodes + found.displacements
        rows = np.zeros((len(found.touching_nodes), len(places), 3))
        met = zip(rows, found.touching_nodes, found.touching_normals, strict=True)
        for row, node, normal in met:
            facing = next(faces for nodes, faces in self.pairs if node in nodes)
            corners, weights = closest(places[node], places, facing)
            row[node] = normal
            row[corners] -= weights[:, None] * normal
        return rows.reshape(len(rows), -1)


def closest(point, places, triangles):
    """Corners of the triangle over or under a point, and the weights of its foot there."""
    a, b, c = (places[triangles[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    parts = [np.cross(c - b, point - b), np.cross(a - c, point - c), np.cross(b - a, point - a)]
    weights = np.einsum("kti,ti->tk", np.stack(parts), normal) / (normal**2).sum(axis=1)[:, None]
    # Their magnitudes add up to 1 inside, and to more outside.
    best = np.abs(weights).sum(axis=1).argmin()
    return triangles[best], weights[best]


def program(lips, gaps, prescribed):
    """Displacements and forces at the optimum, given the displacements of base and lid."""
    matrix = stiffness(lips.mesh, lips.tensors, lips.young, np.full(len(lips.tets), POISSON))
    held = (3 * np.concatenate([lips.base, lips.lid])[:, None] + np.arange(3)).ravel()
    free = np.setdiff1d(np.arange(matrix.shape[0]), held)
    u = np.zeros(matrix.shape[0])
    u[held] = prescribed.ravel()[held]
    factor = scipy.sparse.linalg.splu(matrix[free][:, free].tocsc())
    u[free] = factor.solve(-(matrix @ u)[free])
    moves = factor.solve(np.ascontiguousarray(gaps[:, free].T))
    root = scipy.linalg.cholesky(gaps[:, free] @ moves, lower=True)
    open_by = gaps @ (lips.nodes.ravel() + u)
    # ½ λᵀSλ + λᵀb is ½ |Lᵀλ + L⁻¹b|² but for a constant.
    goal = -scipy.linalg.solve_triangular(root, open_by, lower=True)
    forces, _ = scipy.optimize.nnls(root.T, goal)
    u[free] += moves @ forces
    return u.reshape(-1, 3), forces


def test_lips_in_contact_solve_the_quadratic_program():
    lips = Lips()
    found = lips.solve()
    assert found.touching_converged
    gaps = lips.gaps(found)
    expected, forces = program(lips, gaps, found.displacements)
    own = np.asarray(found.touching_forces)
    # Nodes of both lips are in the program, and a fifth of them press.
    reported = np.asarray(found.touching_nodes)
    assert all(np.isin(nodes, reported).any() for nodes, _ in lips.pairs)
    assert 0.1 < np.count_nonzero(forces) / len(forces) < 0.4
    assert np.array_equal(own > 0.0, forces > 0.0)
    far = np.abs(expected).max()
    assert np.abs(found.displacements - expected).max() < 1e-8 * far
    assert np.abs(own - forces).max() < 1e-8 * forces.max()
