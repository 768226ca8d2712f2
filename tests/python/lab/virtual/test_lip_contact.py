"""Contact of the true lips: derivatives, closed forms, symmetry, and the mouth that is opened."""

import numpy as np
import pytest

import cmfsim
from benches.scenes import meshes
from cmfsim import HeadParameters, make_head
from cmfsim.errors import CaseInputError
from cmfsim.lab.virtual.mechanics.body import FAT, HyperelasticBody, HyperelasticTissue
from cmfsim.lab.virtual.mechanics.equilibrium import EquilibriumOptions, find_equilibrium
from cmfsim.lab.virtual.mechanics.lip_contact import Lip, LipContact, MouthSlit

SIDE = 6.0


def two_blocks(gap: float, cells: tuple[int, int] = (4, 3), tilt: float = 0.0):
    """Two cubes above each other with a gap, their meshes different: nodes, tets, lips.

    The lower one, and where `tilt` is not 0 the upper one turned about y by that many degrees.
    """
    bodies = []
    for count, height in zip(cells, (0.0, SIDE + gap), strict=True):
        nodes, tets = meshes.box((count,) * 3, (SIDE,) * 3)
        nodes = nodes + [0.0, 0.0, height]
        if height and tilt:
            nodes = nodes @ meshes.rotation((0.0, 1.0, 0.0), tilt).T
        bodies.append((nodes, tets))
    n = len(bodies[0][0])
    nodes = np.vstack([bodies[0][0], bodies[1][0]])
    tets = np.vstack([bodies[0][1], bodies[1][1] + n])
    boundary = cmfsim.TetMesh(nodes, tets).boundary_triangles().astype(np.int64)
    corners = nodes[boundary]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.bincount(
        boundary.T.ravel(), np.tile(np.linalg.norm(normal, axis=1) / 6.0, 3), len(nodes)
    )
    of_upper = (boundary >= n).all(axis=1)
    return nodes, tets, Lip.of(boundary[of_upper], area), Lip.of(boundary[~of_upper], area)


def pressed(contact: LipContact, count: int, rough: float = 0.03, seed: int = 0) -> np.ndarray:
    """Displacements (count, 3) that push the upper block into the lower, with noise."""
    u = rough * np.random.default_rng(seed).normal(size=(count, 3))
    u[contact.upper.nodes, 2] -= 0.12 + rough
    return u


def test_forces_are_the_derivative_of_the_energy():
    """Along single nodes and random directions, against central differences; faces and edges."""
    nodes, _, upper, lower = two_blocks(0.1, tilt=3.0)
    contact = LipContact(nodes, upper, lower)
    u = pressed(contact, len(nodes))
    assert contact.touching(u) > 15
    assert contact.penetration(u) > contact.onset
    force, step = contact.forces(u, 1.0)[0], 1e-7
    generator = np.random.default_rng(1)
    for _ in range(20):
        way = generator.normal(size=nodes.shape)
        rise = contact.energy(u + step * way, 1.0) - contact.energy(u - step * way, 1.0)
        assert (force * way).sum() == pytest.approx(rise / (2.0 * step), rel=1e-5)


def frozen_forces(contact: LipContact, u: np.ndarray, at: np.ndarray) -> np.ndarray:
    """The gradient at displacements `at` with the closest features as they are at `u`.

    Over faces along the same normal; from edges and corners along the way to them.
    """
    force = np.zeros_like(u)
    places = contact.points + at
    for touch in contact._touches(u):
        way = np.einsum("ck,cki->ci", touch.parts, places[touch.corners])
        fixed = np.eye(3) - touch.swing - touch.normal[:, :, None] * touch.normal[:, None, :]
        swings = touch.swing.any(axis=(1, 2))
        across = way - np.einsum("cij,cj->ci", fixed, way)
        normal = np.where(
            swings[:, None], -across / np.linalg.norm(across, axis=1, keepdims=True), touch.normal
        )
        d = np.maximum(-(way * normal).sum(axis=1), 0.0)
        pressing = np.where(d < contact.onset, 0.5 * d**2 / contact.onset, d - 0.5 * contact.onset)
        weight = -0.5 * contact.stiffness * touch.area * pressing
        share = (weight[:, None] * touch.parts)[:, :, None] * normal[:, None, :]
        np.add.at(force, touch.corners, share)
    return force


def test_stiffness_is_the_derivative_of_the_forces_with_frozen_features():
    """Against central differences of the forces; symmetric, and no direction gives way."""
    nodes, _, upper, lower = two_blocks(0.1, cells=(3, 4), tilt=3.0)
    contact = LipContact(nodes, upper, lower)
    # Valleys of a rough surface are edges and corners to nodes that lie in them.
    u = pressed(contact, len(nodes), rough=0.3)
    assert np.abs(frozen_forces(contact, u, u) - contact.forces(u, 1.0)[0]).max() < 1e-12
    swings = [touch.swing.any(axis=(1, 2)) for touch in contact._touches(u)]
    assert sum(map(np.count_nonzero, swings)) > 2
    assert sum(np.count_nonzero(~each) for each in swings) > 2
    matrix = contact.coupling(u, 1.0)
    assert abs(matrix - matrix.T).max() < 1e-15
    assert np.linalg.eigvalsh(matrix.toarray()).min() > -1e-12 * abs(matrix).max()
    step = 1e-7
    for seed in range(5):
        way = np.random.default_rng(seed).normal(size=u.shape)
        rise = frozen_forces(contact, u, u + step * way) - frozen_forces(contact, u, u - step * way)
        expected = rise / (2.0 * step)
        found = (matrix @ way.ravel()).reshape(-1, 3)
        assert np.abs(found - expected).max() < 1e-6 * np.abs(expected).max()


def test_lips_apart_or_just_touching_feel_nothing():
    """No energy, force or stiffness at a gap and at none."""
    for gap in (0.4, 0.0):
        nodes, _, upper, lower = two_blocks(gap)
        contact = LipContact(nodes, upper, lower)
        u = np.zeros_like(nodes)
        assert contact.energy(u, 1.0) == 0.0
        assert not contact.forces(u, 1.0)[0].any()
        assert abs(contact.coupling(u, 1.0)).max() == 0.0
        assert contact.penetration(u) == 0.0


def test_upper_and_lower_are_alike():
    """The same energy and forces with the two exchanged, and action equals reaction."""
    nodes, _, upper, lower = two_blocks(0.05, tilt=2.0)
    one, other = LipContact(nodes, upper, lower), LipContact(nodes, lower, upper)
    u = pressed(one, len(nodes))
    assert one.energy(u, 1.0) == pytest.approx(other.energy(u, 1.0), rel=1e-14)
    force = one.forces(u, 1.0)[0]
    assert np.abs(force - other.forces(u, 1.0)[0]).max() < 1e-14
    size = np.abs(force).sum()
    assert size > 0.0
    assert np.abs(force.sum(axis=0)).max() < 1e-13 * size
    moment = np.cross(nodes + u, force).sum(axis=0)
    assert np.abs(moment).max() < 1e-12 * size * SIDE


@pytest.mark.parametrize("cells", [(3, 3), (4, 3)])
def test_blocks_pressed_together_share_the_strain_and_meet_at_equal_pressure(cells):
    """Two cubes of fat between walls, 1 mm of approach over a gap of 0.2 mm.

    Closed form of confined compression: P = (λ + 2μ) s / h in both, s = (approach − gap − e) / 2,
    where the penetration e holds the same pressure, k (e − δ/2).
    """
    nodes, tets, upper, lower = two_blocks(0.2, cells)
    fat = HyperelasticTissue.mixed(np.zeros(len(tets)), np.ones((len(tets), 3)))
    body = HyperelasticBody(nodes, tets, fat)
    # Weights of node areas are exact for a uniform pressure on the touching faces alone.
    face = [
        lip.nodes[np.abs(nodes[lip.nodes, 2] - z) < 1e-9]
        for lip, z in ((upper, SIDE + 0.2), (lower, SIDE))
    ]
    lips = [
        Lip.of(lip.triangles[np.isin(lip.triangles, f).all(axis=1)], face_area(nodes, lip, f))
        for lip, f in zip((upper, lower), face, strict=True)
    ]
    contact = LipContact(nodes, *lips, stiffness=0.1, onset=0.01)
    top = np.flatnonzero(nodes[:, 2] > 2.0 * SIDE + 0.2 - 1e-9)
    bottom = np.flatnonzero(nodes[:, 2] < 1e-9)
    # Sides slide along walls: held sideways, free upwards, by a stiff foundation.
    wall = Walls(np.where(on_sides(nodes)[:, None], [30.0, 30.0, 0.0], 0.0))
    held = np.concatenate([bottom, top])
    way = np.zeros((len(held), 3))
    way[len(bottom) :, 2] = -1.2
    options = EquilibriumOptions(steps=3, tolerance=1e-3, loose=0.03)
    found = find_equilibrium(body, held, lambda part: part * way, [wall, contact], options)
    u = found.displacements
    lambda_, mu = FAT.spencer()[:2]
    modulus = (lambda_ + 2.0 * mu) / SIDE
    # modulus (1.0 − e) / 2 = k (e − δ/2)
    k, onset = contact.stiffness, contact.onset
    e = (0.5 * modulus + 0.5 * k * onset) / (k + 0.5 * modulus)
    assert e > onset
    pressure = k * (e - 0.5 * onset)
    reaction = body.forces(u)
    assert reaction[top, 2].sum() == pytest.approx(-pressure * SIDE**2, rel=2e-3)
    assert reaction[bottom, 2].sum() == pytest.approx(pressure * SIDE**2, rel=2e-3)
    assert contact.penetration(u) < 1.5 * e
    if cells[0] == cells[1]:
        heights = u[face[0], 2] + nodes[face[0], 2], u[face[1], 2] + nodes[face[1], 2]
        assert np.ptp(heights[0]) < 1e-4
        assert heights[1].mean() - heights[0].mean() == pytest.approx(e, rel=1e-3)
        assert heights[1].mean() - SIDE == pytest.approx(-0.5 * (1.0 - e), rel=1e-3)


def face_area(nodes, lip, face) -> np.ndarray:
    """A third of the area of the triangles of a face about each node, (n,) mm²."""
    triangles = lip.triangles[np.isin(lip.triangles, face).all(axis=1)]
    corners = nodes[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    third = np.linalg.norm(normal, axis=1) / 6.0
    return np.bincount(triangles.T.ravel(), np.tile(third, 3), len(nodes))


def on_sides(nodes) -> np.ndarray:
    """Which nodes lie on the walls beside the blocks."""
    flat = nodes[:, :2]
    return ((flat < 1e-9) | (flat > SIDE - 1e-9)).any(axis=1)


class Walls:
    """Springs (n, 3) N/mm that hold nodes where they are."""

    def __init__(self, springs: np.ndarray) -> None:
        self.springs = springs

    def energy(self, displacements, part) -> float:
        """Of the springs."""
        del part
        return 0.5 * float((self.springs * displacements**2).sum())

    def forces(self, displacements, part):
        """Their gradient and stiffness."""
        del part
        return self.springs * displacements, self.springs[:, :, None] * np.eye(3)

    def coupling(self, displacements, part) -> None:
        """None: each node has its own."""
        del displacements, part


def test_lips_that_leave_each_other_do_not_pull():
    """Blocks in touch, one lifted: the other stays as it is."""
    nodes, tets, upper, lower = two_blocks(0.0)
    fat = HyperelasticTissue.mixed(np.zeros(len(tets)), np.ones((len(tets), 3)))
    body = HyperelasticBody(nodes, tets, fat)
    contact = LipContact(nodes, upper, lower)
    held = np.flatnonzero((nodes[:, 2] < 1e-9) | (nodes[:, 2] > 2.0 * SIDE - 1e-9))
    way = np.zeros((len(held), 3))
    way[nodes[held, 2] > SIDE, 2] = 1.0
    options = EquilibriumOptions(steps=1, tolerance=1e-6, loose=1e-3)
    u = find_equilibrium(body, held, lambda part: part * way, [contact], options).displacements
    assert np.abs(u[lower.nodes]).max() < 1e-6
    assert contact.penetration(u) < 1e-6


def test_the_slit_separates_the_lips():
    """Upper and lower landmarks lie on their sides; the slit is as thick as the gap and shut aside.

    In a head whose jaw is as drawn, the slit is `lip_gap` thick at the midline.
    """
    head = make_head(HeadParameters(lip_gap=2.0))
    slit = MouthSlit(head)
    sites = head.skin_landmarks
    points = np.array([sites["labiale_superius"], sites["labiale_inferius"]])
    assert slit.lips(points).tolist() == [1, -1]
    assert (slit.height(points) * [1.0, -1.0] > 3.0).all()
    z = np.linspace(-50.0, -38.0, 12001)
    thick = [
        np.count_nonzero(slit.level(np.column_stack([np.full_like(z, x), y, z])) > 0.0) * 1e-3
        for x, y in ((0.0, np.full_like(z, -95.0)), (24.0, np.full_like(z, -88.0)))
    ]
    assert thick[0] == pytest.approx(2.0, abs=2e-3)
    assert thick[1] == 0.0
    # Where the skin itself has a slit, in front, it is the same one.
    front = np.column_stack([np.zeros_like(z), np.full_like(z, -102.0), z])
    both = (slit.level(front) > 0.3) & (head.skin_level(front) > 0.0)
    assert not both.any()


def test_lips_that_are_too_near_are_refused():
    """A slit that the mesh would not resolve is an error that names gap and limit."""
    with pytest.raises(CaseInputError, match=r"lip_gap is 0.5 mm: 1 mm or more"):
        MouthSlit(make_head(HeadParameters(lip_gap=0.5)))
