"""Every physical statement against an exact or closed-form answer."""

import itertools

import numpy as np
import pytest

import cmfsim
from benches.scenes import meshes

YOUNG, POISSON = 0.7, 0.3


def isotropic(nodes, tets, young=YOUNG, poisson=POISSON):
    return cmfsim.MassTensors(cmfsim.TetMesh(nodes, tets), cmfsim.Tissue.isotropic(young, poisson))


def random_fibres(nodes, tets, seed=0):
    """A random fibre in each tet, twenty times stiffer along."""
    tissue = cmfsim.Tissue.transversely_isotropic(
        0.8, 0.04, 0.43, meshes.unit_vectors(len(tets), seed)
    )
    return cmfsim.MassTensors(cmfsim.TetMesh(nodes, tets), tissue)


@pytest.mark.parametrize("build", [isotropic, random_fibres])
def test_rigid_translation_gives_no_force(build):
    """K t = 0 for uniform t: Σ_k K_jk = 0 (Cotin 2000)."""
    nodes, tets = meshes.random_body(60, seed=1)
    tensors = build(nodes, tets)
    force = tensors.force(np.tile([3.0, -2.0, 5.0], (len(nodes), 1)))
    assert np.abs(force).max() < 1e-12 * np.abs(tensors.vertex).max() * 5.0


@pytest.mark.parametrize("build", [isotropic, random_fibres])
def test_infinitesimal_rotation_gives_no_force(build):
    """K (ω × x) = 0: the linear strain of an infinitesimal rotation vanishes."""
    nodes, tets = meshes.random_body(60, seed=2)
    tensors = build(nodes, tets)
    u = np.cross([0.3, -0.2, 0.5], nodes)
    scale = np.abs(tensors.vertex).max() * np.abs(u).max()
    assert np.abs(tensors.force(u)).max() < 1e-12 * scale
    assert abs(tensors.energy(u)) < 1e-12 * scale * np.abs(u).max()


@pytest.mark.parametrize("build", [isotropic, random_fibres])
def test_vertex_tensor_is_minus_the_sum_of_its_edge_tensors(build):
    """K_jj = −Σ_k K_jk, with K_kj = K_jkᵀ (Cotin 2000)."""
    nodes, tets = meshes.random_body(50, seed=3)
    tensors = build(nodes, tets)
    total = np.zeros_like(tensors.vertex)
    np.add.at(total, tensors.edges[:, 0], tensors.edge)
    np.add.at(total, tensors.edges[:, 1], tensors.edge.transpose(0, 2, 1))
    assert np.abs(total + tensors.vertex).max() < 1e-12 * np.abs(tensors.vertex).max()


@pytest.mark.parametrize("build", [isotropic, random_fibres])
def test_force_is_the_sum_of_vertex_and_edge_tensors(build):
    """f_j = K_jj u_j + Σ_k K_jk u_k (Kim et al. 2010, eq. 1), and energy = ½ u·f."""
    nodes, tets = meshes.random_body(50, seed=4)
    tensors = build(nodes, tets)
    u = np.random.default_rng(0).normal(size=nodes.shape)
    expected = np.einsum("nij,nj->ni", tensors.vertex, u)
    j, k = tensors.edges.T
    np.add.at(expected, j, np.einsum("eij,ej->ei", tensors.edge, u[k]))
    np.add.at(expected, k, np.einsum("eji,ej->ei", tensors.edge, u[j]))
    force = tensors.force(u)
    np.testing.assert_allclose(force, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    assert tensors.energy(u) == pytest.approx(0.5 * np.sum(u * force), rel=1e-12)


@pytest.mark.parametrize("build", [isotropic, random_fibres])
def test_the_matrix_is_symmetric_with_exactly_six_zero_modes(build):
    """K = Kᵀ to 1e-12, K ≥ 0, and its null space is the six infinitesimal rigid motions."""
    nodes, tets = meshes.random_body(40, seed=5)
    matrix = build(nodes, tets).to_scipy()
    assert matrix.shape == (3 * len(nodes), 3 * len(nodes))
    dense = matrix.toarray()
    scale = np.abs(dense).max()
    assert np.abs(dense - dense.T).max() <= 1e-12 * scale
    eigenvalues = np.linalg.eigvalsh(dense)
    largest = eigenvalues[-1]
    assert np.abs(eigenvalues[:6]).max() < 1e-12 * largest
    assert eigenvalues[6] > 1e-8 * largest


def test_block_rows_hold_the_same_matrix_as_scipy():
    """`block_rows` is the BSR form with rows and columns 3·node + axis."""
    nodes, tets = meshes.random_body(20, seed=6)
    tensors = random_fibres(nodes, tets)
    indptr, columns, blocks = tensors.block_rows()
    dense = np.zeros((len(nodes), 3, len(nodes), 3))
    for j in range(len(nodes)):
        for at in range(int(indptr[j]), int(indptr[j + 1])):
            dense[j, :, columns[at], :] += blocks[at]
    np.testing.assert_array_equal(dense.reshape(3 * len(nodes), -1), tensors.to_scipy().toarray())


@pytest.mark.parametrize("method", ["cholesky", "pcg", "relaxation"])
@pytest.mark.parametrize("build", [isotropic, random_fibres])
def test_patch_of_any_tets_reproduces_uniform_strain(build, method):
    """Patch test (Irons 1966): u = G x on the boundary gives u = G x inside, for one material."""
    nodes, tets = meshes.box((3, 3, 3), (6.0, 5.0, 4.0), jitter=0.2, seed=7)
    tensors = (
        build(nodes, tets)
        if build is isotropic
        else cmfsim.MassTensors(
            cmfsim.TetMesh(nodes, tets),
            cmfsim.Tissue.transversely_isotropic(0.8, 0.04, 0.43, meshes.unit_vectors(1, 3)),
        )
    )
    gradient = np.array([[0.02, -0.01, 0.03], [0.005, -0.04, 0.0], [0.01, 0.02, 0.015]])
    exact = nodes @ gradient.T
    outer = meshes.outer_nodes(tets)
    boundary = cmfsim.Boundary(joined={"skin": outer})
    solver = cmfsim.StaticSolver(tensors, boundary, method=method)
    result = solver.solve({"skin": exact[outer]})
    assert np.abs(result.displacements - exact).max() < 1e-9
    strain = tensors.strain(result.displacements)
    symmetric = 0.5 * (gradient + gradient.T)
    voigt = [symmetric[i, j] * (1 if i == j else 2) for i, j in meshes.VOIGT]
    np.testing.assert_allclose(strain, np.tile(voigt, (len(tets), 1)), atol=1e-9)
    change = np.linalg.det(np.eye(3) + gradient) - 1.0
    np.testing.assert_allclose(tensors.volume_change(result.displacements), change, atol=1e-9)


@pytest.mark.parametrize(("along", "across"), [(0.8, 0.04), (0.5, 0.79), (0.01, 1.0)])
@pytest.mark.parametrize("degrees", [0.0, 30.0, 45.0, 60.0, 90.0])
def test_pulled_bar_stretches_by_the_closed_form(along, across, degrees):
    """Uniaxial stress σ at an angle θ to the fibre stretches by σ/E(θ).

    1/E(θ) = c⁴/E_l + s⁴/E_t + c²s² (1/G_lt − 2ν_lt/E_l) (Lekhnitskii 1963); with Saint-Venant's
    shear modulus this is c²/E_l + s²/E_t: the moduli themselves at 0° and 90°. The whole field is
    u = (S σ) x with S the compliance, here from an independent inverse, turned onto the fibre.
    """
    poisson, pull = 0.43, 0.01
    theta = np.radians(degrees)
    fibre = np.array([np.cos(theta), np.sin(theta), 0.0])
    nodes, tets = meshes.box((6, 2, 2), (30.0, 8.0, 6.0), jitter=0.15, seed=8)
    mesh = cmfsim.TetMesh(nodes, tets)
    tissue = cmfsim.Tissue.transversely_isotropic(along, across, poisson, fibre)
    tensors = cmfsim.MassTensors(mesh, tissue)

    stiffness = meshes.tensor_to_voigt(meshes.fibre_tensor(along, across, poisson, fibre))
    strain = np.linalg.solve(stiffness, [pull, 0, 0, 0, 0, 0])
    assert strain[0] == pytest.approx(
        pull * (np.cos(theta) ** 2 / along + np.sin(theta) ** 2 / across)
    )
    gradient = np.zeros((3, 3))
    for value, (i, j) in zip(strain, meshes.VOIGT, strict=True):
        gradient[i, j] = gradient[j, i] = value if i == j else value / 2
    exact = nodes @ gradient

    triangles = mesh.boundary_triangles()
    end, start = ((nodes[triangles][:, :, 0] == x).all(axis=1) for x in (30.0, 0.0))
    loads = meshes.surface_loads(nodes, triangles[end], np.array([pull, 0, 0]))
    loads += meshes.surface_loads(nodes, triangles[start], np.array([-pull, 0, 0]))
    # Three nodes that are not in line hold the bar; their reactions are the loads there.
    held = meshes.nodes_where((nodes == [0, 0, 0]).all(axis=1) | (nodes == [30, 0, 0]).all(axis=1))
    held = np.append(held, meshes.nodes_where((nodes == [0, 8, 0]).all(axis=1)))
    boundary = cmfsim.Boundary(joined={"grips": held})
    result = cmfsim.StaticSolver(tensors, boundary).solve({"grips": exact[held]}, loads=loads)
    scale = np.abs(exact).max()
    assert np.abs(result.displacements - exact).max() < 1e-10 * scale
    assert np.abs(result.forces - loads).max() < 1e-10 * np.abs(loads).max()
    stress = tensors.stress(result.displacements)
    np.testing.assert_allclose(stress, np.tile([pull, 0, 0, 0, 0, 0], (len(tets), 1)), atol=1e-11)


def test_stiffness_is_the_inverse_of_the_engineering_compliance():
    """C = S⁻¹ turned onto the fibre, for ratios E_l/E_t of 1e-3 to 1e3."""
    fibres = meshes.unit_vectors(5, 9)
    for (ratio, poisson), fibre in itertools.product(
        itertools.product((1e-3, 0.1, 1.0, 10.0, 1e3), (0.0, 0.3, 0.49)), fibres
    ):
        tissue = cmfsim.Tissue.transversely_isotropic(0.5 * ratio, 0.5, poisson, fibre)
        expected = meshes.tensor_to_voigt(meshes.fibre_tensor(0.5 * ratio, 0.5, poisson, fibre))
        found = tissue.stiffness()[0]
        assert np.abs(found - expected).max() < 1e-9 * np.abs(expected).max()
        assert tissue.smallest_eigenvalues()[0] > 0.0


def test_equal_moduli_give_the_isotropic_stiffness():
    """E_l = E_t makes the fibre law isotropic, with G_lt = E/2(1+ν)."""
    fibre = meshes.unit_vectors(1, 10)[0]
    found = cmfsim.Tissue.transversely_isotropic(0.6, 0.6, 0.4, fibre).stiffness()
    expected = cmfsim.Tissue.isotropic(0.6, 0.4).stiffness()
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13)


def test_presets_mix_moduli_as_the_paper_does():
    """E = E_fat (1−p) + E_muscle p for each modulus (Kim et al. 2010, section 2.3, Table 1)."""
    fraction = np.array([0.0, 0.25, 1.0])
    fibre = meshes.unit_vectors(3, 11)
    for name, along, across in (("kim2010", 0.5, 0.79), ("kim2010-swapped", 0.79, 0.5)):
        found = cmfsim.Tissue.preset(name, fraction, fibre).stiffness()
        for p, a, c in zip(fraction, fibre, found, strict=True):
            fat, nu = 0.003 * (1 - p), 0.46 * (1 - p) + 0.43 * p
            expected = meshes.fibre_tensor(fat + along * p, fat + across * p, nu, a)
            scale = np.abs(c).max()
            assert np.abs(meshes.tensor_to_voigt(expected) - c).max() < 1e-10 * scale


def test_stiffness_mixing_is_the_weighted_sum():
    """C = p C_muscle + (1−p) C_fat with mixing="stiffness"."""
    fraction, fibre = np.array([0.3, 0.9]), meshes.unit_vectors(2, 12)
    found = cmfsim.Tissue.preset("kim2010", fraction, fibre, mixing="stiffness").stiffness()
    fat = meshes.tensor_to_voigt(meshes.isotropic_tensor(0.003, 0.46))
    for p, a, c in zip(fraction, fibre, found, strict=True):
        muscle = meshes.tensor_to_voigt(meshes.fibre_tensor(0.5, 0.79, 0.43, a))
        assert np.abs(p * muscle + (1 - p) * fat - c).max() < 1e-12 * np.abs(c).max()


def test_lame_thick_sphere_converges_with_order_two():
    """Lamé's sphere under inner pressure p (Timoshenko & Goodier 1970, § 142).

    u_r = A r + B/r², A = p a³(1−2ν)/(E(b³−a³)), B = p a³b³(1+ν)/(2E(b³−a³)), prescribed on both
    spheres: the linear tets converge to it in L2 with observed order ≥ 1.9.
    """
    a, b, pressure = 10.0, 20.0, 0.05
    cube = b**3 - a**3
    uniform = pressure * a**3 * (1 - 2 * POISSON) / (YOUNG * cube)
    inverse = pressure * a**3 * b**3 * (1 + POISSON) / (2 * YOUNG * cube)

    def exact(x):
        r = np.linalg.norm(x, axis=1, keepdims=True)
        return x * (uniform + inverse / r**3)

    errors = []
    for level, layers in ((1, 3), (2, 6), (3, 12)):
        nodes, tets, inner, outer = meshes.spherical_shell(level, layers, a, b)
        tensors = isotropic(nodes, tets)
        boundary = cmfsim.Boundary(joined={"inside": inner, "outside": outer})
        u = exact(nodes)
        result = cmfsim.StaticSolver(tensors, boundary).solve(
            {"inside": u[inner], "outside": u[outer]}
        )
        errors.append(meshes.l2_error(nodes, tets, result.displacements, exact))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert orders[-1] >= 1.9, (errors, orders)
    assert errors[-1] < 1e-2


@pytest.mark.parametrize(
    "tensor",
    [
        pytest.param(meshes.isotropic_tensor(YOUNG, POISSON), id="isotropic"),
        pytest.param(meshes.fibre_tensor(0.8, 0.1, 0.4, meshes.unit_vectors(1, 13)[0]), id="fibre"),
    ],
)
def test_manufactured_waves_converge_with_order_two(tensor):
    """Manufactured solution u = Σ a sin(w·x + φ), any C (Roache 2002): observed order ≥ 1.9 in L2.

    The body force is b_i = −C_ijkl u_k,lj = Σ C_ijkl a_k w_l w_j sin(w·x + φ), as consistent nodal
    loads; u is prescribed on the boundary.
    """
    waves = [
        (np.array([0.10, -0.05, 0.08]), np.array([0.20, 0.12, -0.08]), 0.3),
        (np.array([-0.04, 0.09, 0.06]), np.array([-0.05, 0.18, 0.16]), 1.1),
    ]

    def exact(x):
        return sum(a * np.sin(x @ w + phase)[:, None] for a, w, phase in waves)

    def body_force(x):
        return sum(
            np.einsum("ijkl,k,l,j->i", tensor, a, w, w) * np.sin(x @ w + phase)[:, None]
            for a, w, phase in waves
        )

    tissue = cmfsim.Tissue.from_stiffness(meshes.tensor_to_voigt(tensor))
    errors = []
    for cells in (4, 8, 16):
        nodes, tets = meshes.box((cells,) * 3, (10.0, 10.0, 10.0))
        tensors = cmfsim.MassTensors(cmfsim.TetMesh(nodes, tets), tissue)
        outer = meshes.outer_nodes(tets)
        boundary = cmfsim.Boundary(joined={"skin": outer})
        result = cmfsim.StaticSolver(tensors, boundary).solve(
            {"skin": exact(nodes)[outer]}, loads=meshes.body_loads(nodes, tets, body_force)
        )
        errors.append(meshes.l2_error(nodes, tets, result.displacements, exact))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert orders[-1] >= 1.9, (errors, orders)


def test_forces_balance():
    """Σ f_j = 0 and Σ x_j × f_j = 0: internal forces are in equilibrium (Newton)."""
    nodes, tets = meshes.random_body(80, seed=14)
    tensors = random_fibres(nodes, tets)
    low = meshes.nodes_where(nodes[:, 2] == 0.0)
    high = meshes.nodes_where(nodes[:, 2] == 10.0)
    boundary = cmfsim.Boundary(fixed=low, joined={"bone": high})
    result = cmfsim.StaticSolver(tensors, boundary).solve(
        {"bone": cmfsim.rigid_motion((1, 2, 3), 10, (1, 1, 0), (5, 5, 10))}
    )
    scale = np.abs(result.forces).max()
    assert scale > 0.0
    assert np.abs(result.forces.sum(axis=0)).max() < 1e-11 * scale
    assert np.abs(np.cross(nodes, result.forces).sum(axis=0)).max() < 1e-10 * scale
    free = np.setdiff1d(np.arange(len(nodes)), np.concatenate([low, high]))
    assert np.abs(result.forces[free]).max() < 1e-12 * scale
