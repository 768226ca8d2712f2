"""Shares of muscle that fade into fat: what the blur keeps, and how wide it is."""

import functools
import itertools

import numpy as np
import pytest

import cmfsim
from benches.scenes import meshes
from cmfsim.muscles.blurring import Blur, blurred

SIZE = 24.0


@functools.cache
def block(cells=12):
    return cmfsim.TetMesh(*meshes.box((cells,) * 3, (SIZE,) * 3, jitter=0.2, seed=4))


def centres(mesh):
    return np.asarray(mesh.nodes)[np.asarray(mesh.tets).astype(int)].mean(axis=1)


def slab(mesh):
    """Muscle in the upper half, its fibres along x on the left and along z on the right."""
    x, _, z = centres(mesh).T
    fraction = (z > 0.5 * SIZE).astype(float)
    fibre = np.where((x < 0.5 * SIZE)[:, None], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    return fraction, fraction[:, None] * fibre


def preset_tissue(fraction, fibre):
    return cmfsim.TissueData("preset", preset="passive", fraction=fraction, fibre=fibre)


@pytest.mark.parametrize("cells", [12, 18])
@pytest.mark.parametrize("width", [2.0, 3.0])
def test_a_border_fades_over_the_width_asked_for_on_any_mesh(cells, width):
    """Of a step blurred by σ, dp/dz is a bell of mean square deviation σ² from the border."""
    mesh = block(cells)
    fraction, fibre = slab(mesh)
    found, _, _ = blurred(mesh, fraction, fibre, preset_tissue(fraction, fibre), width)
    z = centres(mesh)[:, 2]
    edges = np.linspace(0.0, SIZE, cells + 1)
    profile = np.array([found[(z >= a) & (z < b)].mean() for a, b in itertools.pairwise(edges)])
    assert np.all(np.diff(profile) > -1e-12)
    places = edges[1:-1] - 0.5 * SIZE
    spread = np.sum(np.diff(profile) * places**2) / np.sum(np.diff(profile))
    assert np.sqrt(spread) == pytest.approx(width, rel=0.25)


def test_the_blur_keeps_constants_bounds_and_the_volume_of_muscle():
    mesh = block()
    p = np.random.default_rng(3).uniform(size=mesh.n_tets)
    blur = Blur(mesh, p, 3.0)
    assert blur.rounds > 1
    found = blur(np.column_stack([p, np.ones(mesh.n_tets)]))
    assert np.allclose(found[:, 1], 1.0, rtol=1e-13)
    assert p.min() < found[:, 0].min()
    assert found[:, 0].max() < p.max()
    assert found[:, 0] @ mesh.volumes == pytest.approx(p @ mesh.volumes, rel=1e-12)


def test_zero_width_and_no_muscle_change_nothing():
    mesh = block()
    fraction, fibre = slab(mesh)
    tissue = preset_tissue(fraction, fibre)
    assert blurred(mesh, fraction, fibre, tissue, 0.0) == (fraction, fibre, tissue)
    none = np.zeros_like(fraction), np.zeros_like(fibre)
    assert blurred(mesh, *none, tissue, 3.0) == (*none, tissue)


def test_fibres_stay_where_muscle_has_one_direction_and_turn_where_two_meet():
    mesh = block()
    fraction, fibre = slab(mesh)
    found, direction, tissue = blurred(mesh, fraction, fibre, preset_tissue(fraction, fibre), 2.0)
    x = centres(mesh)[:, 0]
    some = found > 0.0
    assert np.allclose(np.linalg.norm(direction[some], axis=1), 1.0)
    assert not direction[~some].any()
    assert np.allclose(direction[some & (x < 3.0)], [1.0, 0.0, 0.0], atol=1e-6)
    assert np.allclose(direction[some & (x > SIZE - 3.0)], [0.0, 0.0, 1.0], atol=1e-6)
    assert np.array_equal(tissue.fraction, found)


@pytest.mark.parametrize("mixing", ["moduli", "stiffness"])
def test_moduli_of_single_muscles_are_blurred_as_the_shares_are(mixing):
    """Twice the preset's moduli everywhere: twice the preset's stiffness, blurred or not."""
    mesh = block()
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    triangles = [t for a, b, c, d in quads for t in ([a, b, c], [a, c, d])]
    corners = np.array([[x, y, z] for x in (6.0, 15.0) for y in (6.0, 15.0) for z in (-3.0, 27.0)])
    muscle = cmfsim.SurfaceData(corners, triangles)
    double = cmfsim.TissueModuli(cmfsim.FatModuli(0.006), cmfsim.MuscleModuli(0.12, 0.06))

    def stiffness(moduli):
        made = cmfsim.equivalent_material(mesh, [muscle], moduli=moduli, mixing=mixing)
        tissue = blurred(mesh, made.fraction, made.fibre, made.tissue_data, 3.0)[2]
        arrays = tissue.arrays()
        if tissue.kind == "stiffness":
            return cmfsim.Tissue.from_stiffness(arrays["stiffness"]).stiffness()
        if tissue.kind == "preset":
            return cmfsim.Tissue.preset(
                tissue.preset, arrays["fraction"], arrays["fibre"]
            ).stiffness()
        return cmfsim.Tissue.transversely_isotropic(
            *(arrays[n] for n in ("young_along", "young_across", "poisson", "fibre"))
        ).stiffness()

    np.testing.assert_allclose(stiffness(double), 2.0 * stiffness(None), rtol=1e-9, atol=1e-13)
