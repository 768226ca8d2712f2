"""The true tissue as finite elements: its hyperelastic law, energy, forces and stiffness.

Arrays have the tet as their last axis, as scikit-fem's do: F (3, 3, m).
"""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.errors import CaseInputError, third_party
from cmfsim.values.checks import Floats, as_index_rows, as_rows

# (i, j, k, ε_ijk) that are not zero.
PERMUTATIONS = (
    (0, 1, 2, 1.0), (1, 2, 0, 1.0), (2, 0, 1, 1.0), (0, 2, 1, -1.0), (2, 1, 0, -1.0),
    (1, 0, 2, -1.0),
)  # fmt: skip
# Tets whose stiffness is made at a time, so that their blocks (1 kB each) stay in the cache.
TETS_AT_ONCE = 2_000
PAIRS = tuple((p, q) for p in range(4) for q in range(p + 1, 4))


@dataclass(frozen=True)
class Moduli:
    """Small-strain constants of one tissue: Young's moduli along and across the fibre, MPa.

    Poisson's ratio is of loading along the stiffer direction, and across the fibre.
    """

    young_along: float
    young_across: float
    poisson: float

    def spencer(self) -> Floats:
        """λ, μ_T, α, μ_L − μ_T and β of the small-strain law, (5,) MPa (Spencer 1984).

        From the compliance S of the axes (fibre, across, across): C = S⁻¹, λ = C₂₃, μ_T = C₄₄,
        μ_L = C₆₆, α = C₁₂ − λ, β = C₁₁ − λ − 2μ_T − 2α − 4(μ_L − μ_T). The shear along the fibre
        is Saint-Venant's: 1/G = 1/E_l + 1/E_t + 2ν/E_l.
        """
        e_l, e_t, nu = self.young_along, self.young_across, self.poisson
        nu_lt = nu if e_l >= e_t else nu * e_l / e_t
        normal = np.array(
            [
                [1.0 / e_l, -nu_lt / e_l, -nu_lt / e_l],
                [-nu_lt / e_l, 1.0 / e_t, -nu / e_t],
                [-nu_lt / e_l, -nu / e_t, 1.0 / e_t],
            ]
        )
        c = np.linalg.inv(normal)
        mu_across = 0.5 * e_t / (1.0 + nu)
        mu_along = 1.0 / (1.0 / e_l + 1.0 / e_t + 2.0 * nu_lt / e_l)
        lambda_, difference = c[1, 2], mu_along - mu_across
        alpha = c[0, 1] - lambda_
        beta = c[0, 0] - lambda_ - 2.0 * mu_across - 2.0 * alpha - 4.0 * difference
        return np.array([lambda_, mu_across, alpha, difference, beta])


# Tissue that is crushed below this share of its volume stiffens: most of it is water. At J = 0 the
# added pressure is so many times that of λ̂ (J − 1), enough that no tet of the truth turns inside
# out where the corners of the mouth fold.
CRUSHED = 0.2
CRUSHED_PRESSURE = 10.0
# Fat of Table 1 of Kim et al. (2010); muscle with the table's moduli exchanged, stiffer along the
# fibre as passive muscle is. The default preset of the tested models has them as printed.
FAT = Moduli(0.003, 0.003, 0.46)
MUSCLE = Moduli(0.79, 0.5, 0.43)


@dataclass(frozen=True, eq=False)
class SkinLayer:
    """A layer of skin, whose share (m,) of each tet, 0 to 1, replaces fat and muscle there."""

    moduli: Moduli
    share: Floats


@dataclass(frozen=True, eq=False)
class HyperelasticTissue:
    """A neo-Hookean matrix with fibres, one set of constants per tet, finite even in collapse.

    With J = det F, C = Fᵀ F, i₄ = a·C a − 1 and λ̂ = λ + μ the energy per undeformed volume is

        ψ = μ/2 (F:F − 3) − μ (J − 1) + λ̂/2 (J − 1)²
            + α/2 (J − 1) i₄ + β/8 i₄² + d/2 |(C − I) a|²
            + p λ̂ / (3 J₀²) max(J₀ − J, 0)³.

    The first line is the neo-Hookean energy of Smith, de Goes & Kim (2018), a polynomial that
    turning inside out does not break, the second adds fibres in the invariants of Bonet & Burton
    (1998), the third resists collapse: J₀ is `CRUSHED` and p `CRUSHED_PRESSURE`. For small strain ε
    it is Spencer's law λ/2 (tr ε)² + μ ε:ε + α tr ε (a·ε a) + 2 d |ε a|² + β/2 (a·ε a)². Energies
    of fat and muscle in one tet add by volume.

    lambda_, mu, alpha, difference, beta: (m,), MPa. λ, μ = μ_T, α, d = μ_L − μ_T and β.
    fibre: (3, m). Unit vectors a; any where α = d = β = 0.
    """

    lambda_: Floats
    mu: Floats
    alpha: Floats
    difference: Floats
    beta: Floats
    fibre: Floats

    @classmethod
    def mixed(
        cls,
        fraction: ArrayLike,
        fibre: ArrayLike,
        *,
        stiffness: float = 1.0,
        muscle: Moduli = MUSCLE,
        fat: Moduli = FAT,
        skin: SkinLayer | None = None,
    ) -> "HyperelasticTissue":
        """The tissue of tets that are part muscle, part fat, and part skin at the surface.

        fraction: (m,). Part of each tet's volume that is muscle, 0 to 1.
        fibre: (m, 3). Unit vectors; not read where the fraction is 0.
        stiffness: Of this person's muscle, in the ordinary muscle's.
        """
        p = np.asarray(fraction, dtype=np.float64)
        a = np.asarray(fibre, dtype=np.float64)
        if not (np.isfinite(stiffness) and stiffness > 0.0):
            raise CaseInputError(f"stiffness of muscle is {stiffness}: above 0 is needed")
        mixture = (1.0 - p) * fat.spencer()[:, None] + p * stiffness * muscle.spencer()[:, None]
        if skin is not None:
            layer = skin.moduli.spencer()[:, None]
            mixture = (1.0 - skin.share) * mixture + skin.share * layer
        lambda_, mu, alpha, difference, beta = mixture
        # Fat has no direction: what rounding leaves of its fibre terms is nothing.
        alpha, difference, beta = (np.where(p > 0.0, c, 0.0) for c in (alpha, difference, beta))
        along = np.where(p > 0.0, a.T, np.array([[1.0], [0.0], [0.0]]))
        return cls(lambda_, mu, alpha, difference, beta, np.ascontiguousarray(along))

    @property
    def fibrous(self) -> NDArray[np.bool_]:
        """Which tets have fibres, (m,)."""
        fibres: NDArray[np.bool_] = (
            (self.alpha != 0.0) | (self.difference != 0.0) | (self.beta != 0.0)
        )
        return fibres

    def of(self, tets: ArrayLike) -> "HyperelasticTissue":
        """The tissue of some of the tets."""
        rows = np.asarray(tets)
        return HyperelasticTissue(*(getattr(self, f.name)[..., rows] for f in fields(self)))

    def energy(self, gradient: Floats) -> Floats:
        """ψ of each tet, (m,) MPa, at gradients F (3, 3, m)."""
        _, det = cofactor(gradient)
        _, c, i4 = self._fibre_strain(gradient)
        growth = det - 1.0
        psi: Floats = 0.5 * self.mu * ((gradient * gradient).sum(axis=(0, 1)) - 3.0)
        psi -= self.mu * growth
        psi += 0.5 * (self.lambda_ + self.mu) * growth**2
        psi += self._crushing() / 3.0 * np.maximum(CRUSHED - det, 0.0) ** 3
        psi += (0.5 * self.alpha * growth + 0.125 * self.beta * i4) * i4
        psi += 0.5 * self.difference * (c * c).sum(axis=0)
        return psi

    def stress(self, gradient: Floats) -> Floats:
        """The first Piola–Kirchhoff stress P = ∂ψ/∂F, (3, 3, m) MPa, at gradients F (3, 3, m)."""
        cof, det = cofactor(gradient)
        m, c, i4 = self._fibre_strain(gradient)
        fc = np.einsum("ijt,jt->it", gradient, c)
        along = self.alpha * (det - 1.0) + 0.5 * self.beta * i4
        stress = self.mu * gradient + self._pressure(det, i4) * cof
        stress += (along * m + self.difference * fc)[:, None] * self.fibre[None]
        stress += self.difference * m[:, None] * c[None]
        return stress

    def tangent(self, gradient: Floats, *, convex: bool = False) -> Floats:
        """∂P/∂F, (m, 9, 9) MPa, symmetric, over the entries of F (3, 3, m) row by row.

        convex: Sets negative eigenvalues to 0, so that every step along it falls in energy (Teran,
            Sifakis, Irving & Fedkiw 2005).
        """
        f, a, d = gradient, self.fibre, self.difference
        cof, det = cofactor(f)
        size = det.shape[0]
        tangent = np.zeros((3, 3, 3, 3, size))
        # ∂cof_ij/∂F_kl = ε_ikp ε_jlq F_pq.
        pressure = self._pressure(det, self._fibre_strain(f)[2])
        for i, k, p, sign in PERMUTATIONS:
            for j, n, q, other in PERMUTATIONS:
                tangent[i, j, k, n] += (sign * other) * pressure * f[p, q]
        bulk = self.lambda_ + self.mu + 2.0 * self._crushing() * np.maximum(CRUSHED - det, 0.0)
        volume = bulk * cof
        if self.fibrous.any():
            m, c, i4 = self._fibre_strain(f)
            ma = m[:, None] * a[None]
            along = self.alpha * (det - 1.0) + 0.5 * self.beta * i4
            volume = volume + self.alpha * ma
            slope = self.alpha * cof + self.beta * ma
            tangent += ma[:, :, None, None] * slope[None, None]
            # ∂c = ∂Fᵀ m + Fᵀ ∂F a enters (F c) ⊗ a and m ⊗ c.
            aa = a[:, None] * a[None]
            turned = d * m[:, None] * m[None]
            for i in range(3):
                tangent[i, :, i] += along * aa + d * (a[:, None] * c[None] + c[:, None] * a[None])
            for j in range(3):
                tangent[:, j, :, j] += turned
            df = d * f
            tangent += df.transpose(1, 0, 2)[None, :, :, None] * ma[:, None, None, :]
            tangent += df[:, None, None, :] * ma.transpose(1, 0, 2)[None, :, :, None]
            stretched = np.einsum("ipt,kpt->ikt", df, f)
            tangent += stretched[:, None, :, None] * aa[None, :, None, :]
        tangent += cof[:, :, None, None] * volume[None, None]
        for i in range(3):
            for j in range(3):
                tangent[i, j, i, j] += self.mu
        square = np.ascontiguousarray(tangent.reshape(9, 9, size).transpose(2, 0, 1))
        return _raised(square) if convex else square

    def _pressure(self, det: Floats, i4: Floats) -> Floats:
        """∂ψ/∂J, (m,) MPa."""
        change = (self.lambda_ + self.mu) * (det - 1.0) - self.mu + 0.5 * self.alpha * i4
        change -= self._crushing() * np.maximum(CRUSHED - det, 0.0) ** 2
        return change

    def _crushing(self) -> Floats:
        """The factor of the term against collapse, p λ̂ / J₀², (m,) MPa."""
        return CRUSHED_PRESSURE / CRUSHED**2 * (self.lambda_ + self.mu)

    def _fibre_strain(self, gradient: Floats) -> tuple[Floats, Floats, Floats]:
        """Of the fibre: m = F a and c = (C − I) a, (3, m), and i₄ = a·c, (m,)."""
        m = np.einsum("ijt,jt->it", gradient, self.fibre)
        c = np.einsum("ijt,it->jt", gradient, m) - self.fibre
        return m, c, (self.fibre * c).sum(axis=0)


def _raised(tangent: Floats) -> Floats:
    """Symmetric matrices (m, 9, 9) with their negative eigenvalues set to 0."""
    bent = np.flatnonzero(_bends(tangent))
    if len(bent):
        values, vectors = np.linalg.eigh(tangent[bent])
        tangent[bent] = (vectors * np.maximum(values, 0.0)[:, None]) @ vectors.transpose(0, 2, 1)
    return tangent


def _bends(tangent: Floats) -> NDArray[np.bool_]:
    """Which symmetric matrices (m, 9, 9) have a pivot that is not positive, (m,)."""
    rest = np.ascontiguousarray(tangent.transpose(1, 2, 0))
    found = np.zeros(len(tangent), dtype=bool)
    for k in range(9):
        pivot = rest[k, k]
        found |= ~(pivot > 0.0)
        row = rest[k, k + 1 :] / np.where(found, 1.0, pivot)
        rest[k + 1 :, k + 1 :] -= rest[k + 1 :, k, None] * row
    return found


def cofactor(gradient: Floats) -> tuple[Floats, Floats]:
    """The cofactors ∂J/∂F (3, 3, m) and J = det F (m,) of gradients F (3, 3, m)."""
    f = gradient
    found = np.empty_like(f)
    for i in range(3):
        for j in range(3):
            k, n, p, q = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
            found[i, j] = f[k, p] * f[n, q] - f[k, q] * f[n, p]
    return found, (f[0] * found[0]).sum(axis=0)


class HyperelasticBody:
    """A mesh with hyperelastic tissue: its energy, internal forces and stiffness.

    Forces come from scikit-fem (Gustafsson & McBain 2020): the equilibrium that the truth satisfies
    is that library's, not the mass tensors'. The stiffness only leads Newton's method there.

    nodes, tets: (n, 3), mm, and (m, 4), positively oriented.
    """

    def __init__(self, nodes: ArrayLike, tets: ArrayLike, tissue: HyperelasticTissue) -> None:
        points = as_rows("nodes", nodes, 3)
        rows = as_index_rows("tets", tets, 4, len(points), "nodes").astype(np.int64)
        self.nodes, self.tets, self.tissue = points, rows, tissue
        skfem = third_party("skfem", "virtual patients are solved", "study")
        mesh = skfem.MeshTet(
            np.ascontiguousarray(points.T), np.ascontiguousarray(rows.T), sort_t=False
        )
        element = skfem.ElementVector(skfem.ElementTetP1())
        self._basis = skfem.Basis(mesh, element, intorder=1)
        self._assemble = skfem.LinearForm(_virtual_work).assemble
        self.volumes: Floats = self._basis.dx.sum(axis=1)
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
        """∂ forces / ∂ displacements (n, 3) mm: (3n, 3n) in 3 × 3 blocks (scipy BSR), N/mm.

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
        sparse = third_party("scipy.sparse", "virtual patients are solved", "study")
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
