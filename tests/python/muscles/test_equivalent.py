"""Muscle fractions, fibres and tissue of tets: closed forms, independent mixing, real muscles."""

import functools

import numpy as np
import pytest

import cmfsim
import real_heads
from benches.scenes import meshes
from benches.scenes.angles import angle_of_lines
from cmfsim.muscles.equivalent import prepared_muscles

# Fat, and muscle along and across: Table 1 of Kim et al. (2010), and muscle at rest.
FAT = {"passive": (0.003, 0.40), "kim2010": (0.003, 0.46), "kim2010-swapped": (0.003, 0.46)}
MUSCLE = {
    "passive": (0.06, 0.03, 0.43),
    "kim2010": (0.5, 0.79, 0.43),
    "kim2010-swapped": (0.79, 0.5, 0.43),
}


def cuboid(low, high):
    """A closed box of twelve triangles."""
    corners = np.array(np.meshgrid(*zip(low, high, strict=True), indexing="ij"), dtype=float)
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    triangles = [t for a, b, c, d in quads for t in ([a, b, c], [a, c, d])]
    return cmfsim.SurfaceData(corners.reshape(3, 8).T, triangles)


@functools.cache
def block(cells=6, size=6.0):
    return cmfsim.TetMesh(*meshes.box((cells,) * 3, (size,) * 3, jitter=0.2, seed=4))


def test_a_box_along_z_has_its_volume_and_its_direction():
    mesh = block()
    mixture = cmfsim.equivalent_material(mesh, [cuboid([1.2, 1.3, -1.0], [3.7, 3.1, 9.0])])
    volume = mixture.volumes["muscle_0"]
    assert volume.inside == pytest.approx(2.5 * 1.8 * 6.0, abs=4.0 * volume.error)
    assert volume.error < 0.02 * volume.inside
    assert volume.enclosed == pytest.approx(2.5 * 1.8 * 10.0)
    held = mixture.fraction > 0.0
    assert np.allclose(mixture.fibre[held], [0.0, 0.0, 1.0], atol=1e-9)
    assert not mixture.fibre[~held].any()
    assert np.array_equal(mixture.muscle_fraction("muscle_0"), mixture.fraction)
    assert any(f.code == "muscle-does-not-fit" for f in mixture.findings)
    with pytest.raises(KeyError, match="muscle_0"):
        mixture.muscle_fraction("masseter_L")


@pytest.mark.parametrize("preset", list(MUSCLE))
def test_moduli_mix_as_the_paper_says(preset):
    """E = E_fat (1 − p) + E_muscle p, ν likewise: the stiffness that Tissue makes of those."""
    muscles = [cuboid([1.2, 1.3, -1.0], [3.7, 3.1, 9.0]), cuboid([-1, 2.0, 2.0], [9.0, 4.0, 3.0])]
    mixture = cmfsim.equivalent_material(block(), muscles, preset=preset)
    p = mixture.fraction
    along, across, poisson = MUSCLE[preset]
    young, nu = FAT[preset]
    fibre = np.where(p[:, None] > 0.0, mixture.fibre, [1.0, 0.0, 0.0])
    expected = cmfsim.Tissue.transversely_isotropic(
        young * (1 - p) + along * p, young * (1 - p) + across * p, nu * (1 - p) + poisson * p, fibre
    )
    assert np.allclose(mixture.tissue.stiffness(), expected.stiffness(), rtol=1e-12, atol=1e-15)
    assert mixture.tissue.smallest_eigenvalues().min() > 0.0


def test_stiffness_mixes_by_shares_along_each_muscle():
    """C = Σ p_i C(a_i) + (1 − Σ p_i) C_fat, and positive definite by numpy."""
    muscles = [cuboid([1.2, 1.3, -1.0], [3.7, 3.1, 9.0]), cuboid([-1, 2.0, 2.0], [9.0, 4.0, 3.0])]
    mixture = cmfsim.equivalent_material(block(), muscles, preset="kim2010", mixing="stiffness")
    shares = [mixture.muscle_fraction(name) for name in mixture.volumes]
    assert np.allclose(sum(shares), mixture.fraction, atol=1e-12)
    fat = cmfsim.Tissue.isotropic(*FAT["kim2010"]).stiffness()[0]
    along = [
        cmfsim.Tissue.transversely_isotropic(*MUSCLE["kim2010"], a).stiffness()[0]
        for a in ([0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    ]
    expected = (1.0 - mixture.fraction)[:, None, None] * fat
    for share, c in zip(shares, along, strict=True):
        expected = expected + share[:, None, None] * c
    assert np.allclose(mixture.tissue.stiffness(), expected, rtol=1e-9, atol=1e-12)
    weights = np.array([1.0] * 3 + [np.sqrt(2.0)] * 3)
    mandel = mixture.tissue.stiffness() * weights[:, None] * weights
    smallest = np.linalg.eigvalsh(mandel)[:, 0]
    assert smallest.min() > 0.0
    assert np.allclose(mixture.tissue.smallest_eigenvalues(), smallest, rtol=1e-9)


@pytest.mark.parametrize("mixing", ["moduli", "stiffness"])
def test_the_tissue_goes_into_a_scene(mixing):
    mesh = block()
    muscle = cuboid([1.2, 1.3, -1.0], [3.7, 3.1, 9.0])
    mixture = cmfsim.equivalent_material(mesh, [muscle], mixing=mixing)
    ends = [np.flatnonzero(mesh.nodes[:, 2] == z) for z in (0.0, 6.0)]
    scene = cmfsim.Scene(
        nodes=mesh.nodes,
        tets=mesh.tets,
        tissue=mixture.tissue_data,
        fixed=ends[0],
        segments={"top": cmfsim.SegmentData(joined=ends[1])},
        plan={"top": cmfsim.rigid_motion(translation=(0, 0, 0.1))},
    )
    solver = cmfsim.scene_solver(scene)
    direct = cmfsim.MassTensors(mesh, mixture.tissue)
    u = np.random.default_rng(1).normal(size=mesh.nodes.shape)
    force = direct.force(u)
    assert np.allclose(solver.tensors.force(u), force, rtol=1e-12, atol=1e-12 * abs(force).max())


def test_a_musculature_keeps_its_names_and_sides_of_the_option():
    mesh = block()
    strap = cuboid([1.2, 1.3, -1.0], [3.7, 3.1, 9.0])
    other = cuboid([4.2, 1.3, 1.0], [5.7, 3.1, 2.0])
    muscles = cmfsim.Musculature(
        (
            cmfsim.MuscleSurface("masseter_L", "L", strap, course=([[2, 2, 0], [2, 2.5, 6]],)),
            cmfsim.MuscleSurface("masseter_R", "R", other),
        )
    )
    mixture = cmfsim.equivalent_material(mesh, muscles)
    assert list(mixture.volumes) == ["masseter_L", "masseter_R"]
    only = mixture.muscle_fraction("masseter_L") > 0.0
    course = np.array([0.0, 0.5, 6.0]) / np.hypot(0.5, 6.0)
    assert np.allclose(mixture.fibre[only], course, atol=1e-9)
    assert set(mixture.timings) >= {"surfaces", "trees", "crossing", "sampling", "tissue", "total"}
    assert mixture.samples == mixture.summary["points"] > 0


def test_no_muscle_is_homogeneous_fat_and_said():
    mixture = cmfsim.equivalent_material(block(), [])
    assert not mixture.fraction.any()
    assert not mixture.fibre.any()
    assert mixture.samples == 0
    assert mixture.findings[0].code == "muscles-none"
    fat = cmfsim.Tissue.isotropic(*FAT["passive"]).stiffness()
    assert np.array_equal(mixture.tissue.stiffness(), np.repeat(fat, block().n_tets, axis=0))


def test_findings_name_what_is_odd_about_a_muscle():
    good = cuboid([1.2, 1.3, 1.0], [3.7, 3.1, 5.0])
    inside_out = cmfsim.SurfaceData(good.vertices, good.triangles[:, ::-1])
    opened = cmfsim.SurfaceData(good.vertices, good.triangles[1:])
    outside = cmfsim.SurfaceData(good.vertices + 100.0, good.triangles)
    mixture = cmfsim.equivalent_material(block(), [good, inside_out, opened, outside])
    found = {(f.where, f.code) for f in mixture.findings}
    assert {
        ("muscle_1", "surface-repaired"),
        ("muscle_2", "surface-open"),
        ("muscle_3", "muscle-missed"),
    } <= found
    assert not any(where == "muscle_0" for where, _ in found)
    # Three of the same: each point in all of them counts once, and a third for each.
    assert mixture.fraction.max() <= 1.0
    volumes = mixture.volumes
    assert volumes["muscle_1"].inside == volumes["muscle_0"].inside


@pytest.mark.parametrize(
    ("options", "error", "text"),
    [
        ({"samples": 0}, cmfsim.MaterialError, "samples"),
        ({"samples": -3}, cmfsim.MaterialError, "samples is -3"),
        ({"samples": 2.5}, cmfsim.MaterialError, "whole number"),
        ({"seed": -1}, cmfsim.MaterialError, "seed is -1"),
        ({"seed": 10**30}, cmfsim.MaterialError, "seed is 10{30}: allowed is 0 or more"),
        ({"seed": True}, cmfsim.MaterialError, "seed is True: a whole number"),
        ({"samples": 10**30}, cmfsim.MaterialError, r"samples is 10{30}: allowed is 1 to \d+"),
        ({"samples": 10**5000}, cmfsim.MaterialError, r"samples is .*: allowed is 1 to \d+"),
        ({"samples": False}, cmfsim.MaterialError, "samples is False: a whole number"),
        ({"preset": "kim2011"}, cmfsim.MaterialError, "kim2010, kim2010-swapped"),
        ({"mixing": "reuss"}, cmfsim.MaterialError, "moduli, stiffness"),
        ({"inside": "ray"}, cmfsim.MaterialError, "winding, normal"),
        ({"muscles": 3}, cmfsim.MeshError, "of type int"),
        ({"muscles": [3]}, cmfsim.MeshError, r"muscles\[0\] is of type int"),
        ({"muscles": cuboid([0, 0, 0], [1, 1, 1])}, cmfsim.MeshError, "a sequence"),
        (
            {"muscles": [cmfsim.SurfaceData([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]])]},
            cmfsim.MeshError,
            "muscle 'muscle_0'.*degenerate",
        ),
    ],
)
def test_bad_input_gives_the_named_error(options, error, text):
    options = {"muscles": [cuboid([1, 1, 1], [2, 2, 2])], **options}
    with pytest.raises(error, match=text) as found:
        cmfsim.equivalent_material(block(), options.pop("muscles"), **options)
    assert isinstance(found.value, ValueError)


def test_nan_in_a_muscle_never_gets_that_far():
    with pytest.raises(ValueError, match="finite"):
        cmfsim.SurfaceData([[0, 0, 0], [1, 0, np.nan], [0, 1, 0]], [[0, 1, 2]])


def covering(surfaces, edge):
    """A box of tets that holds every surface."""
    points = np.concatenate([s.vertices for s in surfaces])
    low, high = points.min(0) - edge, points.max(0) + edge
    cells = tuple(int(n) for n in np.ceil((high - low) / edge))
    nodes, tets = meshes.box(cells, tuple(high - low), jitter=0.15, seed=6)
    return cmfsim.TetMesh(nodes + low, tets)


def test_phantom_muscles_keep_their_volume_and_their_course():
    head = cmfsim.make_head()
    names = ("masseter_L", "temporalis_L", "zygomaticus_major_L", "orbicularis_oris")
    surfaces = [head.surface(name, spacing=1.0) for name in names]
    muscles = cmfsim.Musculature(
        tuple(
            cmfsim.MuscleSurface(
                name,
                head.muscles[name].side,
                surface,
                kind=head.muscles[name].kind,
                course=head.muscles[name].course,
            )
            for name, surface in zip(names, surfaces, strict=True)
        )
    )
    mesh = covering(surfaces, 3.0)
    mixture = cmfsim.equivalent_material(mesh, muscles)
    for name, volume in mixture.volumes.items():
        assert volume.inside == pytest.approx(volume.enclosed, rel=5e-3), name
    total = sum(v.enclosed for v in mixture.volumes.values())
    assert sum(v.inside for v in mixture.volumes.values()) == pytest.approx(total, rel=2e-3)
    centroid = mesh.nodes[mesh.tets].mean(1)
    for name in names:
        inside = mixture.muscle_fraction(name) > 0.99
        known = head.muscles[name].fibre(centroid[inside])
        assert np.median(angle_of_lines(known, mixture.fibre[inside])) < 10.0, name


def atlas_muscle(fma):
    """A muscle of the atlas with coincident vertices merged and without degenerate triangles."""
    pv = pytest.importorskip("pyvista")
    folder = real_heads.data_folder() / "bodyparts3d"
    paths = sorted(folder.rglob(f"FMA{fma}*.obj"))
    if not paths:
        pytest.skip(f"needs FMA{fma} of bodyparts3d")
    mesh = pv.read(paths[0]).triangulate()
    vertices, place = np.unique(np.asarray(mesh.points, dtype=float), axis=0, return_inverse=True)
    triangles = place.ravel()[mesh.regular_faces]
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return cmfsim.SurfaceData(vertices, triangles[area > 1e-9])


# Masseter (superficial, deep), temporalis, medial pterygoid, zygomaticus major, mentalis is open.
@pytest.mark.parametrize("fma", [49002, 49005, 49008, 46813, 46824])
def test_atlas_muscles_keep_their_volume(fma):
    surface = atlas_muscle(fma)
    mesh = covering([surface], 2.5)
    mixture = cmfsim.equivalent_material(mesh, [surface])
    volume = mixture.volumes["muscle_0"]
    if volume.enclosed is None:
        pytest.skip(f"FMA{fma} is not closed")
    assert volume.inside == pytest.approx(volume.enclosed, rel=5e-3)


def test_open_atlas_muscles_are_bridged():
    """Against the plain winding number at many random points of the box round the muscle."""
    surface = atlas_muscle(46829)
    mesh = covering([surface], 2.5)
    mixture = cmfsim.equivalent_material(mesh, [surface])
    low, high = mesh.nodes.min(0), mesh.nodes.max(0)
    points = np.random.default_rng(3).uniform(low, high, (200_000, 3))
    core = cmfsim.Surface(surface.vertices, surface.triangles)
    winding = core.winding_number(points)
    sign = -1.0 if any(f.code == "surface-repaired" for f in mixture.findings) else 1.0
    inside = sign * winding > 0.5
    expected = inside.mean() * np.prod(high - low)
    spread = np.sqrt(inside.mean() * (1 - inside.mean()) / len(points)) * np.prod(high - low)
    volume = mixture.volumes["muscle_0"]
    assert volume.inside == pytest.approx(expected, abs=4.0 * np.hypot(spread, volume.error))


def test_prepared_muscles_give_the_same_mixture():
    muscles = [cuboid([1.2, 1.3, -1.0], [3.7, 3.1, 9.0]), cuboid([2.0, 0.5, 1.0], [5.0, 2.0, 4.0])]
    given = cmfsim.equivalent_material(block(), muscles)
    prepared = cmfsim.equivalent_material(block(), prepared_muscles(muscles))
    assert np.array_equal(given.fraction, prepared.fraction)
    assert np.array_equal(given.fibre, prepared.fibre)
    assert list(given.volumes) == list(prepared.volumes)
