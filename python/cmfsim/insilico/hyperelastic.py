"""The law of the true tissue: transversely isotropic, hyperelastic, for large deformation.

Arrays have the tet as their last axis, as scikit-fem's do: F (3, 3, m).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.checks import Floats
from cmfsim.errors import CaseInputError

__all__ = ["FAT", "MUSCLE", "HyperelasticTissue", "Moduli", "inverse_transpose"]


@dataclass(frozen=True)
class Moduli:
    """Small-strain constants of one tissue.

    Attributes
    ----------
    young_along, young_across : float, MPa
        Along and across the fibre.
    poisson : float
        Of loading along the stiffer direction, and across the fibre.
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


# Fat of Table 1 of Kim et al. (2010); muscle with the table's moduli exchanged, stiffer along the
# fibre as passive muscle is. The default preset of the tested models has them as printed.
FAT = Moduli(0.003, 0.003, 0.46)
MUSCLE = Moduli(0.79, 0.5, 0.43)


@dataclass(frozen=True, eq=False)
class HyperelasticTissue:
    """A neo-Hookean matrix with fibres, after Bonet & Burton (1998), one set of constants per tet.

    With J = det F, i₄ = |F a|² − 1 and I₅ = |Fᵀ F a|² the energy per undeformed volume is

        ψ = μ/2 (F:F − 3) − μ ln J + λ/2 (ln J)²
            + (−d + α/2 ln J + β/8 i₄) i₄ + d/2 (I₅ − 1),

    whose limit for small strain ε is Spencer's law λ/2 (tr ε)² + μ ε:ε + α tr ε (a·ε a)
    + 2 d |ε a|² + β/2 (a·ε a)². Energies of fat and muscle in one tet add by volume.

    Attributes
    ----------
    lambda_, mu, alpha, difference, beta : (m,) float64, MPa
        λ, μ = μ_T, α, d = μ_L − μ_T and β.
    fibre : (3, m) float64
        Unit vectors a; any where α = d = β = 0.
    """

    lambda_: Floats
    mu: Floats
    alpha: Floats
    difference: Floats
    beta: Floats
    fibre: Floats

    @classmethod
    def mixed(
        cls, fraction: ArrayLike, fibre: ArrayLike, *, stiffness: float = 1.0
    ) -> "HyperelasticTissue":
        """The tissue of tets that are part muscle, part fat.

        Parameters
        ----------
        fraction : (m,) float64
            Part of each tet's volume that is muscle, 0 to 1.
        fibre : (m, 3) float64
            Unit vectors; not read where the fraction is 0.
        stiffness : float
            Of this person's muscle, in the ordinary muscle's.

        Raises
        ------
        CaseError
            (also `ValueError`) Shapes that do not match, a fraction out of range, a fibre that is
            no unit vector, stiffness not positive.
        """
        p = np.asarray(fraction, dtype=np.float64)
        a = np.asarray(fibre, dtype=np.float64)
        if p.ndim != 1 or a.shape != (len(p), 3):
            raise CaseInputError(f"fraction {p.shape} and fibre {a.shape}: (m,) and (m, 3) needed")
        bad = np.flatnonzero(~((p >= 0.0) & (p <= 1.0)))
        if len(bad):
            raise CaseInputError(f"fraction[{bad[0]}] is {p[bad[0]]}: 0 to 1 is allowed")
        length = np.linalg.norm(a, axis=1)
        bad = np.flatnonzero((p > 0.0) & ~(np.abs(length - 1.0) < 1e-9))
        if len(bad):
            raise CaseInputError(f"fibre[{bad[0]}] has length {length[bad[0]]:.6g}: 1 is needed")
        if not (np.isfinite(stiffness) and stiffness > 0.0):
            raise CaseInputError(f"stiffness of muscle is {stiffness}: above 0 is needed")
        fat, muscle = FAT.spencer()[:, None], stiffness * MUSCLE.spencer()[:, None]
        lambda_, mu, alpha, difference, beta = (1.0 - p) * fat + p * muscle
        # Fat has no direction: what rounding leaves of its fibre terms is nothing.
        alpha, difference, beta = (np.where(p > 0.0, c, 0.0) for c in (alpha, difference, beta))
        along = np.where(p > 0.0, a.T, np.array([[1.0], [0.0], [0.0]]))
        return cls(lambda_, mu, alpha, difference, beta, np.ascontiguousarray(along))

    @property
    def fibrous(self) -> NDArray[np.bool_]:
        """Which tets have fibres, (m,)."""
        fibres = (self.alpha != 0.0) | (self.difference != 0.0) | (self.beta != 0.0)
        return np.asarray(fibres)

    def of(self, tets: ArrayLike) -> "HyperelasticTissue":
        """The tissue of some of the tets."""
        rows = np.asarray(tets)
        return HyperelasticTissue(
            self.lambda_[rows],
            self.mu[rows],
            self.alpha[rows],
            self.difference[rows],
            self.beta[rows],
            self.fibre[:, rows],
        )

    def energy(self, gradient: Floats) -> Floats:
        """ψ of each tet, (m,) MPa; infinite where a tet is inside out.

        Parameters
        ----------
        gradient : (3, 3, m) float64
            F.
        """
        _, det = inverse_transpose(gradient)
        upright = det > 0.0
        log = np.log(np.where(upright, det, 1.0))
        m = np.einsum("ijt,jt->it", gradient, self.fibre)
        w = np.einsum("ijt,it->jt", gradient, m)
        i4, i5 = (m * m).sum(axis=0) - 1.0, (w * w).sum(axis=0) - 1.0
        psi = 0.5 * self.mu * ((gradient * gradient).sum(axis=(0, 1)) - 3.0) - self.mu * log
        psi += 0.5 * self.lambda_ * log**2
        psi += (0.5 * self.alpha * log + 0.125 * self.beta * i4 - self.difference) * i4
        psi += 0.5 * self.difference * i5
        return np.where(upright, psi, np.inf)

    def stress(self, gradient: Floats) -> Floats:
        """The first Piola–Kirchhoff stress P = ∂ψ/∂F, (3, 3, m) MPa.

        Parameters
        ----------
        gradient : (3, 3, m) float64
            F, with det F > 0.
        """
        turned, det = inverse_transpose(gradient)
        log = np.log(det)
        a = self.fibre
        m = np.einsum("ijt,jt->it", gradient, a)
        w = np.einsum("ijt,it->jt", gradient, m)
        i4 = (m * m).sum(axis=0) - 1.0
        stress = self.mu * gradient
        stress += (self.lambda_ * log - self.mu + 0.5 * self.alpha * i4) * turned
        along = self.alpha * log + 0.5 * self.beta * i4 - 2.0 * self.difference
        fw = np.einsum("ijt,jt->it", gradient, w)
        stress += (along * m + self.difference * fw)[:, None] * a[None]
        stress += self.difference * m[:, None] * w[None]
        return stress

    def stiffness(self, gradient: Floats, shapes: Floats, *, convex: bool = False) -> Floats:
        """∂(P g_a)/∂u_b of the pairs of nodes of a tet, per volume, (4, 4, 3, 3, m) N/mm⁴.

        Parameters
        ----------
        gradient : (3, 3, m) float64
            F.
        shapes : (4, 3, m) float64, 1/mm
            Undeformed gradients g_a of the shape functions.
        convex : bool
            Leaves out what the stress takes from the stiffness: μ − λ ln J − α i₄/2 is cut to
            0…μ J/|F|, where μ outweighs it, and the fibre keeps its pull alone.

        Notes
        -----
        With ĝ = F⁻ᵀ g the matrix gives μ (g_a·g_b) I + (μ − λ ln J − α i₄/2) ĝ_b⊗ĝ_a + λ ĝ_a⊗ĝ_b,
        the fibre what the terms in i₄ and I₅ add (m = F a, w = Fᵀ m, s_a = a·g_a, h_a = F g_a).
        """
        turned, det = inverse_transpose(gradient)
        log = np.log(det)
        a, d = self.fibre, self.difference
        m = np.einsum("ijt,jt->it", gradient, a)
        i4 = (m * m).sum(axis=0) - 1.0
        spatial = np.einsum("ijt,ajt->ait", turned, shapes)
        opposite = self.mu - self.lambda_ * log - 0.5 * self.alpha * i4
        if convex:
            size = np.sqrt((gradient * gradient).sum(axis=(0, 1)))
            opposite = np.clip(opposite, 0.0, self.mu * det / size)
        fibrous = bool(self.fibrous.any())
        if fibrous:
            w = np.einsum("ijt,it->jt", gradient, m)
            s = np.einsum("jt,ajt->at", a, shapes)
            h = np.einsum("ijt,ajt->ait", gradient, shapes)
            ws = np.einsum("jt,ajt->at", w, shapes)
            along = self.alpha * log + 0.5 * self.beta * i4 - 2.0 * d
            if convex:
                along = np.maximum(along, -2.0 * d)
            fft = np.einsum("ikt,jkt->ijt", gradient, gradient)
        blocks = np.empty((4, 4, 3, 3, det.shape[0]))
        for p in range(4):
            for q in range(p, 4):
                block = opposite * spatial[q][:, None] * spatial[p][None]
                block += self.lambda_ * spatial[p][:, None] * spatial[q][None]
                dot = np.einsum("jt,jt->t", shapes[p], shapes[q])
                same = self.mu * dot
                if fibrous:
                    same = same + along * s[p] * s[q] + d * (s[q] * ws[p] + ws[q] * s[p])
                    both = self.beta * s[p] * s[q] + d * dot
                    block += both * m[:, None] * m[None]
                    block += (self.alpha * s[p]) * m[:, None] * spatial[q][None]
                    block += (self.alpha * s[q]) * spatial[p][:, None] * m[None]
                    block += (d * s[q]) * m[:, None] * h[p][None]
                    block += (d * s[p]) * h[q][:, None] * m[None]
                    block += (d * s[p] * s[q]) * fft
                for i in range(3):
                    block[i, i] += same
                blocks[p, q] = block
                if p != q:
                    blocks[q, p] = block.transpose(1, 0, 2)
        return blocks


def inverse_transpose(gradient: Floats) -> tuple[Floats, Floats]:
    """F⁻ᵀ (3, 3, m) and det F (m,) of gradients F (3, 3, m); F⁻ᵀ is NaN-free but void at det 0."""
    f = gradient
    cofactor = np.empty_like(f)
    for i in range(3):
        for j in range(3):
            k, n, p, q = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
            cofactor[i, j] = f[k, p] * f[n, q] - f[k, q] * f[n, p]
    det = (f[0] * cofactor[0]).sum(axis=0)
    tiny = np.finfo(np.float64).tiny
    return cofactor / np.where(np.abs(det) > tiny, det, 1.0), det
