"""Tets that rest inverted are counted and said, where the deformation is large; docs/stability.md
has the bar pushed to half its length, which corotational tissue lets turn inside out.
"""

import logging

import numpy as np
import pytest

import cmfsim
import cmfsim.solving.inversion
from benches.scenes.meshes import box
from cmfsim.solving.inversion import inversion_finding, least_volume_ratios

LENGTH = 60.0  # mm


def bar(kinematics, shift=-0.5 * LENGTH, element="p1"):
    """The bar of `benches/stability/extreme/kinematics.py`, held at one end and pushed along it."""
    nodes, tets = box((6, 2, 2), (LENGTH, 20.0, 20.0), jitter=0.15)
    x = nodes[:, 0]
    return cmfsim.Scene(
        nodes,
        tets,
        tissue=cmfsim.TissueData("isotropic", young=0.003, poisson=0.46),
        fixed=np.flatnonzero(x == 0.0),
        segments={"end": cmfsim.SegmentData(joined=np.flatnonzero(x == LENGTH))},
        plan={"end": cmfsim.rigid_motion((shift, 0.0, 0.0))},
        options=cmfsim.SolverOptions(element=element, kinematics=kinematics),
    )


def signed_volumes(nodes, tets):
    corners = nodes[np.asarray(tets)]
    return np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6.0


def test_a_bar_pushed_to_half_its_length_says_which_tets_inverted(caplog):
    scene = bar("corotational")
    with caplog.at_level(logging.WARNING, logger="cmfsim"):
        result = cmfsim.solve_scene(scene)
    rest = signed_volumes(result.nodes, result.tets)
    ratios = signed_volumes(result.nodes + result.displacements, result.tets) / rest
    count, worst = int((ratios <= 0.0).sum()), int(ratios.argmin())
    assert count > 0
    assert result.summary["inverted_tets"] == count
    (said,) = (cmfsim.Finding.from_values(entry) for entry in result.summary["findings"])
    assert (said.severity, said.code) == ("warning", "inverted-tets")
    assert said.what.startswith(
        f"{count} of {len(rest)} tets are inverted at equilibrium; the worst is tet {worst},"
    )
    assert f"at {ratios[worst]:.2g} of its volume" in said.what
    middle = result.nodes[result.tets[worst]].mean(axis=0)
    assert said.where.startswith("({:.1f}, {:.1f}, {:.1f}) mm".format(*middle))
    assert "hyperelastic" in said.fix
    (record,) = caplog.records
    assert record.getMessage().startswith(f"inverted-tets: {count} of ")


def test_hyperelastic_tissue_at_half_its_length_inverts_nowhere(caplog):
    with caplog.at_level(logging.WARNING, logger="cmfsim"):
        result = cmfsim.solve_scene(bar("hyperelastic"))
    assert result.summary["inverted_tets"] == 0
    assert result.summary["findings"] == []
    assert not caplog.records


@pytest.mark.parametrize(("depth", "sideways"), [(0.7, 0.0), (0.8, 0.0), (0.6, 3.0), (0.7, 3.0)])
def test_hyperelastic_tissue_under_a_punch_inverts_nowhere(depth, sideways):
    """Stable neo-Hookean tissue alone, whose energy is finite, leaves 1 to 17 tets inverted."""
    size = (16.0, 16.0, 8.0)
    nodes, tets = box((8, 8, 4), size, jitter=0.15)
    x, y, z = nodes.T
    punch = (z == size[2]) & (abs(x - 8.0) < 2.5) & (abs(y - 8.0) < 2.5)
    scene = cmfsim.Scene(
        nodes,
        tets,
        tissue=cmfsim.TissueData("isotropic", young=0.003, poisson=0.46),
        fixed=np.flatnonzero(z == 0.0),
        segments={"punch": cmfsim.SegmentData(joined=np.flatnonzero(punch))},
        plan={"punch": cmfsim.rigid_motion((sideways, 0.0, -depth * size[2]))},
        options=cmfsim.SolverOptions(kinematics="hyperelastic"),
    )
    result = cmfsim.solve_scene(scene)
    rest = signed_volumes(result.nodes, result.tets)
    ratios = signed_volumes(result.nodes + result.displacements, result.tets) / rest
    assert 0.0 < ratios.min() < 0.3
    assert result.summary["inverted_tets"] == 0
    assert result.summary["residual"] < 1e-12


def test_linear_kinematics_counts_nothing_and_pays_nothing(monkeypatch, caplog):
    """Though this bar's end passes through the held one."""
    monkeypatch.delattr(cmfsim.solving.inversion, "inversion_finding")
    result = cmfsim.solve_scene(bar("linear", shift=-1.5 * LENGTH))
    moved = signed_volumes(result.nodes + result.displacements, result.tets)
    assert moved.min() < 0.0
    assert result.summary["inverted_tets"] is None
    assert result.summary["findings"] == []
    assert not caplog.records


def test_volumes_of_quadratic_tets_are_those_of_the_field_at_middle_and_corners():
    """u_i = x·A_i x + B_i·x is in the space of quadratic tets: F = I + (A_i + A_iᵀ) x + B."""
    nodes, tets = box((2, 2, 1), (2.0, 2.0, 1.0), jitter=0.2)
    mesh = cmfsim.TetMesh(nodes, tets)
    tensors = cmfsim.MassTensors(mesh, cmfsim.Tissue.isotropic(0.003, 0.46), element="p2")
    rng = np.random.default_rng(4)
    a, b = rng.normal(scale=0.4, size=(3, 3, 3)), rng.normal(scale=0.2, size=(3, 3))

    def field(x):
        return np.einsum("ijk,nj,nk->ni", a, x, x) + x @ b.T

    def ratio(x):
        gradient = np.einsum("ijk,nk->nij", a + a.transpose(0, 2, 1), x) + b
        return np.linalg.det(np.eye(3) + gradient)

    corners = mesh.nodes[mesh.tets]
    places = np.concatenate([corners, corners.mean(axis=1, keepdims=True)], axis=1)
    expected = np.stack([ratio(places[:, k]) for k in range(5)], axis=1)
    found = least_volume_ratios(tensors, field(tensors.nodes))
    np.testing.assert_allclose(found, expected.min(axis=1), rtol=1e-11, atol=1e-12)
    # Each of the five decides somewhere, and corners find what the middles do not.
    assert set(expected.argmin(axis=1)) >= {0, 1, 2, 3}
    assert (found <= 0.0).sum() > (expected[:, 4] <= 0.0).sum()
    assert inversion_finding(tensors, field(tensors.nodes))[0] == (found <= 0.0).sum()


@pytest.mark.parametrize("element", ["p1", "anp", "p2"])
def test_a_collapsed_tet_counts_and_a_turned_one_does_not(element):
    mesh = cmfsim.TetMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 2, 3]])
    tensors = cmfsim.MassTensors(mesh, cmfsim.Tissue.isotropic(0.003, 0.46), element=element)
    flat = tensors.nodes * [0.0, 0.0, -1.0]
    assert inversion_finding(tensors, flat)[0] == 1
    turn = cmfsim.rigid_motion((1.0, 2.0, 3.0), 170.0, (1.0, 1.0, 0.0))
    turned = tensors.nodes @ turn[:3, :3].T + turn[:3, 3] - tensors.nodes
    np.testing.assert_allclose(least_volume_ratios(tensors, turned), 1.0, rtol=1e-12)
    assert inversion_finding(tensors, turned) == (0, None)


@pytest.mark.parametrize("element", ["p1", "p2"])
@pytest.mark.parametrize("bad", ["short", "nan"])
def test_displacements_that_cannot_be_meant_are_refused(element, bad):
    mesh = cmfsim.TetMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 2, 3]])
    tensors = cmfsim.MassTensors(mesh, cmfsim.Tissue.isotropic(0.003, 0.46), element=element)
    u = np.zeros((len(tensors.nodes), 3))
    u = u[:-1] if bad == "short" else np.where(np.arange(3) == 1, np.nan, u)
    with pytest.raises(cmfsim.MeshError):
        inversion_finding(tensors, u)


def test_the_count_is_kept_in_files_of_results(tmp_path):
    result = cmfsim.solve_scene(bar("corotational"))
    for name in ("result.npz", "result.vtu"):
        if name.endswith(".vtu"):
            pytest.importorskip("meshio")
        cmfsim.write_result(tmp_path / name, result)
    read = cmfsim.read_result(tmp_path / "result.npz")
    assert read.summary["inverted_tets"] == result.summary["inverted_tets"]
    assert read.summary["findings"] == result.summary["findings"]
