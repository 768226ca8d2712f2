"""Elements and kinematics against scikit-fem, and as scenes ask for them.

The references share nothing with the core: scikit-fem's spaces, quadrature and assembly, numpy's
and scipy's linear algebra.
"""

import numpy as np
import pytest
from numpy.typing import NDArray

import cmfsim
from benches.scenes import meshes

skfem = pytest.importorskip("skfem")
from skfem.models.elasticity import linear_elasticity  # noqa: E402

from benches.scenes.independent import (  # noqa: E402
    corotational_stress,
    internal_forces,
    lame,
    neo_hookean_stress,
    space_of,
)
from benches.scenes.panels import BEAM, COOK, far_side_loads, panel  # noqa: E402

Array = NDArray[np.float64]
STILL = np.eye(4)


def jittered(cells: tuple[int, int, int]) -> cmfsim.TetMesh:
    """A box with edges of 1 mm, its inner nodes out of place."""
    return cmfsim.TetMesh(*meshes.box(cells, cells, jitter=0.1, seed=4))


def plate(z: float, reach: float, *, up: bool) -> cmfsim.Surface:
    """A square in the plane at z, normal up or down."""
    vertices = [(-reach, -reach, z), (reach, -reach, z), (reach, reach, z), (-reach, reach, z)]
    triangles = [(0, 1, 2), (0, 2, 3)] if up else [(0, 2, 1), (0, 3, 2)]
    return cmfsim.Surface(vertices, triangles)


@pytest.mark.parametrize("element", ["p1", "p2"])
def test_stiffness_is_that_of_scikit_fem(element: str) -> None:
    mesh = jittered((3, 2, 2))
    tensors = cmfsim.MassTensors(mesh, cmfsim.Tissue.isotropic(0.01, 0.45), element=element)
    basis, order = space_of(mesh, element, tensors)
    reference = skfem.asm(linear_elasticity(*lame(0.01, 0.45)), basis)
    ours = tensors.to_scipy().tocsr()
    flat = order.ravel()
    difference = abs(ours - reference[flat][:, flat]).max()
    # Both sum the same two dozen tets in another order.
    assert difference < 1e-12 * abs(reference).max()


@pytest.mark.parametrize("poisson", [0.3, 0.4999])
def test_quadratic_displacements_are_those_of_scikit_fem(poisson: float) -> None:
    mesh = jittered((4, 2, 2))
    tensors = cmfsim.MassTensors(mesh, cmfsim.Tissue.isotropic(0.01, poisson), element="p2")
    basis, order = space_of(mesh, "p2", tensors)
    x = tensors.nodes[:, 0]
    turn = cmfsim.rigid_motion(translation=(0.3, -0.1, 0.2), angle=5.0, axis=(1, 1, 0))
    corners = mesh.nodes[:, 0]
    boundary = cmfsim.Boundary(
        fixed=np.flatnonzero(corners < 1e-9), joined={"bone": np.flatnonzero(corners > 4 - 1e-9)}
    )
    found = cmfsim.StaticSolver(tensors, boundary, "cholesky").solve({"bone": turn})

    prescribed = np.zeros(basis.N)
    moved = x > 4 - 1e-9
    field = tensors.nodes[moved] @ (turn[:3, :3] - np.eye(3)).T + turn[:3, 3]
    prescribed[order[moved]] = field
    held = np.concatenate([order[moved].ravel(), order[x < 1e-9].ravel()])
    stiffness = skfem.asm(linear_elasticity(*lame(0.01, poisson)), basis)
    solved = skfem.solve(*skfem.condense(stiffness, x=prescribed, D=held))
    error = np.abs(found.all_displacements - solved[order]).max()
    assert error < 1e-8 * np.abs(solved).max()
    assert np.array_equal(found.displacements, found.all_displacements[: mesh.n_nodes])


@pytest.mark.parametrize("element", ["p1", "p2"])
@pytest.mark.parametrize(
    ("kinematics", "stress"),
    [("hyperelastic", neo_hookean_stress), ("corotational", corotational_stress)],
)
def test_large_forces_are_those_that_scikit_fem_assembles(element, kinematics, stress) -> None:
    mesh = jittered((2, 2, 2))
    tensors = cmfsim.MassTensors(mesh, cmfsim.Tissue.isotropic(0.01, 0.45), element=element)
    x = tensors.nodes
    turn = cmfsim.rigid_motion(angle=70.0, axis=(1, 2, -1))[:3, :3]
    bent = np.stack([0.1 * x[:, 1] ** 2, -0.05 * x[:, 0] * x[:, 2], 0.08 * x[:, 0] ** 2], axis=1)
    u = (x + bent) @ turn.T - x
    reference = internal_forces(mesh, tensors, u, stress, 0.01, 0.45)
    ours = tensors.force(u, kinematics=kinematics)
    assert np.abs(ours - reference).max() < 1e-12 * np.abs(reference).max()


@pytest.mark.parametrize("kinematics", ["linear", "corotational", "hyperelastic"])
@pytest.mark.parametrize("element", ["p1", "anp", "p2"])
def test_tangent_is_the_slope_of_force(element: str, kinematics: str) -> None:
    mesh = jittered((2, 1, 1))
    fibre = np.array([0.6, 0.0, 0.8])
    tissue = cmfsim.Tissue.transversely_isotropic(0.5, 0.2, 0.43, fibre)
    tensors = cmfsim.MassTensors(mesh, tissue, element=element)
    rng = np.random.default_rng(2)
    u, d = 0.1 * rng.standard_normal((2, *tensors.nodes.shape))
    step = 1e-6

    def force(s: float) -> Array:
        return tensors.force(u + s * d, kinematics=kinematics)

    slope = (force(step) - force(-step)) / (2 * step)
    product = tensors.tangent(u, kinematics=kinematics) @ d.ravel()
    assert np.abs(product - slope.ravel()).max() < 1e-7 * np.abs(slope).max()
    energy = [tensors.energy(u + s * d, kinematics=kinematics) for s in (step, -step)]
    work = float(np.sum(force(0.0) * d))
    assert (energy[0] - energy[1]) / (2 * step) == pytest.approx(work, rel=1e-7)


# Bending and shear near incompressibility.


def tip(element: str, poisson: float, corners: Array, cells: int, load: float) -> float:
    """Rise of the far upper corner of a panel in plane strain under a shear load, E = 1 MPa.

    The two sides slide on planes that stay: plane strain.
    """
    depth = 4.0
    mesh = cmfsim.TetMesh(*panel((cells, cells, 1), corners, depth))
    tensors = cmfsim.MassTensors(mesh, cmfsim.Tissue.isotropic(1.0, poisson), element=element)
    nodes, far = mesh.nodes, corners[2]
    low, high = nodes[:, 2] < 1e-9, nodes[:, 2] > depth - 1e-9
    boundary = cmfsim.Boundary(
        fixed=np.flatnonzero(nodes[:, 0] < 1e-9),
        sliding={"low": np.flatnonzero(low), "high": np.flatnonzero(high)},
        contact={"low": plate(0.0, 200.0, up=True), "high": plate(depth, 200.0, up=False)},
        conflicts="resolve",
    )
    loads = far_side_loads(mesh, tensors, corners, load)
    solution = cmfsim.StaticSolver(tensors, boundary).solve(
        {"low": STILL, "high": STILL}, loads=loads
    )
    top = np.linalg.norm(nodes[:, :2] - far, axis=1) < 1e-9
    return float(solution.displacements[top, 1].mean())


def plane_strain_tip(poisson: float, corners: Array, load: float) -> float:
    """The same in two dimensions, per unit depth of `tip`, by quadratic scikit-fem squares."""
    side = np.linspace(0, 1, 17)
    square = skfem.MeshQuad.init_tensor(side, side)
    s, t = square.p
    a, b, c, d = (corner[:, None] for corner in corners)
    moved = (1 - s) * (1 - t) * a + s * (1 - t) * b + s * t * c + (1 - s) * t * d
    space = skfem.MeshQuad(moved, square.t)
    basis = skfem.Basis(space, skfem.ElementVector(skfem.ElementQuad2()), intorder=6)
    far = corners[2, 0]
    facets = space.facets_satisfying(lambda x: np.abs(x[0] - far) < 1e-9)
    edge = skfem.FacetBasis(space, skfem.ElementVector(skfem.ElementQuad2()), facets=facets)
    traction = load / 4.0 / np.linalg.norm(corners[2] - corners[1])

    @skfem.LinearForm
    def pull(v, _):
        return traction * v[1]

    stiffness = skfem.asm(linear_elasticity(*lame(1.0, poisson)), basis)
    held = basis.get_dofs(lambda x: x[0] < 1e-9).all()
    u = skfem.solve(*skfem.condense(stiffness, pull.assemble(edge), D=held))
    at = np.argmin(np.linalg.norm(space.p - corners[2][:, None], axis=0))
    return float(u[basis.nodal_dofs[1, at]])


RATIOS = (0.3, 0.45, 0.49, 0.499, 0.4999)


@pytest.mark.parametrize("corners", [COOK, BEAM], ids=["cook", "beam"])
def test_linear_tets_lock_and_the_others_do_not(corners: Array) -> None:
    """Cook's membrane (1974) and a cantilever as nu nears 1/2, over the plane-strain reference."""
    share = {
        (element, poisson): tip(element, poisson, corners, cells, 1e-3) / reference
        for poisson, reference in ((nu, plane_strain_tip(nu, corners, 1e-3)) for nu in RATIOS)
        for element, cells in (("p1", 12), ("anp", 12), ("p2", 6))
    }
    for poisson in RATIOS:
        assert share["anp", poisson] > 0.72
        assert abs(share["p2", poisson] - 1.0) < 0.09
    for element in ("anp", "p2"):
        assert share[element, 0.4999] > 0.87 * share[element, 0.3]
    assert share["p1", 0.4999] < 0.35 * share["p1", 0.3]


def scene(**options: str) -> cmfsim.Scene:
    mesh = jittered((3, 2, 2))
    x = mesh.nodes[:, 0]
    return cmfsim.Scene(
        nodes=mesh.nodes,
        tets=mesh.tets,
        tissue=cmfsim.TissueData("isotropic", young=0.003, poisson=0.46),
        fixed=np.flatnonzero(x < 1e-9),
        segments={"bone": cmfsim.SegmentData(joined=np.flatnonzero(x > 3 - 1e-9))},
        plan={"bone": cmfsim.rigid_motion((0.4, 0.0, 0.2), 20.0, (0, 1, 0))},
        options=cmfsim.SolverOptions(**options),
    )


def test_a_scene_says_element_and_kinematics_and_keeps_them_in_its_file(tmp_path) -> None:
    asked = scene(element="anp", kinematics="corotational")
    cmfsim.write_scene(tmp_path / "scene.npz", asked)
    found = cmfsim.read_scene(tmp_path / "scene.npz")
    assert found.options == asked.options
    assert found.sha256() == asked.sha256() != scene().sha256()
    solver = cmfsim.scene_solver(found)
    assert (solver.tensors.element, solver.kinematics) == ("anp", "corotational")
    result = cmfsim.solve_scene(found)
    assert (result.summary["element"], result.summary["kinematics"]) == ("anp", "corotational")
    assert result.summary["residual"] < 1e-8


def test_a_scene_that_asks_for_neither_is_as_it_was() -> None:
    solver = scene().header()["solver"]
    assert "element" not in solver
    assert "kinematics" not in solver
    usual = cmfsim.solve_scene(scene())
    named = cmfsim.solve_scene(scene(element="p1", kinematics="linear"))
    assert usual.summary["scene_sha256"] == named.summary["scene_sha256"]
    assert np.array_equal(usual.displacements, named.displacements)


def test_results_are_those_of_the_corners() -> None:
    asked = scene(element="p2")
    result = cmfsim.solve_scene(asked)
    assert result.displacements.shape == result.forces.shape == (asked.n_nodes, 3)
    solver = cmfsim.scene_solver(asked)
    solution = solver.solve(cmfsim.scene_plan(asked))
    assert solution.all_displacements.shape == solver.tensors.nodes.shape
    assert np.abs(solution.all_forces.sum(axis=0)).max() < 1e-12 * np.abs(solution.all_forces).max()


def test_unknown_names_and_what_is_only_linear_are_refused() -> None:
    mesh = jittered((2, 1, 1))
    tissue = cmfsim.Tissue.isotropic(0.003, 0.46)
    tensors = cmfsim.MassTensors(mesh, tissue)
    boundary = cmfsim.Boundary(fixed=np.flatnonzero(mesh.nodes[:, 0] < 1e-9))
    with pytest.raises(cmfsim.MeshError, match="p1, anp, p2"):
        cmfsim.MassTensors(mesh, tissue, element="q1")
    with pytest.raises(cmfsim.SolverError, match="linear, corotational, hyperelastic"):
        cmfsim.StaticSolver(tensors, boundary, kinematics="finite")
    with pytest.raises(cmfsim.SolverError, match="relaxation"):
        cmfsim.StaticSolver(tensors, boundary, "relaxation", kinematics="corotational")
    large = cmfsim.StaticSolver(tensors, boundary, kinematics="corotational")
    with pytest.raises(cmfsim.SolverError, match="plan operator"):
        large.plan_operator()
    with pytest.raises(cmfsim.SolverError, match="kinematics"):
        tensors.energy(np.zeros((mesh.n_nodes, 3)), kinematics="rigid")
    quadratic = cmfsim.MassTensors(mesh, tissue, element="p2")
    with pytest.raises(cmfsim.MeshError, match="mid-edge"):
        quadratic.force(np.zeros((mesh.n_nodes, 3)))
    with pytest.raises(cmfsim.CaseError, match="element"):
        cmfsim.SolverOptions(element="P2")
    with pytest.raises(cmfsim.CaseError, match="kinematics"):
        cmfsim.SolverOptions(kinematics="")
