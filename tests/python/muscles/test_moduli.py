"""Moduli of fat and muscle: closed forms of the stiffness, ratios, and what is refused."""

import functools
import pickle

import numpy as np
import pytest

import cmfsim
from benches.scenes import meshes
from cmfsim.values.moduli import PRESET_MODULI

NAMES = ("masseter_L", "buccinator_L")
SOFT = cmfsim.MuscleModuli(young_along=0.04, young_across=0.01, poisson=0.4)
# Fat, all muscles, and one muscle, each with constants of its own.
OWN = cmfsim.TissueModuli(
    cmfsim.FatModuli(0.002, 0.45), cmfsim.MuscleModuli(young_along=0.2), {NAMES[0]: SOFT}
)


def cuboid(low, high):
    """A closed box of twelve triangles."""
    corners = np.array(np.meshgrid(*zip(low, high, strict=True), indexing="ij"), dtype=float)
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    triangles = [t for a, b, c, d in quads for t in ([a, b, c], [a, c, d])]
    return cmfsim.SurfaceData(corners.reshape(3, 8).T, triangles)


@functools.cache
def block():
    return cmfsim.TetMesh(*meshes.box((6,) * 3, (6.0,) * 3, jitter=0.2, seed=4))


@functools.cache
def muscles():
    """One along z, one along x; they cross."""
    boxes = cuboid([1.2, 1.3, -1.0], [4.7, 4.1, 9.0]), cuboid([-1.0, 2.0, 2.0], [9.0, 4.0, 3.0])
    return [cmfsim.MuscleSurface(n, "L", box) for n, box in zip(NAMES, boxes, strict=True)]


def mixed(moduli=None, **options):
    """With the paper's constants where `moduli` states none."""
    return cmfsim.equivalent_material(
        block(), muscles(), preset="kim2010", moduli=moduli, **options
    )


@pytest.mark.parametrize("preset", cmfsim.PRESETS)
def test_presets_are_those_of_the_core(preset):
    constants = PRESET_MODULI[preset]
    fibre = [0.6, 0.0, 0.8]
    for fraction, tissue in (
        (0.0, cmfsim.Tissue.isotropic(*constants.fat.constants())),
        (1.0, cmfsim.Tissue.transversely_isotropic(*constants.muscle.constants(), fibre)),
    ):
        core = cmfsim.Tissue.preset(preset, fraction, fibre)
        np.testing.assert_allclose(core.stiffness(), tissue.stiffness(), rtol=1e-14, atol=1e-17)


@pytest.mark.parametrize("mixing", ["moduli", "stiffness"])
def test_moduli_that_are_the_presets_change_no_bit(mixing):
    stated = cmfsim.TissueModuli(
        cmfsim.FatModuli(0.003, 0.46), muscles={NAMES[0]: cmfsim.MuscleModuli(0.5, 0.79, 0.43)}
    )
    plain, same = mixed(mixing=mixing), mixed(stated, mixing=mixing)
    assert np.array_equal(plain.tissue.stiffness(), same.tissue.stiffness())
    assert plain.tissue_data.kind == same.tissue_data.kind
    assert not [f for f in same.findings if f.code.startswith("muscle-moduli")]


@pytest.mark.parametrize("mixing", ["moduli", "stiffness"])
def test_own_moduli_mix_as_the_core_mixes_a_preset(mixing):
    """All muscles at twice the preset's moduli, and fat too: twice the stiffness of the preset."""
    double = cmfsim.TissueModuli(cmfsim.FatModuli(0.006), cmfsim.MuscleModuli(1.0, 1.58))
    twice = 2.0 * mixed(mixing=mixing).tissue.stiffness()
    found = mixed(double, mixing=mixing).tissue.stiffness()
    np.testing.assert_allclose(found, twice, rtol=1e-11, atol=1e-15)


@pytest.mark.parametrize("mixing", ["moduli", "stiffness"])
def test_a_bar_along_its_fibres_has_the_modulus_of_its_muscle(mixing):
    """Where a tet is one muscle, 1/S_zz is E along its fibres and 1/S_xx is E across."""
    mixture = mixed(OWN, mixing=mixing)
    compliance = np.linalg.inv(mixture.tissue.stiffness())
    young = 1.0 / np.diagonal(compliance, axis1=1, axis2=2)[:, :3]
    alone = {n: mixture.muscle_fraction(n) > 1.0 - 1e-12 for n in NAMES}
    assert all(np.count_nonzero(tets) > 3 for tets in alone.values())
    np.testing.assert_allclose(young[alone[NAMES[0]]], [[0.01, 0.01, 0.04]] * alone[NAMES[0]].sum())
    np.testing.assert_allclose(young[alone[NAMES[1]]], [[0.2, 0.79, 0.79]] * alone[NAMES[1]].sum())
    np.testing.assert_allclose(young[mixture.fraction == 0.0], 0.002)


def test_a_tet_of_two_muscles_mixes_moduli_by_their_shares():
    """E = E_fat (1 − p) + Σ p_i E_i, ν likewise, along the mean fibre."""
    mixture = mixed(OWN)
    one, two = (mixture.muscle_fraction(name) for name in NAMES)
    rest = 1.0 - mixture.fraction
    assert np.any((one > 0.1) & (two > 0.1) & (rest > 0.1))
    data = mixture.tissue_data
    np.testing.assert_allclose(data.young_along, 0.002 * rest + 0.04 * one + 0.2 * two, rtol=1e-12)
    np.testing.assert_allclose(data.young_across, 0.002 * rest + 0.01 * one + 0.79 * two)
    np.testing.assert_allclose(data.poisson, 0.45 * rest + 0.4 * one + 0.43 * two, rtol=1e-12)
    stated = mixture.summary["moduli"]
    assert stated["muscles"] == {
        NAMES[0]: {"young_along": 0.04, "young_across": 0.01, "poisson": 0.4}
    }
    assert stated["muscle"] == {"young_along": 0.2, "young_across": 0.79, "poisson": 0.43}
    (note,) = (f for f in mixture.findings if f.code == "muscle-moduli")
    assert note.severity == "note"
    assert "masseter_L 0.04 along and 0.01 across" in note.what


def displacements(moduli):
    """Of a block whose top is moved, linear."""
    mesh, mixture = block(), mixed(moduli)
    scene = cmfsim.Scene(
        nodes=mesh.nodes,
        tets=mesh.tets,
        tissue=mixture.tissue_data,
        fixed=np.flatnonzero(mesh.nodes[:, 2] == 0.0),
        segments={"top": cmfsim.SegmentData(joined=np.flatnonzero(mesh.nodes[:, 2] == 6.0))},
        plan={"top": cmfsim.rigid_motion(translation=(0.3, 0, 0.6))},
        options=cmfsim.SolverOptions(method="cholesky"),
    )
    return cmfsim.solve_scene(scene).displacements


def test_only_ratios_of_moduli_matter():
    factor = 3.7
    scaled = cmfsim.TissueModuli(
        cmfsim.FatModuli(0.002 * factor, 0.45),
        cmfsim.MuscleModuli(0.2 * factor, 0.79 * factor),
        {NAMES[0]: cmfsim.MuscleModuli(0.04 * factor, 0.01 * factor, 0.4)},
    )
    own = displacements(OWN)
    largest = np.abs(own).max()
    assert np.abs(displacements(scaled) - own).max() < 1e-9 * largest
    # One muscle alone, scaled, is another model.
    stiff = cmfsim.TissueModuli(OWN.fat, OWN.muscle, {NAMES[0]: cmfsim.MuscleModuli(0.4, 0.1)})
    assert np.abs(displacements(stiff) - own).max() > 1e-3 * largest


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: cmfsim.MuscleModuli(young_along=0.0), "young_along is 0 MPa.*1e-06 to 1000"),
        (lambda: cmfsim.MuscleModuli(young_across=2e3), "young_across is 2000 MPa"),
        (lambda: cmfsim.MuscleModuli(poisson=0.5), "poisson is 0.5.*above -1 and below 0.5"),
        (lambda: cmfsim.FatModuli(young=float("nan")), "young is nan"),
        (lambda: cmfsim.FatModuli(poisson=-1.0), "poisson is -1"),
        (lambda: cmfsim.FatModuli(young="soft"), "young is 'soft'"),
        (
            lambda: mixed(cmfsim.TissueModuli(muscles={"maseter_L": SOFT})),
            "'maseter_L'.*did you mean 'masseter_L'.*muscles: masseter_L, buccinator_L",
        ),
        (
            lambda: mixed(
                cmfsim.TissueModuli(
                    muscles={NAMES[0]: cmfsim.MuscleModuli(1e3, 1e-6, -1.0 + 1e-15)}
                )
            ),
            "masseter_L have no positive definite stiffness.*poisson from 0 to 0.49",
        ),
    ],
)
def test_moduli_that_no_tissue_has_are_refused(make, words):
    with pytest.raises(ValueError, match=words):
        make()


def test_a_modulus_in_kilopascals_is_a_warning():
    found = mixed(cmfsim.TissueModuli(muscle=cmfsim.MuscleModuli(young_along=30.0))).findings
    (warning,) = (f for f in found if f.code == "moduli-unusual")
    assert warning.severity == "warning"
    assert "muscle 30" in warning.what


def test_moduli_survive_a_pickle():
    assert pickle.loads(pickle.dumps(OWN)) == OWN


def test_the_fat_of_a_case_lies_between_its_muscles():
    assert cmfsim.FatModuli.of(cmfsim.TissueData("isotropic", young=0.01, poisson=0.4)) == (
        cmfsim.FatModuli(0.01, 0.4)
    )
    for preset, poisson in (("passive", 0.40), ("kim2010", 0.46)):
        fat = cmfsim.TissueData("preset", preset=preset, fraction=0.0)
        assert cmfsim.FatModuli.of(fat).constants() == (0.003, poisson)
    assert cmfsim.TissueData("preset", fraction=0.0).preset == cmfsim.CaseMuscles().preset
    with pytest.raises(ValueError, match="must be isotropic"):
        cmfsim.FatModuli.of(cmfsim.TissueData("stiffness", stiffness=np.eye(6)))
