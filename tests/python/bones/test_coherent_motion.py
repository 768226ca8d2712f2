"""Bones in rigid pieces: jaws that move within one surface, slip, noise, bending, and grinding."""

import numpy as np
import pytest

import cmfsim
from benches.accuracy.paired_motion import (
    ALL,
    EXACT,
    MOVES,
    Tally,
    found_motion,
    moved_mandible,
    moved_maxilla,
    pair_of,
    synthetic_head,
)
from benches.scenes import meshes
from cmfsim.bones.achieved import measure_pair
from cmfsim.bones.pairs.coherent_motion import coherent_motion
from cmfsim.bones.pairs.paired_surfaces import AlongSurface


@pytest.fixture(scope="module")
def head():
    pytest.importorskip("skimage")
    return synthetic_head(0, spacing=3.0)


def teeth(head, pair, label="supradentale"):
    """The mean error of the motion near the teeth, mm, and the patches taken for removed."""
    used, got, removed = found_motion(pair)
    near = np.linalg.norm(np.asarray(pair.before.vertices)[used] - head.at[label], axis=1) < 15.0
    return float(np.linalg.norm(got - pair.true[used], axis=1)[near].mean()), removed


@pytest.mark.parametrize("move", ["advance 1", "setback 3, impaction 2", "yaw 4°"])
def test_a_jaw_that_moves_within_its_skull_is_followed(head, move):
    """Rigid pieces in one surface, whatever the direction; nothing counts as removed."""
    pair = pair_of(
        head, "skull", lambda x: moved_maxilla(head, x, move), "exact", seed=0, cut=False
    )
    error, removed = teeth(head, pair)
    assert error < EXACT
    assert removed == ()


@pytest.mark.parametrize("bone", [pytest.param("skull", marks=pytest.mark.slow), "mandible"])
def test_slip_noise_and_bending_at_once_leave_the_motion(head, bone):
    """Slip alone puts vertices 0.8 mm off; what is found is nearer than what the vertices say."""
    move = "setback 3, impaction 2"
    going = {
        "skull": lambda x: moved_maxilla(head, x, move),
        "mandible": lambda x: moved_mandible(head, x, move, "split"),
    }[bone]
    pair = pair_of(head, bone, going, "slip 1, noise, bending", seed=3, cut=False)
    label = "supradentale" if bone == "skull" else "infradentale"
    error, _ = teeth(head, pair, label)
    near = np.linalg.norm(np.asarray(pair.before.vertices) - head.at[label], axis=1) < 15.0
    raw = np.linalg.norm(np.asarray(pair.after.vertices) - pair.true, axis=1)[near].mean()
    assert error < ALL
    assert error < 0.8 * raw


def test_averages_along_a_surface_are_those_of_a_walk():
    """Step by step; and over 10 mm, a spot becomes as wide as that along each axis."""
    surface = cmfsim.SurfaceData(*meshes.icosphere(5, 40.0))
    along = AlongSurface(surface)
    matrix, step = along._walk
    values = np.random.default_rng(0).normal(size=(len(along.here), 3))
    walked = values
    for _ in range(round(10.0**2 / step)):
        walked = matrix @ walked
    np.testing.assert_allclose(along.averaged(values, 10.0), walked, atol=1e-9)
    spot = np.zeros(len(along.here))
    spot[0] = 1.0
    share = along.averaged(spot, 10.0) * along.areas
    away = np.linalg.norm(along.here - along.here[0], axis=1)
    assert np.sqrt((share * away**2).sum() / share.sum() / 2.0) == pytest.approx(10.0, rel=0.1)


def test_a_ground_spine_is_found_in_a_jaw_that_moved(head):
    tally = Tally({})
    for seed, condition in enumerate(("exact", "slip 1, noise, bending")):
        going = lambda x: moved_maxilla(head, x, "setback 3, impaction 2")  # noqa: E731
        tally.add_cut(head, "skull", pair_of(head, "skull", going, condition, seed=seed, cut=True))
    assert tally.found == tally.cut == 2


def test_pieces_are_stated_with_their_motions(head):
    pair = pair_of(
        head, "skull", lambda x: moved_maxilla(head, x, "advance 4"), "exact", seed=0, cut=False
    )
    found = measure_pair(pair.before, pair.after)
    assert found.method == "vertices"
    skull, jaw = found.pieces
    np.testing.assert_allclose(skull.matrix, np.eye(4), atol=0.01)
    tooth = np.append(head.at["supradentale"], 1.0)
    moved = (jaw.matrix @ tooth - tooth)[:3]
    assert np.linalg.norm(moved - np.array(MOVES["advance 4"][0])) < 0.05
    assert skull.area > jaw.area
    assert [set(piece) for piece in found.as_dict()["pieces"]] == [{"matrix", "area_mm2"}] * 2


def test_the_order_of_vertices_does_not_matter(head):
    pair = pair_of(
        head, "skull", lambda x: moved_maxilla(head, x, "advance 4"), "exact", seed=0, cut=False
    )
    here, there = np.asarray(pair.before.vertices), np.asarray(pair.after.vertices)
    order = np.random.default_rng(0).permutation(len(here))
    back = np.argsort(order)
    other = cmfsim.SurfaceData(here[order], back[np.asarray(pair.before.triangles)])
    one = coherent_motion(cmfsim.MovedSurface(pair.before, there))
    two = coherent_motion(cmfsim.MovedSurface(other, there[order]))
    np.testing.assert_allclose(
        np.asarray(two.motion.moved_vertices)[back], one.motion.moved_vertices, atol=0.02
    )
