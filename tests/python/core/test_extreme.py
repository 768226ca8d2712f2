"""Stiff and extreme cases: benches/stability/stability.py and its references."""

import itertools
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

import cmfsim
from benches.scenes import extended
from benches.stability.extreme import bodies, contact, elements, kinematics, linear
from benches.stability.extreme.problem import NU
from benches.stability.extreme.rows import ALL, FAST

CASES = linear.cases()
SOLVED = [
    pytest.param(case, method, id=f"{case.key} [{method}]")
    for case in CASES
    for method in case.methods
]
CONTACT, ELEMENTS, KINEMATICS = (
    [
        pytest.param(case, method, id=f"{case.key} [{method}]")
        for case in suite.cases(quick=True)
        for method in case.methods
    ]
    for suite in (contact, elements, kinematics)
)
CLOSED = [case for case in CASES if not case.refusal and linear.problem(case).exact is not None]


@pytest.mark.parametrize(("case", "method"), SOLVED)
def test_a_case_is_solved_to_its_condition_or_refused(case, method):
    """‖u − u_ref‖∞ / ‖u_ref‖∞ ≤ max(1e-9, 10 ε κ) for Cholesky (κ of the equilibrated matrix: van
    der Sluis 1969; Demmel 1989), ≤ the reported bound + 10 ε κ for the iterative methods; else
    SolverError, and for mechanisms BoundaryError with the free modes. Never a quiet wrong answer,
    hang or panic.
    """
    row = linear.judge(case, method)
    assert row.passed, row.verdict


@pytest.mark.parametrize(("case", "method"), CONTACT)
def test_contact_ends_on_the_moved_surface_in_equilibrium(case, method):
    """Each held node within 1e-6 mm of the moved triangles (Ericson 2005, 5.1.5), no force across
    the normals, and u = u_p + Z y with Zᵀ f(u) = 0 refined with 32 digits; mechanisms refused.
    """
    row = contact.judge(case, method)
    assert row.passed, row.verdict


@pytest.mark.parametrize(("case", "method"), ELEMENTS)
def test_elements_solve_their_equations_and_only_linear_tets_lock(case, method):
    """Displacements of p1, anp (Bonet & Burton 1998) and p2 against an independent stiffness of the
    same element, within max(1e-9, 10 ε κ) and the bound; deflection of Cook's membrane (1974).
    """
    row = elements.judge(case, method)
    assert row.passed, row.verdict


@pytest.mark.parametrize(("case", "method"), KINEMATICS)
def test_large_deformation_is_a_closed_form_or_in_balance(case, method):
    """U = (F − I) x for turns of 120° and J = 0.2; else P from numpy's decompositions (Smith et al.
    2018, eq. 14; R (λ tr S + 2 μ S)), assembled by scikit-fem, is in balance at the free nodes.
    """
    row = kinematics.judge(case, method)
    assert row.passed, row.verdict


@pytest.mark.parametrize("case", CLOSED, ids=lambda c: c.key)
def test_the_reference_equals_the_closed_form(case):
    """32-digit refinement (Demmel et al. 2006) against fields that linear tets hold exactly: affine
    (patch test, Irons 1972), rigid u = (R − I)x + t, series bar σ = E u′, layers σ_n continuous.
    """
    exact = linear.problem(case).exact
    found = linear.reference(case)
    assert found.uncertainty <= 1e-18
    # The closed form itself is rounded to float64 on the boundary.
    assert np.abs(found.displacements - exact).max() <= 1e-13 * np.abs(exact).max()


def test_the_reference_of_one_free_node_is_the_rational_solution():
    """K_ff u_f = −Σ K_fk u_k with K_jk = V [λ g_j⊗g_k + μ g_k⊗g_j + μ (g_j·g_k) I] in exact
    fractions (Cotin 2000), on a tet with integer nodes, E = 1, ν = 1/4 and three prescribed nodes.
    """
    nodes = [[0, 0, 0], [10, 0, 0], [2, 9, 0], [3, 2, 8]]
    u = [[Fraction(v, 4) for v in row] for row in ([1, 0, 2], [0, -3, 1], [5, 1, -2])]
    edges = [[Fraction(nodes[k][i] - nodes[0][i]) for i in range(3)] for k in (1, 2, 3)]

    def cross(a, b):
        return [a[(i + 1) % 3] * b[(i + 2) % 3] - a[(i + 2) % 3] * b[(i + 1) % 3] for i in range(3)]

    six_v = sum(p * q for p, q in zip(edges[0], cross(edges[1], edges[2]), strict=True))
    g = [[v / six_v for v in cross(edges[(k + 1) % 3], edges[(k + 2) % 3])] for k in range(3)]
    g.insert(0, [-sum(row[i] for row in g) for i in range(3)])
    lame, mu = Fraction(2, 5), Fraction(2, 5)

    def tensor(j, k):
        inner = sum(p * q for p, q in zip(g[j], g[k], strict=True))
        return [
            [
                lame * g[j][a] * g[k][b] + mu * g[k][a] * g[j][b] + mu * inner * (a == b)
                for b in range(3)
            ]
            for a in range(3)
        ]

    k_ff = tensor(3, 3)
    rhs = [-sum(tensor(3, k)[a][b] * u[k][b] for k in range(3) for b in range(3)) for a in range(3)]

    def determinant(m):
        return sum(p * q for p, q in zip(m[0], cross(m[1], m[2]), strict=True))

    exact = []
    for a in range(3):
        swapped = [[rhs[i] if j == a else k_ff[i][j] for j in range(3)] for i in range(3)]
        exact.append(determinant(swapped) / determinant(k_ff))

    model = extended.ExtendedModel(
        np.array(nodes, dtype=np.float64),
        np.array([[0, 1, 2, 3]], dtype=np.uint32),
        [extended.isotropic(1.0, 0.25)],
        np.zeros(1, dtype=np.uint32),
    )
    motion = np.array([[float(v) for v in row] for row in u] + [[0.0] * 3])
    mask = np.array([True, True, True, False])
    found = extended.solve(model, mask, extended.Twofold(motion)).displacements[3]
    assert found.tolist() == [float(v) for v in exact]


def test_twofold_arithmetic_keeps_thirty_digits():
    """Sum, product and quotient of unevaluated pairs (Dekker 1971) against exact fractions."""
    rng = np.random.default_rng(0)
    high = rng.normal(size=(4, 50)) * 10.0 ** rng.integers(-8, 8, (4, 50))
    a = extended.Twofold(high[0], high[0] * rng.uniform(-1, 1, 50) * 1e-17)
    b = extended.Twofold(high[1], high[1] * rng.uniform(-1, 1, 50) * 1e-17)
    results = {"+": a + b, "-": a - b, "*": a * b, "/": a / b}
    for i in range(50):
        p = Fraction(a.hi[i]) + Fraction(a.lo[i])
        q = Fraction(b.hi[i]) + Fraction(b.lo[i])
        for sign, exact in (("+", p + q), ("-", p - q), ("*", p * q), ("/", p / q)):
            found = Fraction(results[sign].hi[i]) + Fraction(results[sign].lo[i])
            assert abs(found - exact) <= Fraction(1, 10**30) * (abs(p) + abs(q) + abs(exact))


def test_elasticity_of_equal_moduli_is_isotropic_for_any_fibre():
    """C_ijkl = λ δδ + μ (δδ + δδ): the turned inverse compliance with E_l = E_t (Saint-Venant)."""
    young, nu = 0.5, 0.25
    lame, mu = 0.2, 0.2
    found = extended.elasticity(extended.Material(young, young, nu, (0.6, 0.0, 0.8)))
    expected = np.diag([2 * mu] * 3 + [mu] * 3)
    expected[:3, :3] += lame
    for p, q in itertools.product(range(6), repeat=2):
        assert float(found[p][q]) == pytest.approx(expected[p, q], abs=1e-15)


@pytest.mark.parametrize("method", ALL)
@pytest.mark.parametrize("powers", [(-24, -30), (-20, -20), (12, 20), (14, 30)])
def test_units_by_powers_of_two_change_no_bit(method, powers):
    """u(s x; s t) = s u(x; t) and u(s E) = u(E): with s = 2^k every float64 operation scales
    exactly, so an absolute tolerance anywhere would show. As far as lengths and moduli are taken.
    """

    def solved(length, modulus):
        p = bodies.scaled(length, modulus)
        case = replace(CASES[0], build=lambda: p)
        return linear.run_cmfsim(case, method).displacements

    length, modulus = (2.0**power for power in powers)
    base = solved(1.0, 1.0)
    np.testing.assert_array_equal(solved(length, 1.0), length * base)
    np.testing.assert_array_equal(solved(1.0, modulus), base)


@pytest.mark.parametrize("method", FAST)
@pytest.mark.parametrize("angle", [30.0, 90.0, 180.0])
def test_the_plan_operator_is_exact_for_large_turns_at_contrast(method, angle):
    """u_b = (R − I)x + t is affine in (R, t), so 12 columns a segment hold for any turn; contrast
    1e4, against 32 digits.
    """
    p = replace(bodies.checkerboard(1e4), plan={"maxilla": bodies.advance(angle, 50.0)})
    model = extended.ExtendedModel(p.nodes, p.tets, p.materials, p.material_of)
    exact = extended.solve(model, *p.prescribed())
    young = np.array([m.along for m in p.materials])[p.material_of]
    tensors = cmfsim.MassTensors(
        cmfsim.TetMesh(p.nodes, p.tets), cmfsim.Tissue.isotropic(young, NU)
    )
    boundary = cmfsim.Boundary(fixed=p.fixed, joined=p.joined)
    operator = cmfsim.StaticSolver(tensors, boundary, method=method).plan_operator()
    error = np.abs(operator(p.plan) - exact.displacements).max()
    # Columns of an iterative method carry its tolerance, 1e-9 of each affine field of the segment.
    allowed = 1e-9 if method == "cholesky" else 1e-8
    assert error <= allowed * np.abs(exact.displacements).max()
