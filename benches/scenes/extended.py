"""Reference displacements in double-double arithmetic, independent of cmfsim.

The stiffness is never stored in extended precision: forces are summed tet by tet from strains, in
pairs of float64 that carry about 32 digits (Dekker 1971; Hida, Li & Bailey 2001). A float64 factor
of an independently assembled, equilibrated matrix turns those forces into corrections (iterative
refinement with extra-precise residuals: Demmel et al. 2006) until they no longer matter. The
elasticities come from the engineering compliance, inverted with 60 decimal digits.
"""

from __future__ import annotations

import functools
import itertools
from dataclasses import dataclass
from decimal import Decimal, localcontext
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Indices = NDArray[np.uint32]

# The two axes of each Voigt component: xx, yy, zz, yz, xz, xy.
VOIGT = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))
# Veltkamp's constant 2^27 + 1: splits a float64 into two halves whose products are exact.
SPLIT = 134217729.0
# Decimal digits of the elasticities: twice what a pair of float64 holds.
DIGITS = 60
# Corrections over the largest displacement at which the refinement has nothing left to do.
REFINED = 1e-24
# Most refinement steps; each gains log10(1 / (ε κ)) digits.
MAX_REFINEMENTS = 60
# Unknowns up to which the extreme eigenvalues are computed densely.
DENSE_UNKNOWNS = 100


class Twofold:
    """Sums hi + lo of two float64 arrays, |lo| ≤ ½ ulp(hi): about 32 digits."""

    __slots__ = ("hi", "lo")
    # numpy must leave `array * Twofold` to this class.
    __array_ufunc__ = None

    def __init__(self, hi: Floats, lo: Floats | None = None) -> None:
        self.hi = np.asarray(hi, dtype=np.float64)
        self.lo = np.zeros_like(self.hi) if lo is None else lo

    def __getitem__(self, at: Any) -> Twofold:
        """The entries at an index."""
        return Twofold(self.hi[at], self.lo[at])

    def __neg__(self) -> Twofold:
        """The negative."""
        return Twofold(-self.hi, -self.lo)

    def __add__(self, other: Twofold) -> Twofold:
        """The sum, to about 32 digits of the larger term."""
        s, e = _two_sum(self.hi, other.hi)
        t, f = _two_sum(self.lo, other.lo)
        s, e = _quick_two_sum(s, e + t)
        return Twofold(*_quick_two_sum(s, e + f))

    def __sub__(self, other: Twofold) -> Twofold:
        """The difference."""
        return self + (-other)

    def __mul__(self, other: Twofold) -> Twofold:
        """The product."""
        p, e = _two_product(self.hi, other.hi)
        return Twofold(*_quick_two_sum(p, e + (self.hi * other.lo + self.lo * other.hi)))

    def __truediv__(self, other: Twofold) -> Twofold:
        """The quotient, by long division with three float64 digits."""
        digits = []
        rest = self
        for _ in range(3):
            digit = Twofold(rest.hi / other.hi)
            rest = rest - other * digit
            digits.append(digit)
        return digits[0] + digits[1] + digits[2]


def _two_sum(a: Floats, b: Floats) -> tuple[Floats, Floats]:
    s = a + b
    t = s - a
    return s, (a - (s - t)) + (b - t)


def _quick_two_sum(a: Floats, b: Floats) -> tuple[Floats, Floats]:
    s = a + b
    return s, b - (s - a)


def _two_product(a: Floats, b: Floats) -> tuple[Floats, Floats]:
    p = a * b
    u, v = SPLIT * a, SPLIT * b
    a_high, b_high = u - (u - a), v - (v - b)
    a_low, b_low = a - a_high, b - b_high
    return p, ((a_high * b_high - p) + a_high * b_low + a_low * b_high) + a_low * b_low


@dataclass(frozen=True)
class Material:
    """Moduli (MPa) along and across the fibre and the Poisson ratio of the stiffer direction.

    Without a fibre the material is isotropic and both moduli are the same.
    """

    along: float
    across: float
    poisson: float
    fibre: tuple[float, float, float] | None = None


def isotropic(young: float, poisson: float) -> Material:
    """The isotropic material of a Young's modulus (MPa) and a Poisson ratio."""
    return Material(young, young, poisson)


def elasticity(material: Material) -> list[list[Decimal]]:
    """Stiffness (6, 6) in global axes, MPa, with `DIGITS` decimal digits.

    The compliance with the fibre on axis 1 (Lekhnitskii 1963): S11 = 1/E_l, S22 = S33 = 1/E_t,
    S12 = S13 = −ν_lt/E_l, S23 = −ν/E_t, S44 = 2(1+ν)/E_t, S55 = S66 = 1/G; ν_lt = ν where the fibre
    is the stiffer direction, else ν E_l/E_t; 1/G = 1/E_l + 1/E_t + 2ν_lt/E_l (Saint-Venant). Its
    inverse is turned with C_ijkl = R_ip R_jq R_kr R_ls C'_pqrs.
    """
    with localcontext() as context:
        context.prec = DIGITS
        along, across, nu = (
            Decimal(v) for v in (material.along, material.across, material.poisson)
        )
        nu_lt = nu if along >= across else nu * along / across
        s = [[Decimal(0)] * 6 for _ in range(6)]
        s[0][0] = 1 / along
        s[1][1] = s[2][2] = 1 / across
        s[0][1] = s[1][0] = s[0][2] = s[2][0] = -nu_lt / along
        s[1][2] = s[2][1] = -nu / across
        s[3][3] = 2 * (1 + nu) / across
        s[4][4] = s[5][5] = 1 / along + 1 / across + 2 * nu_lt / along
        c = _inverse(s)
        if material.fibre is None:
            return c
        frame = _frame([Decimal(v) for v in material.fibre])
        tensor: dict[tuple[int, ...], Decimal] = {}
        for (p, (i, j)), (q, (k, m)) in itertools.product(enumerate(VOIGT), repeat=2):
            for ij, km in itertools.product({(i, j), (j, i)}, {(k, m), (m, k)}):
                tensor[ij + km] = c[p][q]
        for place in range(4):
            turned: dict[tuple[int, ...], Decimal] = {}
            for index in itertools.product(range(3), repeat=4):
                turned[index] = sum(
                    (
                        frame[p][index[place]] * tensor[(*index[:place], p, *index[place + 1 :])]
                        for p in range(3)
                    ),
                    Decimal(0),
                )
            tensor = turned
        return [[tensor[ij + km] for km in VOIGT] for ij in VOIGT]


def _inverse(matrix: list[list[Decimal]]) -> list[list[Decimal]]:
    """The inverse by Gauss–Jordan elimination; a compliance needs no pivoting."""
    n = len(matrix)
    rows = [[*row, *(Decimal(int(i == j)) for j in range(n))] for i, row in enumerate(matrix)]
    for i in range(n):
        pivot = rows[i][i]
        rows[i] = [v / pivot for v in rows[i]]
        for k in range(n):
            if k != i and rows[k][i] != 0:
                factor = rows[k][i]
                rows[k] = [v - factor * w for v, w in zip(rows[k], rows[i], strict=True)]
    return [row[n:] for row in rows]


def _frame(fibre: list[Decimal]) -> list[list[Decimal]]:
    """Three orthonormal rows, the first along the fibre."""
    a = _unit(fibre)
    least = min(range(3), key=lambda i: abs(a[i]))
    b = _unit(_cross(a, [Decimal(int(i == least)) for i in range(3)]))
    return [a, b, _cross(a, b)]


def _unit(v: list[Decimal]) -> list[Decimal]:
    length = sum((x * x for x in v), Decimal(0)).sqrt()
    return [x / length for x in v]


def _cross(a: list[Decimal], b: list[Decimal]) -> list[Decimal]:
    return [a[(i + 1) % 3] * b[(i + 2) % 3] - a[(i + 2) % 3] * b[(i + 1) % 3] for i in range(3)]


class ExtendedModel:
    """Nodal forces of a tet mesh with 32 digits, and a float64 stiffness to refine with.

    Parameters
    ----------
    nodes : (n, 3) float64, mm
    tets : (m, 4) int
    materials : sequence of Material
    material_of : (m,) int
        Which material each tet has.
    """

    def __init__(
        self, nodes: Floats, tets: Indices, materials: Sequence[Material], material_of: Indices
    ) -> None:
        self.nodes = nodes
        self.tets = tets.astype(np.int64)
        self.gradients, self.volumes = _shape_gradients(nodes, self.tets)
        exact = [elasticity(m) for m in materials]
        self.stiffness: dict[tuple[int, int], Twofold] = {}
        for p, q in itertools.product(range(6), repeat=2):
            values = [c[p][q] for c in exact]
            if any(v != 0 for v in values):
                high = np.array([float(v) for v in values])
                low = np.array([float(v - Decimal(float(v))) for v in values])
                self.stiffness[p, q] = Twofold(high[material_of], low[material_of])
        # Sums over the tets of a node go in passes: pass k adds the k-th tet of each node.
        flat = self.tets.ravel()
        order = np.argsort(flat, kind="stable")
        node = flat[order]
        first = np.searchsorted(node, np.arange(len(nodes)))
        rank = np.arange(len(node)) - first[node]
        self.passes = [
            (node[rank == k], order[rank == k]) for k in range(int(rank.max(initial=-1)) + 1)
        ]

    def forces(self, u: Twofold) -> Twofold:
        """Internal nodal forces f = Σ V Bᵀ C B u, (n, 3), N."""
        g = self.gradients
        u_tet = u[self.tets]
        slope = [
            [_sum([u_tet[:, a, i] * g[:, a, j] for a in range(4)]) for j in range(3)]
            for i in range(3)
        ]
        strain = [slope[i][j] if i == j else slope[i][j] + slope[j][i] for i, j in VOIGT]
        stress: dict[tuple[int, int], Twofold] = {}
        for p, (i, j) in enumerate(VOIGT):
            terms = [c * strain[q] for (row, q), c in self.stiffness.items() if row == p]
            stress[i, j] = stress[j, i] = _sum(terms) * self.volumes
        high = np.empty((len(self.tets), 4, 3))
        low = np.empty_like(high)
        for a, i in itertools.product(range(4), range(3)):
            f = _sum([stress[i, j] * g[:, a, j] for j in range(3)])
            high[:, a, i], low[:, a, i] = f.hi, f.lo
        parts = Twofold(high.reshape(-1, 3), low.reshape(-1, 3))
        total = Twofold(np.zeros_like(self.nodes))
        for node, part in self.passes:
            added = total[node] + parts[part]
            total.hi[node], total.lo[node] = added.hi, added.lo
        return total

    @functools.cached_property
    def matrix(self) -> sp.csr_matrix:
        """The assembled stiffness in float64, (3n, 3n), N/mm."""
        m = len(self.tets)
        b = np.zeros((m, 6, 12))
        for a in range(4):
            g = self.gradients.hi[:, a]
            for p, (i, j) in enumerate(VOIGT):
                b[:, p, 3 * a + i] += g[:, j]
                if i != j:
                    b[:, p, 3 * a + j] += g[:, i]
        c = np.zeros((m, 6, 6))
        for (p, q), value in self.stiffness.items():
            c[:, p, q] = value.hi
        blocks = np.einsum("m,mpa,mpq,mqb->mab", self.volumes.hi, b, c, b, optimize=True)
        dofs = (3 * self.tets[:, :, None] + np.arange(3)).reshape(m, 12)
        rows = np.repeat(dofs, 12, axis=1).ravel()
        columns = np.tile(dofs, (1, 12)).ravel()
        size = 3 * len(self.nodes)
        return sp.csr_matrix((blocks.ravel(), (rows, columns)), shape=(size, size))


def _sum(terms: list[Twofold]) -> Twofold:
    total = terms[0]
    for term in terms[1:]:
        total = total + term
    return total


def _shape_gradients(nodes: Floats, tets: NDArray[np.int64]) -> tuple[Twofold, Twofold]:
    """Shape gradients (m, 4, 3), 1/mm, and volumes (m,), mm³, with 32 digits."""
    x = Twofold(nodes[tets])
    edge = [[x[:, k, i] - x[:, 0, i] for i in range(3)] for k in (1, 2, 3)]

    def crossed(a: list[Twofold], b: list[Twofold]) -> list[Twofold]:
        return [a[(i + 1) % 3] * b[(i + 2) % 3] - a[(i + 2) % 3] * b[(i + 1) % 3] for i in range(3)]

    faces = [crossed(edge[1], edge[2]), crossed(edge[2], edge[0]), crossed(edge[0], edge[1])]
    six_volumes = _sum([edge[0][i] * faces[0][i] for i in range(3)])
    high, low = np.empty((len(tets), 4, 3)), np.empty((len(tets), 4, 3))
    for i in range(3):
        rows = [face[i] / six_volumes for face in faces]
        for a, row in enumerate([-_sum(rows), *rows]):
            high[:, a, i], low[:, a, i] = row.hi, row.lo
    sixth = Twofold(np.ones(len(tets))) / Twofold(np.full(len(tets), 6.0))
    return Twofold(high, low), six_volumes * sixth


def rigid_displacement(matrix: Floats, points: Floats) -> Twofold:
    """(R − I) x + t of a (4, 4) matrix at points, mm, with 32 digits."""
    rows = []
    for i in range(3):
        terms = [Twofold(np.full(len(points), matrix[i, 3]))]
        for j in range(3):
            entry = Twofold(np.full(len(points), matrix[i, j]))
            if i == j:
                entry = entry - Twofold(np.ones(len(points)))
            terms.append(entry * Twofold(points[:, j]))
        rows.append(_sum(terms))
    return Twofold(np.stack([r.hi for r in rows], 1), np.stack([r.lo for r in rows], 1))


@dataclass(frozen=True, eq=False)
class Reference:
    """Displacements exact to far beyond float64, and how sensitive they are.

    Attributes
    ----------
    displacements : (n, 3) float64, mm
    condition : float
        Condition number κ₂ of the equilibrated matrix D^-½ K D^-½ over the unknowns, D = diag K:
        the one that governs Cholesky's error (van der Sluis 1969). 1 without unknowns.
    uncertainty : float
        Last correction of the refinement over the largest displacement.
    refinements : int
    """

    displacements: Floats
    condition: float
    uncertainty: float
    refinements: int


def solve(
    model: ExtendedModel,
    prescribed: NDArray[np.bool_],
    motion: Twofold,
    loads: Floats | None = None,
) -> Reference:
    """The displacements under prescribed motions and nodal loads.

    Parameters
    ----------
    model : ExtendedModel
    prescribed : (n,) bool
    motion : (n, 3) Twofold, mm
        Zero where not prescribed.
    loads : (n, 3) float64, N, optional

    Raises
    ------
    ArithmeticError
        The refinement does not converge: the matrix is singular to float64.
    """
    unknown = np.flatnonzero(np.repeat(~prescribed, 3))
    if len(unknown) == 0:
        return Reference(motion.hi, 1.0, 0.0, 0)
    matrix = model.matrix[unknown][:, unknown].tocsc()
    scale = 1.0 / np.sqrt(matrix.diagonal())
    scaled = sp.csc_matrix(sp.diags(scale) @ matrix @ sp.diags(scale))
    factor = spla.splu(scaled, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
    outside = Twofold(np.zeros_like(model.nodes) if loads is None else loads)
    u = motion
    last = np.inf
    for step in range(1, MAX_REFINEMENTS + 1):
        rest = (outside - model.forces(u)).hi.ravel()[unknown]
        correction = np.zeros(3 * len(model.nodes))
        correction[unknown] = scale * factor.solve(scale * rest)
        u = u + Twofold(correction.reshape(-1, 3))
        size = float(np.abs(correction).max() / np.abs(u.hi).max())
        if size <= REFINED or (size < 1e-20 and size > 0.5 * last):
            return Reference(u.hi, condition_number(scaled, factor), size, step)
        last = size
    raise ArithmeticError(f"the refinement stopped at a relative correction of {last:.1e}")


def condition_number(scaled: sp.csc_matrix, factor: spla.SuperLU) -> float:
    """Ratio of the extreme eigenvalues of a symmetric matrix."""
    n = scaled.shape[0]
    if n <= DENSE_UNKNOWNS:
        values = np.linalg.eigvalsh(scaled.toarray())
        return float(values[-1] / values[0])
    start = np.random.default_rng(0).normal(size=n)
    largest = spla.eigsh(scaled, k=1, which="LA", v0=start, return_eigenvectors=False, tol=1e-3)[0]
    inverse = spla.LinearOperator((n, n), matvec=factor.solve, dtype=np.float64)
    flexible = spla.eigsh(inverse, k=1, which="LA", v0=start, return_eigenvectors=False, tol=1e-3)[
        0
    ]
    return float(largest * flexible)
