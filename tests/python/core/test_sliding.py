"""Sliding contact against exact answers (Kim et al. 2010, section 2.5, eq. 2)."""

import itertools

import numpy as np
import pytest

import cmfsim
from benches.scenes import meshes

YOUNG, POISSON = 0.5, 0.3
SIZE = (6.0, 5.0, 4.0)
ROTATIONS = {
    "level": np.eye(3),
    "inclined": meshes.rotation((1.0, 2.0, 0.5), 35.0),
    "vertical": meshes.rotation((0.0, 1.0, 0.0), 90.0),
}


def block(rotate, *, seed=0, contact_seed=None, contact_cells=1, gap=None, height=0.0, fibre=False):
    """A block on a plane: its lowest nodes slide, its highest are joined to a bone."""
    nodes, tets = meshes.box((4, 3, 3), SIZE, jitter=0.2, seed=seed)
    low = meshes.nodes_where(nodes[:, 2] == 0.0)
    high = meshes.nodes_where(nodes[:, 2] == SIZE[2])
    if fibre:
        tissue = cmfsim.Tissue.transversely_isotropic(
            0.8, 0.1, 0.4, meshes.unit_vectors(len(tets), seed)
        )
    else:
        tissue = cmfsim.Tissue.isotropic(YOUNG, POISSON)
    tensors = cmfsim.MassTensors(cmfsim.TetMesh(nodes @ rotate.T, tets), tissue)
    vertices, triangles = meshes.plane(40.0, contact_cells, seed=contact_seed)
    surface = cmfsim.Surface((vertices + [0, 0, height]) @ rotate.T, triangles)
    boundary = cmfsim.Boundary(
        joined={"top": high},
        sliding={"floor": low},
        contact={"floor": surface},
        gap=None if gap is None else {"floor": gap},
    )
    return nodes, tensors, boundary, low, high


def tangential(result):
    """Largest force along the surface at the sliding nodes, over the largest contact force."""
    f = result.forces[result.contact_nodes]
    along = np.einsum("si,si->s", f, result.contact_normals)
    rest = f - along[:, None] * result.contact_normals
    return np.abs(rest).max() / max(np.abs(along).max(), 1e-300)


@pytest.mark.parametrize("rotate", ROTATIONS.values(), ids=ROTATIONS.keys())
@pytest.mark.parametrize("method", ["cholesky", "pcg", "relaxation"])
def test_pressed_block_spreads_freely_on_a_plane(rotate, method):
    """Uniaxial compression e: u = (ν e x, ν e y, −e z), σ_zz = −E e, on any plane.

    The floor moves by d along its normal and by anything along itself; the highest nodes are
    prescribed by the exact field, the lowest slide without friction, the sides are free.
    """
    e, d = 0.03, 0.4
    nodes, tensors, boundary, low, high = block(rotate)
    exact = (nodes * [POISSON * e, POISSON * e, -e] + [0, 0, d]) @ rotate.T
    # The floor may also move along itself and turn about its normal: neither is felt.
    floor = np.eye(4)
    floor[:3, :3] = rotate @ meshes.rotation((0, 0, 1), 12.0) @ rotate.T
    floor[:3, 3] = rotate @ [0.7, -0.5, d]
    solver = cmfsim.StaticSolver(tensors, boundary, method)
    high_plan = {"top": exact[high], "floor": floor}
    result = solver.solve(high_plan)
    assert np.abs(result.displacements - exact).max() < 1e-6
    assert result.contact_gap < 1e-6
    normal = rotate @ [0.0, 0.0, 1.0]
    np.testing.assert_allclose(
        result.contact_normals, np.tile(normal, (len(low), 1)), rtol=0, atol=1e-12
    )
    # σ_zz over the floor's area, pushing the tissue away from it.
    assert result.contact_forces.sum() == pytest.approx(YOUNG * e * SIZE[0] * SIZE[1], rel=1e-6)
    assert tangential(result) < 1e-6
    stress = tensors.stress(result.displacements)
    voigt = [-YOUNG * e * np.outer(normal, normal)[i, j] for i, j in meshes.VOIGT]
    np.testing.assert_allclose(stress, np.tile(voigt, (len(stress), 1)), rtol=0, atol=1e-6)


@pytest.mark.parametrize("contact", ["bilateral", "unilateral"])
def test_sliding_nodes_end_on_the_moved_surface_without_tangential_force(contact):
    """n·(x + u − c) = 0 within 1e-6 mm and (I − n⊗n) f = 0 (Kim et al. 2010, eq. 2)."""
    nodes, tensors, boundary, _, _ = block(np.eye(3), fibre=True, contact_cells=3, contact_seed=1)
    plan = {
        "top": cmfsim.rigid_motion((0.2, 0.1, -0.6), 6.0, (1, 1, 0), (3, 2.5, 4)),
        "floor": cmfsim.rigid_motion((0.1, 0.0, 0.2), 5.0, (1, -1, 0), (3, 2.5, 0)),
    }
    result = cmfsim.StaticSolver(tensors, boundary, contact=contact).solve(plan)
    moved = boundary.contact["floor"].transformed(plan["floor"])
    at = (nodes + result.displacements)[result.contact_nodes]
    points, normals, _ = moved.closest(at)
    gaps = np.einsum("si,si->s", normals, at - points)
    np.testing.assert_allclose(result.contact_gaps, gaps, rtol=0, atol=1e-9)
    held = gaps < 1e-6
    assert held.any()
    if contact == "bilateral":
        assert np.abs(gaps).max() < 1e-6
    assert tangential(result) < 1e-6
    force = np.einsum("si,si->s", result.forces[result.contact_nodes], result.contact_normals)
    np.testing.assert_allclose(
        result.contact_forces, force, rtol=0, atol=1e-9 * np.abs(force).max()
    )


@pytest.mark.parametrize("contact", ["bilateral", "unilateral"])
def test_answer_does_not_depend_on_the_triangulation_of_a_flat_contact(contact):
    """A plane is a plane however it is cut into triangles."""
    plan = {
        "top": cmfsim.rigid_motion((0.3, 0.1, -0.4), 7.0, (1, 2, 0), (3, 2.5, 4)),
        "floor": cmfsim.rigid_motion((0.0, 0.0, 0.1), 4.0, (1, 1, 0), (3, 2.5, 0)),
    }
    answers = []
    for cells, seed in ((1, None), (7, 1), (24, 2)):
        _, tensors, boundary, _, _ = block(
            np.eye(3), contact_cells=cells, contact_seed=seed, fibre=True
        )
        solver = cmfsim.StaticSolver(tensors, boundary, contact=contact)
        answers.append(solver.solve(plan).displacements)
    for other in answers[1:]:
        assert np.abs(other - answers[0]).max() < 1e-9


def test_block_on_a_carried_floor_moves_with_it():
    """Floor and top shift alike: u = t everywhere, no stress, no contact force."""
    nodes, tensors, boundary, _, _ = block(ROTATIONS["inclined"], contact_cells=5, contact_seed=3)
    shift = (3.0, -1.0, 2.0)
    result = cmfsim.StaticSolver(tensors, boundary).solve(
        {"top": cmfsim.rigid_motion(shift), "floor": cmfsim.rigid_motion(shift)}
    )
    assert np.abs(result.displacements - shift).max() < 1e-9
    assert np.abs(result.contact_forces).max() < 1e-9
    assert result.displacements.shape == nodes.shape


def test_prescribed_gap_is_kept():
    """|x + u − c| = g for a gap of one number, of one per node, and of the place at rest."""
    plan = {"top": np.eye(4), "floor": cmfsim.rigid_motion((0.0, 0.0, 0.3))}
    wanted = np.linspace(-0.2, 0.4, 20)
    for gap, height, expected in (
        (0.25, 0.0, np.full(20, 0.25)),
        (wanted, 0.0, wanted),
        ("rest", -0.5, np.full(20, 0.5)),
    ):
        nodes, tensors, boundary, low, _ = block(np.eye(3), gap=gap, height=height)
        assert len(low) == 20
        result = cmfsim.StaticSolver(tensors, boundary).solve(plan)
        z = (nodes + result.displacements)[low, 2]
        np.testing.assert_allclose(z, height + 0.3 + expected, rtol=0, atol=1e-6)
        assert result.contact_gap < 1e-6


def test_unilateral_contact_lets_go():
    """Pulled up by t, a block that may lift off follows without stress: u = t, all forces zero."""
    _, tensors, boundary, _, _ = block(np.eye(3))
    plan = {"top": cmfsim.rigid_motion((0.1, 0.2, 0.5)), "floor": np.eye(4)}
    result = cmfsim.StaticSolver(tensors, boundary, contact="unilateral").solve(plan)
    assert np.abs(result.displacements - [0.1, 0.2, 0.5]).max() < 1e-9
    assert np.abs(result.contact_forces).max() < 1e-12
    np.testing.assert_allclose(result.contact_gaps, 0.5, rtol=0, atol=1e-9)
    held = cmfsim.StaticSolver(tensors, boundary, contact="bilateral").solve(plan)
    assert held.contact_forces.min() < -1e-3


def test_unilateral_contact_neither_penetrates_nor_pulls():
    """Signorini's conditions: gap ≥ 0, pressure ≥ 0, gap · pressure = 0, for a tilted block."""
    _, tensors, boundary, low, _ = block(np.eye(3), fibre=True, contact_cells=4, contact_seed=4)
    plan = {
        "top": cmfsim.rigid_motion((0.0, 0.0, -0.05), 6.0, (0, 1, 0), (3, 2.5, 4)),
        "floor": np.eye(4),
    }
    result = cmfsim.StaticSolver(tensors, boundary, contact="unilateral").solve(plan)
    assert sorted(result.contact_nodes) == sorted(low)
    gaps, forces = result.contact_gaps, result.contact_forces
    assert gaps.min() > -1e-6
    assert forces.min() > -1e-9 * forces.max()
    assert (np.minimum(gaps, forces / forces.max()) < 1e-6).all()
    # Both happen: some nodes press, some have lifted off.
    assert gaps.max() > 1e-2
    assert forces.max() > 1e-3


def test_pressed_unilateral_equals_bilateral():
    """Where nothing pulls, the two kinds of contact are the same."""
    e = 0.02
    nodes, tensors, boundary, _, high = block(np.eye(3))
    exact = nodes * [POISSON * e, POISSON * e, -e]
    plan = {"top": exact[high], "floor": np.eye(4)}
    answers = [
        cmfsim.StaticSolver(tensors, boundary, contact=c).solve(plan).displacements
        for c in ("bilateral", "unilateral")
    ]
    assert np.abs(answers[0] - answers[1]).max() < 1e-9


def shell_on_sphere(level, layers, contact_level):
    """A spherical shell whose inner nodes slide on a fine sphere and whose outer are joined."""
    nodes, tets, inner, outer = meshes.spherical_shell(level, layers, 10.0, 20.0)
    tensors = cmfsim.MassTensors(
        cmfsim.TetMesh(nodes, tets), cmfsim.Tissue.isotropic(YOUNG, POISSON)
    )
    ball = cmfsim.Surface(*meshes.icosphere(contact_level, 10.0))
    boundary = cmfsim.Boundary(
        joined={"shell": outer}, sliding={"ball": inner}, contact={"ball": ball}
    )
    return nodes, tets, tensors, boundary, outer


def test_shell_sliding_on_a_sphere_follows_lame():
    """u_r = A r + B/r² with u_r(a) = 0, u_r(b) = d (Lamé; Timoshenko & Goodier 1970, § 142).

    The inner nodes slide on the ball; symmetry keeps them from moving along it. The error falls
    with the mesh, and each node ends on the ball, whose triangles lie up to 0.02 mm within.
    """
    a, b, d = 10.0, 20.0, 0.5
    # A a + B/a² = 0 and A b + B/b² = d.
    uniform = d / (b - a**3 / b**2)
    inverse = -uniform * a**3

    def exact(x):
        r = np.linalg.norm(x, axis=1, keepdims=True)
        return x * (uniform + inverse / r**3)

    errors = []
    for level, layers in ((1, 3), (2, 6)):
        nodes, tets, tensors, boundary, outer = shell_on_sphere(level, layers, 4)
        result = cmfsim.StaticSolver(tensors, boundary, contact_tolerance=1e-8).solve(
            {"shell": exact(nodes)[outer], "ball": np.eye(4)}
        )
        errors.append(meshes.l2_error(nodes, tets, result.displacements, exact))
        at = (nodes + result.displacements)[result.contact_nodes]
        assert result.contact_gap < 1e-8
        assert np.abs(np.linalg.norm(at, axis=1) - a).max() < 0.01
        assert tangential(result) < 1e-6
    assert np.log2(errors[0] / errors[1]) > 1.7, errors


def test_shell_shifted_with_its_sphere_is_free_of_stress():
    """Sphere and shell shift alike: u = t exactly, on any triangulation."""
    _, _, tensors, boundary, _ = shell_on_sphere(1, 2, 1)
    shift = (4.0, -3.0, 2.0)
    result = cmfsim.StaticSolver(tensors, boundary, contact_tolerance=1e-8).solve(
        {"shell": cmfsim.rigid_motion(shift), "ball": cmfsim.rigid_motion(shift)}
    )
    assert np.abs(result.displacements - shift).max() < 1e-7


def test_swelling_sphere_presses_the_shell_as_lame_says():
    """A SurfaceMotion that swells the ball by s: u_r(a) = s, u_r(b) = 0 (Lamé)."""
    a, b, s = 10.0, 20.0, 0.3
    uniform = s / (a - b**3 / a**2)
    inverse = -uniform * b**3
    errors = []
    for level, layers in ((1, 3), (2, 6)):
        nodes, tets, tensors, boundary, _ = shell_on_sphere(level, layers, 4)
        ball = boundary.contact["ball"]
        motion = cmfsim.SurfaceMotion(ball, ball.vertices * (1 + s / a))
        result = cmfsim.StaticSolver(tensors, boundary).solve({"shell": np.eye(4), "ball": motion})
        errors.append(
            meshes.l2_error(
                nodes,
                tets,
                result.displacements,
                lambda x: x * (uniform + inverse / np.linalg.norm(x, axis=1, keepdims=True) ** 3),
            )
        )
        assert result.contact_forces.min() > 0.0
    assert np.log2(errors[0] / errors[1]) > 1.7, errors


def test_a_node_past_the_border_of_its_surface_is_an_error_that_names_it():
    """A contact surface too small for the tissue is said, not extrapolated."""
    nodes, tets = meshes.box((4, 3, 3), SIZE)
    low, high = (meshes.nodes_where(nodes[:, 2] == z) for z in (0.0, SIZE[2]))
    tensors = cmfsim.MassTensors(
        cmfsim.TetMesh(nodes, tets), cmfsim.Tissue.isotropic(YOUNG, POISSON)
    )
    vertices, triangles = meshes.plane(2.0, 2)
    boundary = cmfsim.Boundary(
        joined={"top": high},
        sliding={"floor": low},
        contact={"floor": cmfsim.Surface(vertices, triangles)},
    )
    with pytest.raises(cmfsim.ContactError, match=r"floor.*node"):
        cmfsim.StaticSolver(tensors, boundary).solve({"top": np.eye(4), "floor": np.eye(4)})


def test_a_contact_that_cannot_settle_ends_with_an_error():
    """One outer iteration does not settle a turned sphere: the error gives the gap."""
    _, _, tensors, boundary, _ = shell_on_sphere(1, 2, 3)
    solver = cmfsim.StaticSolver(tensors, boundary, contact_iterations=1)
    plan = {
        "shell": cmfsim.rigid_motion((0, 0, 0), 20.0, (0, 0, 1)),
        "ball": cmfsim.rigid_motion((0.5, 0, 0)),
    }
    with pytest.raises(cmfsim.ContactError, match=r"gap|settle") as caught:
        solver.solve(plan)
    assert not isinstance(caught.value, ValueError)


@pytest.mark.parametrize("method", ["pcg", "cholesky"])
def test_a_contact_that_stops_near_a_solution_is_a_result(method):
    """One or two steps too few leave a gap that no face shows: the result states it."""
    _, _, tensors, boundary, _ = shell_on_sphere(1, 2, 3)
    plan = {
        "shell": cmfsim.rigid_motion((0, 0, 0), 20.0, (0, 0, 1)),
        "ball": cmfsim.rigid_motion((0.5, 0, 0)),
    }
    whole = cmfsim.StaticSolver(tensors, boundary, method).solve(plan)

    def stopped(most):
        return cmfsim.StaticSolver(tensors, boundary, method, contact_iterations=most).solve(plan)

    # The last step allowed is solved accurately, and may end in balance by itself.
    last = whole.contact_iterations - 1
    ends = ((most, stopped(most)) for most in (last, last - 1))
    most, found = next((most, end) for most, end in ends if not end.contact_converged)
    assert found.contact_iterations == most
    assert 0.0 < found.contact_gap < 1e-3
    assert np.abs(found.displacements - whole.displacements).max() < 1e-3
    assert found.error_estimate >= np.abs(found.displacements - whole.displacements).max()


def test_closest_point_of_face_edge_and_vertex():
    """Closest features of a box, over the tie cases and ±1e-12 (Ericson 2005, section 5.1.5)."""
    corners = np.array(list(itertools.product((0.0, 1.0), repeat=3)))
    nodes, tets = meshes.box((1, 1, 1))
    surface = cmfsim.TetMesh(nodes, tets).surface()
    assert surface.is_closed
    assert surface.n_border_edges == 0
    assert surface.area == pytest.approx(6.0, rel=1e-14)
    assert surface.volume == pytest.approx(1.0, rel=1e-14)
    outside = 0.5 + (corners - 0.5) * 3.0
    np.testing.assert_allclose(surface.closest(outside)[0], corners, rtol=0, atol=1e-14)
    for shift in (-1e-12, 0.0, 1e-12):
        points, normals, _ = surface.closest([[0.3 + shift, 0.6, 1.7], [0.4, -2.0, 1.0 + shift]])
        np.testing.assert_allclose(points[0], [0.3 + shift, 0.6, 1.0], rtol=0, atol=1e-14)
        np.testing.assert_allclose(normals[0], [0, 0, 1], rtol=0, atol=1e-12)
        np.testing.assert_allclose(points[1], [0.4, 0.0, 1.0], rtol=0, atol=2e-12)


def test_winding_number_tells_inside_from_outside():
    """Generalised winding number (Jacobson 2013; Barill 2018): 1 inside, 0 outside."""
    ball = cmfsim.Surface(*meshes.icosphere(3, 2.0))
    rng = np.random.default_rng(0)
    points = rng.uniform(-3.0, 3.0, (200, 3))
    r = np.linalg.norm(points, axis=1)
    inside, outside = r < 1.9, r > 2.0
    found = ball.winding_number(points)
    assert found[inside].min() > 0.95
    assert np.abs(found[outside]).max() < 0.05


def test_no_motion_moves_nothing_though_the_surface_lies_off_the_nodes():
    """Without a word about gaps, nodes keep the distance that they have, as tissue on bone does."""
    nodes, tensors, boundary, low, _ = block(np.eye(3), height=-0.5)
    assert boundary.gap["floor"] == "rest"
    still = cmfsim.StaticSolver(tensors, boundary).solve({"top": np.eye(4), "floor": np.eye(4)})
    assert np.abs(still.displacements).max() < 1e-12
    pulled = block(np.eye(3), height=-0.5, gap=0.0)[2]
    moved = cmfsim.StaticSolver(tensors, pulled).solve({"top": np.eye(4), "floor": np.eye(4)})
    np.testing.assert_allclose((nodes + moved.displacements)[low, 2], -0.5, rtol=0, atol=1e-6)


@pytest.mark.parametrize("gap", [None, "rest"])
def test_a_surface_in_another_frame_is_refused(gap):
    """Nodes would slide along it at a distance that no tissue has."""
    _, tensors, boundary, _, _ = block(np.eye(3), gap=gap, height=-50.0)
    with pytest.raises(cmfsim.ContactError, match=r"\"floor\" lies 50\.0 mm from sliding node \d+"):
        cmfsim.StaticSolver(tensors, boundary)
