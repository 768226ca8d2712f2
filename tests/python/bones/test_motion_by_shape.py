"""Motions by shape: slip of fitted vertices, another size, resected bone, open directions."""

import json

import numpy as np
import pytest

import cmfsim
import real_heads
from benches.scenes import meshes
from cmfsim.bones.achieved import measure_pair, motion_by_vertices
from cmfsim.bones.pairs.shape_fit import BLOCKS, fit_shape
from pebbles import apart, moved, operated_bone, pebble, without

MOTION = cmfsim.rigid_motion((1.0, -5.0, 2.0), 4.0, (1, 0.2, 0.3), (0, -30, 0))
# A template's vertices that slid, another calibration, an end resected, noise of two scans.
WORST = {"slip": 2.0, "scale": 1.04, "cut": (0, 0.1), "noise": 0.3}


def missed(found, before):
    """How far a motion takes the middle of a bone from where it went, mm, and its turn, degrees."""
    return apart(found, MOTION, MOTION[:3] @ [*np.asarray(before.vertices).mean(axis=0), 1.0])


@pytest.mark.parametrize("seed", range(3))
def test_slip_size_noise_and_resected_bone_leave_the_motion_of_paired_bone(seed):
    """Within 0.2 mm and 0.3°, where the vertices' own rigid fit is off by 0.8 mm or more."""
    before = pebble(4, seed)
    after = operated_bone(before, MOTION, **WORST, seed=seed)
    by_vertices = motion_by_vertices(before, after)
    assert max(missed(by_vertices.matrix, before)) > 0.8
    found = measure_pair(before, after)
    shift, turn = missed(found.matrix, before)
    assert shift < 0.2
    assert turn < 0.3
    assert found.method == "shape"
    assert found.plan is found.matrix
    assert 1.5 < found.slip < 2.5
    low, high = found.fit.scale_interval
    assert low < 1.04 < high < 1.06
    (patch,) = found.removed
    assert patch.place[0] > np.quantile(np.asarray(before.vertices)[:, 0], 0.9)
    assert patch.depth > 1.5
    assert not found.fit.open
    assert json.loads(json.dumps(found.as_dict(), allow_nan=False))["shape"]["open"] == []


@pytest.mark.parametrize("scale", [0.95, 1.0, 1.05])
def test_a_bone_of_other_triangles_keeps_its_motion_whatever_its_size(scale):
    """5 % were refused; the size is in its interval, and no part of the motion."""
    before = pebble(4, 2)
    after = operated_bone(pebble(5, 2), MOTION, scale=scale, cut=(0, 0.1), noise=0.3)
    found = cmfsim.achieved_plan({"jaw": before}, after).motions["jaw"]
    shift, turn = missed(found.matrix, before)
    assert shift < 0.2
    assert turn < 0.3
    low, high = found.fit.scale_interval
    assert low < scale < high
    assert (low <= 1.0 <= high) == (scale == 1.0)


def test_another_bone_is_refused_whatever_its_size():
    with pytest.raises(cmfsim.RegistrationError, match=r"at the best size|times as"):
        cmfsim.achieved_plan(
            {"jaw": pebble(4, 2)}, moved(pebble(5, 2), np.diag([1.3, 1.3, 1.3, 1]))
        )


def test_the_interval_is_that_of_a_refit_without_each_block():
    """The jackknife's steps against whole refits, each without the vertices of an eighth."""
    before = pebble(4, 1)
    after = operated_bone(before, MOTION, scale=1.04, noise=0.3)
    bone = cmfsim.Surface(after.vertices, after.triangles)
    found = fit_shape(before, bone, MOTION)
    vertices = np.asarray(before.vertices)
    signs = (vertices > np.median(vertices, axis=0)) @ [1, 2, 4]
    parts = [fit_shape(without(before, signs != n), bone, MOTION).scale for n in range(8)]
    spread = np.sqrt(7 / 8 * ((np.array(parts) - np.mean(parts)) ** 2).sum())
    half = (found.scale_interval[1] - found.scale_interval[0]) / 2.0
    assert BLOCKS == 32
    assert spread < half < 0.015


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_a_shape_that_leaves_turns_open_says_so(noise):
    """A ball turns unseen about all axes, an egg about one: the motion there is the vertices'."""
    vertices, triangles = meshes.icosphere(4, 20.0)
    for stretch, n_open in (((1.0, 1.0, 1.0), 3), ((1.0, 1.0, 1.6), 1)):
        before = cmfsim.SurfaceData(vertices * stretch, triangles)
        after = operated_bone(before, MOTION, slip=2.0, noise=noise)
        found = measure_pair(before, after)
        assert len(found.fit.open) == n_open
        assert all(way.is_turn for way in found.fit.open)
        assert found.fit.eigenvalue_ratio < 0.01
    assert abs(found.fit.open[0].axis[:3] @ MOTION[:3, :3] @ [0, 0, 1]) > 0.99
    kind = found.as_dict()["shape"]["open"][0]["kind"]
    assert kind == "turn"


def test_a_flat_plate_leaves_its_shifts_open():
    """Within its plane only a rim would show where a plate is; its size neither."""
    x, y = np.meshgrid(np.linspace(-20, 20, 21), np.linspace(-20, 20, 21))
    vertices = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    corner = (np.arange(20)[:, None] * 21 + np.arange(20)).ravel()
    triangles = np.concatenate(
        [
            np.column_stack([corner, corner + 1, corner + 22]),
            np.column_stack([corner, corner + 22, corner + 21]),
        ]
    )
    plate = cmfsim.SurfaceData(vertices, triangles)
    fit = fit_shape(plate, cmfsim.Surface(vertices + [0, 0, 1.0], triangles), np.eye(4))
    assert len(fit.open) == 3
    assert fit.scale == 1.0
    assert fit.scale_interval == (0.85, 1.15)
    np.testing.assert_allclose(fit.matrix[:3, 3], [0, 0, 1.0], atol=1e-6)


def test_a_bone_of_another_shape_is_followed_vertex_by_vertex():
    """A chin that was advanced, or set back, with the jaw is no part of one rigid bone."""
    before = pebble(4, 2)
    vertices = np.asarray(before.vertices)
    for shift in (-5.0, 4.0):
        pushed = vertices + np.outer(vertices[:, 1] < -10.0, [0.0, shift, 0.0])
        after = moved(cmfsim.SurfaceData(pushed, before.triangles), MOTION)
        found = measure_pair(before, after)
        assert found.method == "vertices"
        assert not found.is_rigid
        np.testing.assert_allclose(found.plan.moved_vertices, after.vertices, atol=0.05)


def test_a_bone_that_was_left_alone_keeps_what_changed_without_the_slip():
    """A midface that came forward by 0.8 mm under vertices that slid by 2 mm."""
    before = pebble(5, 1)
    vertices = np.asarray(before.vertices)
    surface = cmfsim.Surface(before.vertices, before.triangles)
    normals = np.asarray(surface.vertex_normals)
    front = np.exp(-(((vertices - vertices[np.argmin(vertices[:, 1])]) / 8.0) ** 2).sum(axis=1))
    grown = cmfsim.SurfaceData(vertices + 0.8 * front[:, None] * normals, before.triangles)
    after = operated_bone(grown, np.eye(4), slip=2.0)
    found = measure_pair(before, after, is_still=True)
    assert found.method == "shape"
    went = found.plan.moved_vertices - vertices
    worst = int(np.argmax(front))
    assert np.linalg.norm(went[worst]) == pytest.approx(0.8, abs=0.15)
    assert np.median(np.linalg.norm(went[front < 0.01], axis=1)) < 0.1
    by_vertices = np.linalg.norm(np.asarray(after.vertices) - vertices, axis=1)
    assert np.median(by_vertices) > 1.5
    assert measure_pair(before, after).is_rigid


BONES = [
    pytest.param("ct_phantom", "mandible", marks=pytest.mark.slow),
    ("atlas_head", "mandible"),
    ("atlas_head", "maxilla_lefort1"),
]


@pytest.mark.parametrize(("head", "name"), BONES)
def test_real_bones_with_slip_size_noise_and_a_resected_end(head, name):
    """Paired, and remeshed to half of the triangles."""
    before = real_heads.read_ply(head, name)
    after = operated_bone(before, MOTION, **WORST)
    assert max(missed(motion_by_vertices(before, after).matrix, before)) > 0.5
    pv = pytest.importorskip("pyvista")
    coarse = pv.PolyData.from_regular_faces(after.vertices, after.triangles).decimate(0.5)
    remeshed = cmfsim.SurfaceData(np.asarray(coarse.points, dtype=float), coarse.regular_faces)
    for found in (
        measure_pair(before, after),
        cmfsim.achieved_plan({name: before}, remeshed).motions[name],
    ):
        shift, turn = missed(found.matrix, before)
        assert shift < 0.2
        assert turn < 0.3
        assert found.is_rigid
        low, high = found.fit.scale_interval
        assert low < 1.04 < high
