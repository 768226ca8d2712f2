"""The true tissue of virtual patients against closed forms, the linear solver and differences."""

from dataclasses import replace

import numpy as np
import pytest

import cmfsim
from benches.scenes import meshes
from cmfsim.errors import CaseInputError, SolverError
from cmfsim.lab.virtual.mechanics.body import (
    CRUSHED,
    CRUSHED_PRESSURE,
    FAT,
    MUSCLE,
    HyperelasticBody,
    HyperelasticTissue,
    Moduli,
    SkinLayer,
)
from cmfsim.lab.virtual.mechanics.equilibrium import EquilibriumOptions, find_equilibrium
from cmfsim.lab.virtual.operation import ONSET, BoneContact, SmoothDistance, screw

TIGHT = EquilibriumOptions(steps=1, tolerance=1e-10, loose=1e-4)


def gradients(count: int, size: float, seed: int = 0) -> np.ndarray:
    """F of tets, (3, 3, m), about the identity."""
    noise = size * np.random.default_rng(seed).normal(size=(3, 3, count))
    return np.eye(3)[:, :, None] + noise


def mixture(count: int, seed: int = 0) -> HyperelasticTissue:
    """Fat, muscle and tets between them with fibres of all directions."""
    fraction = np.random.default_rng(seed).random(count)
    fraction[::3], fraction[1::3] = 0.0, 1.0
    return HyperelasticTissue.mixed(fraction, meshes.unit_vectors(count, seed))


def cube(cells: int = 3, jitter: float = 0.2):
    """A jittered cube of 10 mm."""
    return meshes.box((cells,) * 3, (10.0,) * 3, jitter=jitter, seed=3)


def on_border(nodes: np.ndarray) -> np.ndarray:
    """The nodes of the outside of the cube."""
    return np.flatnonzero(((nodes < 1e-9) | (nodes > 10.0 - 1e-9)).any(axis=1))


def test_skin_replaces_fat_and_muscle_by_its_share():
    """All skin has the constants of skin alone; a half has the mean, and no fibre is lost."""
    fraction, fibre = np.array([0.0, 0.7, 0.7]), np.tile([0.0, 0.6, 0.8], (3, 1))
    skin = Moduli(0.1, 0.1, 0.46)
    share = np.array([1.0, 1.0, 0.5])
    own = Moduli(0.02, 0.01, 0.4)
    soft = replace(FAT, poisson=0.35)
    found = HyperelasticTissue.mixed(
        fraction, fibre, muscle=own, fat=soft, skin=SkinLayer(skin, share)
    )
    young, nu = 0.1, 0.46
    mu, lambda_ = young / (2 * (1 + nu)), young * nu / ((1 + nu) * (1 - 2 * nu))
    assert found.mu[:2] == pytest.approx(mu)
    assert found.lambda_[:2] == pytest.approx(lambda_)
    assert np.abs([found.alpha[:2], found.beta[:2]]).max() < 1e-12
    below = 0.3 * soft.spencer() + 0.7 * own.spencer()
    half = 0.5 * (below + skin.spencer())
    constants = [found.lambda_, found.mu, found.alpha, found.difference, found.beta]
    assert [c[2] for c in constants] == pytest.approx(half)


def test_stress_is_the_derivative_of_energy():
    """P : dF against central differences of ψ, at strains up to 50 %."""
    tissue, f = mixture(40), gradients(40, 0.15)
    way, step = np.random.default_rng(1).normal(size=f.shape), 1e-6
    difference = (tissue.energy(f + step * way) - tissue.energy(f - step * way)) / (2.0 * step)
    work = (tissue.stress(f) * way).sum(axis=(0, 1))
    assert np.abs(work - difference).max() < 1e-7 * np.abs(work).max()


def test_stress_and_tangent_are_derivatives_where_tissue_is_crushed():
    """J from −0.3 to 0.5, on both sides of `CRUSHED`, against central differences."""
    tissue, f = mixture(50), gradients(50, 0.05, seed=7)
    f[2] *= np.linspace(-0.3, 0.5, 50)
    det = np.linalg.det(f.transpose(2, 0, 1))
    assert det.min() < 0.0 < CRUSHED < det.max()
    way, step = np.random.default_rng(8).normal(size=f.shape), 1e-6
    difference = (tissue.energy(f + step * way) - tissue.energy(f - step * way)) / (2.0 * step)
    work = (tissue.stress(f) * way).sum(axis=(0, 1))
    assert np.abs(work - difference).max() < 1e-7 * np.abs(work).max()
    difference = (tissue.stress(f + step * way) - tissue.stress(f - step * way)) / (2.0 * step)
    change = np.einsum("tij,jt->it", tissue.tangent(f), way.reshape(9, -1))
    assert np.abs(change - difference.reshape(9, -1)).max() < 1e-6 * np.abs(change).max()


def test_crushed_tissue_is_several_times_as_stiff():
    """Fat pressed flat along one axis: the pressure at J = 0 against the law without the term."""
    tissue = HyperelasticTissue.mixed(np.zeros(1), np.ones((1, 3)))
    flat = np.diag([1.0, 1.0, 0.0])[:, :, None]
    bulk = tissue.lambda_ + tissue.mu
    expected = -(1.0 + CRUSHED_PRESSURE) * bulk - tissue.mu
    assert tissue.stress(flat)[2, 2] == pytest.approx(expected, rel=1e-12)


def test_stiffness_is_the_derivative_of_forces():
    """Blocks of the body against central differences of scikit-fem's forces, and symmetric."""
    nodes, tets = cube()
    body = HyperelasticBody(nodes, tets, mixture(len(tets)))
    generator = np.random.default_rng(5)
    u, way = 0.15 * generator.normal(size=nodes.shape), generator.normal(size=nodes.shape)
    assert body.volume_ratios(u).min() > 0.0
    step = 1e-6
    difference = (body.forces(u + step * way) - body.forces(u - step * way)) / (2.0 * step)
    matrix = body.stiffness(u)
    product = (matrix @ way.ravel()).reshape(-1, 3)
    assert np.abs(product - difference).max() < 1e-6 * np.abs(difference).max()
    assert abs(matrix - matrix.T).max() < 1e-12 * abs(matrix).max()


def test_convex_stiffness_resists_every_deformation():
    """Fat at strains of 100 %: no negative eigenvalue, where the true stiffness has some."""
    nodes, tets = cube()
    tissue = HyperelasticTissue.mixed(np.zeros(len(tets)), np.ones((len(tets), 3)))
    body = HyperelasticBody(nodes, tets, tissue)
    u = 0.35 * np.random.default_rng(2).normal(size=nodes.shape)
    assert body.volume_ratios(u).min() > 0.0
    true = np.linalg.eigvalsh(body.stiffness(u).toarray())
    convex = np.linalg.eigvalsh(body.stiffness(u, convex=True).toarray())
    assert true[0] < -1e-3 * true[-1]
    assert convex[0] > -1e-12 * convex[-1]


def test_forces_are_the_derivative_of_energy():
    """Scikit-fem's forces against central differences of the energy."""
    nodes, tets = cube()
    body = HyperelasticBody(nodes, tets, mixture(len(tets)))
    generator = np.random.default_rng(6)
    u, way = 0.15 * generator.normal(size=nodes.shape), generator.normal(size=nodes.shape)
    step = 1e-5
    difference = (body.energy(u + step * way) - body.energy(u - step * way)) / (2.0 * step)
    assert (body.forces(u) * way).sum() == pytest.approx(difference, rel=1e-6)


def test_turning_the_deformed_tissue_turns_its_stress():
    """ψ(QF) = ψ(F) and P(QF) = Q P(F) for a turn by 137°; no stress in what is only turned."""
    tissue, f = mixture(30), gradients(30, 0.2, seed=2)
    turn = meshes.rotation((1.0, 2.0, -0.5), 137.0)
    turned = np.einsum("ij,jkt->ikt", turn, f)
    assert np.abs(tissue.energy(turned) - tissue.energy(f)).max() < 1e-13
    expected = np.einsum("ij,jkt->ikt", turn, tissue.stress(f))
    assert np.abs(tissue.stress(turned) - expected).max() < 1e-13 * np.abs(expected).max() * 100
    rigid = np.repeat(turn[:, :, None], 30, axis=2)
    assert np.abs(tissue.stress(rigid)).max() < 1e-13
    assert np.abs(tissue.energy(rigid)).max() < 1e-14


def test_flattened_and_inverted_tets_have_finite_energy_that_pushes_them_back():
    """At J = 0 and −0.2 energy and stress are finite, and widening along the axis lowers ψ."""
    for tissue in (mixture(30), HyperelasticTissue.mixed([0.0], [[1.0, 0.0, 0.0]])):
        m = len(tissue.mu)
        for thin in (0.0, -0.2):
            f = np.repeat(np.diag([1.0, 1.0, thin])[:, :, None], m, axis=2)
            assert np.isfinite(tissue.energy(f)).all()
            assert (tissue.energy(f) > 0.0).all()
            assert (tissue.stress(f)[2, 2] < 0.0).all()


def test_energy_grows_in_every_direction():
    """ψ at 30 times random gradients is positive and above that at 10 times: bounded below."""
    tissue = mixture(2000)
    way = np.random.default_rng(3).normal(size=(3, 3, 2000))
    small, large = tissue.energy(10.0 * way), tissue.energy(30.0 * way)
    assert (small > 0.0).all()
    assert (large > small).all()


def test_convex_tangent_is_the_positive_part():
    """Eigenvalues below 0 become 0, the others and their vectors stay (numpy's eigh)."""
    tissue, f = mixture(60), gradients(60, 0.4, seed=4)
    true, convex = tissue.tangent(f), tissue.tangent(f, convex=True)
    values, vectors = np.linalg.eigh(true)
    assert (values[:, 0] < -1e-4).sum() > 10
    expected = (vectors * np.maximum(values, 0.0)[:, None]) @ vectors.transpose(0, 2, 1)
    assert np.abs(convex - expected).max() < 1e-12


@pytest.mark.parametrize("moduli", [FAT, MUSCLE])
def test_small_strain_stiffness_is_that_of_the_linear_law(moduli):
    """∂P/∂F at rest against the core's own C, from the compliance in Rust."""
    fibre = meshes.unit_vectors(1, 8)
    fraction = 1.0 if moduli is MUSCLE else 0.0
    tissue = HyperelasticTissue.mixed([fraction], fibre)
    c = np.zeros((3, 3, 3, 3))
    step = 1e-6
    for k in range(3):
        for n in range(3):
            way = np.zeros((3, 3, 1))
            way[k, n] = step
            rest = np.eye(3)[:, :, None]
            c[:, :, k, n] = ((tissue.stress(rest + way) - tissue.stress(rest - way)) / (2 * step))[
                :, :, 0
            ]
    linear = cmfsim.Tissue.transversely_isotropic(
        moduli.young_along, moduli.young_across, moduli.poisson, fibre
    )
    expected = linear.stiffness()[0]
    assert np.abs(meshes.tensor_to_voigt(c) - expected).max() < 1e-8 * np.abs(expected).max()


def linear_tensors(nodes, tets, fraction, fibre) -> cmfsim.MassTensors:
    """The core's tensors of tets that are all fat or all muscle."""
    muscle = fraction > 0.5
    tissue = cmfsim.Tissue.transversely_isotropic(
        np.where(muscle, MUSCLE.young_along, FAT.young_along),
        np.where(muscle, MUSCLE.young_across, FAT.young_across),
        np.where(muscle, MUSCLE.poisson, FAT.poisson),
        fibre,
    )
    return cmfsim.MassTensors(cmfsim.TetMesh(nodes, tets), tissue)


def test_stiffness_at_rest_is_the_mass_tensors():
    """Every entry of the two matrices, fat and muscle mixed."""
    nodes, tets = cube()
    fraction = (np.arange(len(tets)) % 3 == 0).astype(float)
    fibre = meshes.unit_vectors(len(tets), 4)
    body = HyperelasticBody(nodes, tets, HyperelasticTissue.mixed(fraction, fibre))
    ours = body.stiffness(np.zeros_like(nodes)).toarray()
    linear = linear_tensors(nodes, tets, fraction, fibre).to_scipy().toarray()
    assert np.abs(ours - linear).max() < 1e-12 * np.abs(linear).max()


def test_small_motions_go_to_the_linear_solution_linearly():
    """The difference from the mass-tensor solver, relative, falls tenfold with the motion."""
    nodes, tets = cube(4)
    fraction = (nodes[tets].mean(axis=1)[:, 0] > 6.0).astype(float)
    fibre = np.tile([0.0, 0.6, 0.8], (len(tets), 1))
    body = HyperelasticBody(nodes, tets, HyperelasticTissue.mixed(fraction, fibre))
    low = np.flatnonzero(nodes[:, 2] < 1e-9)
    high = np.flatnonzero(nodes[:, 2] > 10.0 - 1e-9)
    held = np.concatenate([low, high])
    boundary = cmfsim.Boundary(fixed=low, joined={"bone": high})
    solver = cmfsim.StaticSolver(linear_tensors(nodes, tets, fraction, fibre), boundary)
    apart = []
    for size in (0.1, 0.01, 0.001):
        motion = cmfsim.rigid_motion((size, 0.0, 0.5 * size))
        move = np.zeros((len(held), 3))
        move[len(low) :] = motion[:3, 3]
        found = find_equilibrium(body, held, lambda part, m=move: part * m, options=TIGHT)
        linear = solver.solve({"bone": motion}).displacements
        apart.append(np.abs(found.displacements - linear).max() / size)
    assert apart[0] < 0.05
    assert 8.0 < apart[0] / apart[1] < 12.5
    assert 8.0 < apart[1] / apart[2] < 12.5


def test_patch_of_large_strain_is_uniform_with_the_stress_of_the_law():
    """A cube whose outside is stretched by 30 % affinely: every inner node follows (patch test)."""
    nodes, tets = cube()
    law = HyperelasticTissue.mixed(np.ones(len(tets)), np.tile([0.6, 0.0, 0.8], (len(tets), 1)))
    body = HyperelasticBody(nodes, tets, law)
    stretch = np.array([[0.3, 0.1, 0.0], [0.0, -0.1, 0.05], [0.1, 0.0, 0.2]])
    held = on_border(nodes)
    move = nodes @ stretch.T
    found = find_equilibrium(body, held, lambda part: part * move[held], options=TIGHT)
    assert np.abs(found.displacements - move).max() < 1e-8
    assert found.residual < 1e-10


def test_confined_compression_takes_the_force_of_the_closed_form():
    """Fat squeezed to 60 % between walls: P₃₃ = (λ + 2μ) (s − 1) on the moved face."""
    nodes, tets = cube()
    body = HyperelasticBody(
        nodes, tets, HyperelasticTissue.mixed(np.zeros(len(tets)), np.ones((len(tets), 3)))
    )
    s = 0.6
    held = on_border(nodes)
    move = np.zeros_like(nodes)
    move[:, 2] = (s - 1.0) * nodes[:, 2]
    found = find_equilibrium(body, held, lambda part: part * move[held], options=TIGHT)
    lambda_, mu = FAT.spencer()[:2]
    expected = 100.0 * (lambda_ + 2.0 * mu) * (s - 1.0)
    top = np.flatnonzero(nodes[:, 2] > 10.0 - 1e-9)
    assert body.forces(found.displacements)[top, 2].sum() == pytest.approx(expected, rel=1e-8)


def test_a_body_turned_with_its_bones_keeps_its_shape():
    """All of the outside turned by 70° about an axis far away: rigid inside, no energy."""
    nodes, tets = cube()
    body = HyperelasticBody(nodes, tets, mixture(len(tets), 2))
    motion = screw(
        cmfsim.rigid_motion((3.0, -2.0, 1.0), 70.0, (1.0, 1.0, 0.0), (30.0, 0.0, 0.0)),
        np.array([5.0, 5.0, 5.0]),
    )
    held = on_border(nodes)

    def path(part: float) -> np.ndarray:
        matrix = motion(part)
        return nodes[held] @ matrix[:3, :3].T + matrix[:3, 3] - nodes[held]

    options = EquilibriumOptions(steps=4, tolerance=1e-9, loose=1e-3)
    found = find_equilibrium(body, held, path, options=options)
    whole = motion(1.0)
    rigid = nodes @ whole[:3, :3].T + whole[:3, 3] - nodes
    assert np.abs(found.displacements - rigid).max() < 1e-6
    assert abs(found.energy) < 1e-12


def test_forces_balance_and_work_is_stored():
    """Sum and moments of the forces vanish; the energy grows by force times way of the bones."""
    nodes, tets = cube()
    body = HyperelasticBody(nodes, tets, mixture(len(tets), 7))
    low = np.flatnonzero(nodes[:, 2] < 1e-9)
    high = np.flatnonzero(nodes[:, 2] > 10.0 - 1e-9)
    held = np.concatenate([low, high])
    way = np.zeros((len(held), 3))
    way[len(low) :] = [2.0, 0.5, 1.0]

    def at(size: float):
        return find_equilibrium(body, held, lambda part: part * size * way, options=TIGHT)

    found, step = at(1.0), 1e-4
    forces = body.forces(found.displacements)
    size = np.abs(forces).sum()
    assert np.abs(forces.sum(axis=0)).max() < 1e-12 * size
    moments = np.cross(nodes + found.displacements, forces).sum(axis=0)
    assert np.abs(moments).max() < 1e-10 * size
    power = (at(1.0 + step).energy - at(1.0 - step).energy) / (2.0 * step)
    assert (forces[held] * way).sum() == pytest.approx(power, rel=1e-5)


def test_a_body_that_stays_has_no_displacement():
    """Moving nothing changes nothing."""
    nodes, tets = cube()
    body = HyperelasticBody(nodes, tets, mixture(len(tets)))
    held = on_border(nodes)
    found = find_equilibrium(body, held, lambda part: part * np.zeros((len(held), 3)))
    assert np.abs(found.displacements).max() < 1e-12


def half_space(spacing: float = 0.5) -> cmfsim.ImageData:
    """The level of a bone below z = 0."""
    z = spacing * np.arange(-16, 17)
    values = np.broadcast_to(-z, (40, 40, len(z))).astype(np.float32)
    return cmfsim.ImageData(values, (spacing,) * 3, (-5.0, -5.0, z[0]))


def pressed_cube(shift: float):
    """A cube on a bone that rises by `shift`, its top held: displacements, contact, body."""
    nodes, tets = cube()
    body = HyperelasticBody(
        nodes, tets, HyperelasticTissue.mixed(np.zeros(len(tets)), np.ones((len(tets), 3)))
    )
    bottom = np.flatnonzero(nodes[:, 2] < 1e-9)
    top = np.flatnonzero(nodes[:, 2] > 10.0 - 1e-9)
    matrix = cmfsim.rigid_motion((0.0, 0.0, shift))
    motion = {"bone": screw(matrix, np.zeros(3))}
    area = np.full(len(bottom), 100.0 / len(bottom))
    contact = BoneContact(nodes, bottom, area, {"bone": SmoothDistance(half_space())}, motion)
    options = EquilibriumOptions(steps=2, tolerance=1e-8, loose=1e-3)
    found = find_equilibrium(
        body, top, lambda part: np.zeros((len(top), 3)) * part, [contact], options
    )
    return found.displacements, contact, body, bottom


def test_bone_that_rises_pushes_tissue_and_hardly_enters_it():
    """Every node on the bone is pushed by 1 mm less its penetration; forces are the contact's."""
    u, contact, body, bottom = pressed_cube(1.0)
    depth = contact.depths(u, 1.0)["bone"]
    assert 0.0 < depth.max() < 0.5 * ONSET
    assert np.abs(u[bottom, 2] - (1.0 - depth)).max() < 1e-9
    assert (contact.forces(u, 1.0)[0][bottom, 2] < 0.0).all()
    total = body.forces(u)[bottom] + contact.forces(u, 1.0)[0][bottom]
    assert np.abs(total).max() < 1e-6 * np.abs(body.forces(u)).max()


def test_bone_that_leaves_does_not_pull():
    """The tissue stays where it was: contact is unilateral."""
    u, contact, *_ = pressed_cube(-1.0)
    assert not u.any()
    assert contact.energy(u, 1.0) == 0.0


def test_contact_forces_are_the_derivative_of_its_energy():
    """On a round bone, moved and turned, against central differences."""
    axis = 0.5 * np.arange(-24, 25)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    ball = cmfsim.ImageData(
        (6.0 - np.sqrt(x**2 + y**2 + z**2)).astype(np.float32), (0.5,) * 3, (-12.0,) * 3
    )
    points = 6.2 * meshes.unit_vectors(60, 1)
    motion = {"ball": screw(cmfsim.rigid_motion((0.5, 0.2, 0.0), 20.0, (0, 0, 1)), np.zeros(3))}
    nodes = np.arange(60)
    contact = BoneContact(points, nodes, np.full(60, 2.0), {"ball": SmoothDistance(ball)}, motion)
    generator = np.random.default_rng(0)
    u, way = 0.3 * generator.normal(size=(60, 3)), generator.normal(size=(60, 3))
    assert (contact.depths(u, 0.7)["ball"] > 0.0).sum() > 5
    step = 1e-5
    rise = (contact.energy(u + step * way, 0.7) - contact.energy(u - step * way, 0.7)) / (2 * step)
    assert (contact.forces(u, 0.7)[0] * way).sum() == pytest.approx(rise, rel=1e-4)


def test_bad_input_is_named():
    """Index, value and allowed range."""
    with pytest.raises(CaseInputError, match="stiffness of muscle"):
        HyperelasticTissue.mixed([0.0, 0.0], np.ones((2, 3)), stiffness=0.0)
    with pytest.raises(CaseInputError, match="steps"):
        EquilibriumOptions(steps=0)


def test_bones_that_close_on_tissue_are_an_error_that_says_where():
    """A cube squeezed to nothing: the tet and its place are named."""
    nodes, tets = cube(2)
    body = HyperelasticBody(nodes, tets, mixture(len(tets)))
    held = np.arange(len(nodes))
    move = np.zeros_like(nodes)
    move[:, 2] = -1.2 * nodes[:, 2]
    with pytest.raises(SolverError, match=r"tet \d+ at .* mm is inverted"):
        find_equilibrium(body, held[:-1], lambda part: part * move[:-1])


def test_contact_stiffness_is_the_derivative_of_its_forces_in_a_hollow():
    """Nodes pressed on the inside of a hollow ball, where no direction gives way."""
    axis = 0.5 * np.arange(-24, 25)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    hollow = cmfsim.ImageData(
        (np.sqrt(x**2 + y**2 + z**2) - 6.0).astype(np.float32), (0.5,) * 3, (-12.0,) * 3
    )
    nodes = 5.6 * meshes.unit_vectors(40, 1)
    motion = {"bone": screw(np.eye(4), np.zeros(3))}
    contact = BoneContact(
        nodes, np.arange(40), np.full(40, 2.0), {"bone": SmoothDistance(hollow)}, motion
    )
    u = 0.1 * nodes
    assert (contact.depths(u, 1.0)["bone"] > ONSET).all()
    way = np.random.default_rng(0).normal(size=(40, 3))
    step = 1e-5
    rise = contact.forces(u + step * way, 1.0)[0] - contact.forces(u - step * way, 1.0)[0]
    expected = rise / (2.0 * step)
    found = np.einsum("kij,kj->ki", contact.forces(u, 1.0)[1], way)
    assert np.abs(found - expected).max() < 1e-3 * np.abs(expected).max()
