"""The true tissue as finite elements: energy and forces by scikit-fem, stiffness in blocks."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cmfsim.errors import CaseInputError, third_party
from cmfsim.lab.virtual.mechanics.hyperelastic import HyperelasticTissue, cofactor
from cmfsim.values.checks import Floats, as_index_rows, as_rows

# Tets whose stiffness is made at a time, so that their blocks (1 kB each) stay in the cache.
TETS_AT_ONCE = 2_000
PAIRS = tuple((p, q) for p in range(4) for q in range(p + 1, 4))


class HyperelasticBody:
    """A mesh with hyperelastic tissue: its energy, internal forces and stiffness.

    Forces come from scikit-fem (Gustafsson & McBain 2020): the equilibrium that the truth satisfies
    is that library's, not the mass tensors'. The stiffness only leads Newton's method there.

    nodes: (n, 3), mm.
    tets: (m, 4) uint32. Positively oriented.
    Raises `CaseError`: Misshapen arrays, a tet without volume, tissue of another number of tets;
        scikit-fem or scipy is not installed.
    """

    def __init__(self, nodes: ArrayLike, tets: ArrayLike, tissue: HyperelasticTissue) -> None:
        points = as_rows("nodes", nodes, 3)
        rows = as_index_rows("tets", tets, 4, len(points), "nodes").astype(np.int64)
        if len(tissue.mu) != len(rows):
            raise CaseInputError(f"tissue of {len(tissue.mu)} tets for a mesh of {len(rows)}")
        self.nodes, self.tets, self.tissue = points, rows, tissue
        skfem = _module("skfem")
        mesh = skfem.MeshTet(
            np.ascontiguousarray(points.T), np.ascontiguousarray(rows.T), sort_t=False
        )
        element = skfem.ElementVector(skfem.ElementTetP1())
        self._basis = skfem.Basis(mesh, element, intorder=1)
        self._assemble = skfem.LinearForm(_virtual_work).assemble
        self.volumes: Floats = self._basis.dx.sum(axis=1)
        edges = points[rows[:, 1:]] - points[rows[:, :1]]
        signed = np.einsum("ti,ti->t", np.cross(edges[:, 0], edges[:, 1]), edges[:, 2]) / 6.0
        bad = np.flatnonzero(~(signed > 0.0))
        if len(bad):
            raise CaseInputError(
                f"tet {bad[0]} has volume {signed[bad[0]]:.3g} mm³: above 0 needed"
            )
        fields = [self._basis.basis[3 * corner][0] for corner in range(4)]
        self.shapes: Floats = np.array([field.grad[0, :, :, 0] for field in fields])
        self._pattern()

    def _pattern(self) -> None:
        """Which blocks the stiffness has, and where each pair of a tet's nodes goes."""
        n = len(self.nodes)
        first = np.concatenate([self.tets[:, p] for p, _ in PAIRS])
        last = np.concatenate([self.tets[:, q] for _, q in PAIRS])
        low, high = np.minimum(first, last), np.maximum(first, last)
        key, self._edge = np.unique(low * n + high, return_inverse=True)
        self._edge = self._edge.reshape(6, -1)
        self._reversed = (first > last).reshape(6, -1)
        self._n_edges = len(key)
        low, high = key // n, key % n
        row = np.concatenate([np.arange(n), low, high])
        column = np.concatenate([np.arange(n), high, low])
        self._order = np.lexsort((column, row))
        self._columns = column[self._order]
        self._rows = row[self._order]
        self._starts = np.searchsorted(self._rows, np.arange(n + 1))

    def deformation(self, displacements: Floats) -> Floats:
        """F of each tet, (3, 3, m)."""
        corners = displacements[self.tets]
        gradient = np.einsum("tai,ajt->ijt", corners, self.shapes)
        for axis in range(3):
            gradient[axis, axis] += 1.0
        return np.ascontiguousarray(gradient)

    def volume_ratios(self, displacements: Floats) -> Floats:
        """Volume after over before of each tet, det F, (m,)."""
        return cofactor(self.deformation(displacements))[1]

    def energy(self, displacements: Floats) -> float:
        """The elastic energy, N·mm."""
        density = self.tissue.energy(self.deformation(displacements))
        return float(density @ self.volumes)

    def forces(self, displacements: Floats) -> Floats:
        """The internal forces, (n, 3) N: the gradient of the energy."""
        stress = self.tissue.stress(self.deformation(displacements))
        assembled: Floats = self._assemble(self._basis, stress=stress[..., None])
        return assembled.reshape(-1, 3)

    def stiffness(
        self, displacements: Floats, added: Floats | None = None, *, convex: bool = False
    ) -> Any:
        """∂ forces / ∂ displacements, (3n, 3n) in 3 × 3 blocks (scipy BSR), N/mm.

        displacements: (n, 3), mm.
        added: (n, 3, 3), N/mm. What else resists at each node, such as contact.
        convex: Of every tet, as `HyperelasticTissue.tangent` takes it.
        """
        n, m = len(self.nodes), len(self.tets)
        own, shared = np.empty((9, 4, m)), np.empty((9, 6, m))
        gradient = self.deformation(displacements)
        fibrous = self.tissue.fibrous
        for chosen in (np.flatnonzero(~fibrous), np.flatnonzero(fibrous)):
            for start in range(0, len(chosen), TETS_AT_ONCE):
                part = chosen[start : start + TETS_AT_ONCE]
                tangent = self.tissue.of(part).tangent(gradient[:, :, part], convex=convex)
                shapes = self.shapes[:, :, part].transpose(2, 1, 0)
                blocks = _between_nodes(tangent, shapes) * self.volumes[part]
                for corner in range(4):
                    own[:, corner, part] = blocks[corner, corner].reshape(9, -1)
                for pair, (p, q) in enumerate(PAIRS):
                    turned = self._reversed[pair, part]
                    block = np.where(turned, blocks[q, p], blocks[p, q])
                    shared[:, pair, part] = block.reshape(9, -1)
        corners, numbers = self.tets.T.ravel(), self._edge.ravel()
        diagonal = np.array([np.bincount(corners, entry.ravel(), n) for entry in own])
        edges = np.array([np.bincount(numbers, e.ravel(), self._n_edges) for e in shared])
        upper = edges.T.reshape(-1, 3, 3)
        middle = diagonal.T.reshape(-1, 3, 3)
        if added is not None:
            middle = middle + added
        data = np.concatenate([middle, upper, upper.transpose(0, 2, 1)])
        sparse = _module("scipy.sparse")
        return sparse.bsr_array(
            (data[self._order], self._columns, self._starts), shape=(3 * n, 3 * n)
        )


def _between_nodes(tangent: Floats, shapes: Floats) -> Floats:
    """∂(P g_p)/∂u_q per volume, (4, 4, 3, 3, m), of ∂P/∂F (m, 9, 9) and g (m, 3, 4)."""
    m = len(tangent)
    # (i, j, k·n) · g_jp, then (i·p, k, n) · g_nq.
    first = np.matmul(shapes.transpose(0, 2, 1)[:, None], tangent.reshape(m, 3, 3, 9))
    both = np.matmul(first.reshape(m, 36, 3), shapes)
    return np.ascontiguousarray(both.reshape(m, 3, 4, 3, 4).transpose(2, 4, 1, 3, 0))


def _virtual_work(v: Any, w: Any) -> Any:
    """P : ∇v, the virtual work of the stress."""
    return np.einsum("ij...,ij...->...", w["stress"], v.grad)


def _module(name: str) -> Any:
    return third_party(name, "virtual patients are solved", "study")
