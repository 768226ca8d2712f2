"""Skin where the tissue ends, and points next to the skin of a mesh."""

import numpy as np
import pytest

import cmfsim
from cmfsim.values.skin_motion import FADE, FOLLOWS, attachment, carried_points, skin_end

STEP = 2.0


def strip(rows=20, columns=10):
    """A flat skin with vertices 2 mm apart, facing up; its last row lies at y = 38 mm."""
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    vertices = STEP * np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    lower = np.column_stack([first, first + 1, first + columns + 1])
    upper = np.column_stack([first, first + columns + 1, first + columns])
    return cmfsim.SurfaceData(vertices, np.concatenate([lower, upper]))


def test_the_held_row_moves_as_the_skin_before_it():
    """Displacements that end in a step from 3 mm to 0: the step is gone, the rest is as it was."""
    skin = strip()
    y = skin.vertices[:, 1]
    held = y == y.max()
    solved = np.where(held, 0.0, 3.0)[:, None] * np.array([0.0, 1.0, 0.0])
    end = skin_end(skin, held)
    found = end.continued(solved)
    far = y < y.max() - STEP - 4.0
    np.testing.assert_array_equal(found[far], solved[far])
    assert not np.isin(np.flatnonzero(far), end.vertices).any()
    # 100 rounds of averaging leave less than 2 % of the step.
    assert found[held, 1].min() > 2.94
    assert np.abs(found).max() <= 3.0


def test_it_is_linear_and_takes_columns():
    skin = strip()
    held = skin.vertices[:, 1] == skin.vertices[:, 1].max()
    end = skin_end(skin, held)
    columns = np.random.default_rng(0).normal(size=(len(skin.vertices), 3, 5))
    numbers = np.arange(5.0)
    np.testing.assert_allclose(
        end.continued(columns) @ numbers, end.continued(columns @ numbers), atol=1e-12
    )


def test_a_skin_that_no_plane_holds_keeps_its_displacements():
    skin = strip()
    solved = np.random.default_rng(0).normal(size=skin.vertices.shape)
    end = skin_end(skin, np.zeros(len(skin.vertices), dtype=bool))
    np.testing.assert_array_equal(end.continued(solved), solved)
    # A patch that is held everywhere has nothing to be continued from.
    everywhere = skin_end(skin, np.ones(len(skin.vertices), dtype=bool))
    assert not everywhere.continued(np.zeros_like(solved)).any()


def test_movement_fades_over_25_mm_behind_the_end():
    """Points behind a strip that moves 4 mm back: all of it at first, then less, then none."""
    skin = strip()
    end, edge = skin.vertices[:, 1].max(), STEP * (2.0 + np.sqrt(2.0)) / 3.0
    away = np.linspace(0.0, FOLLOWS * edge + FADE + 5.0, 200)
    points = np.column_stack([np.full(200, 5.0), end + away, np.zeros(200)])
    moved = carried_points(skin, np.full(skin.vertices.shape, [0.0, 4.0, 0.0]), points)[:, 1]
    np.testing.assert_allclose(moved[away <= FOLLOWS * edge], 4.0)
    np.testing.assert_allclose(moved[away >= FOLLOWS * edge + FADE], 0.0, atol=1e-12)
    assert (np.diff(moved) <= 1e-12).all()
    # A smooth step is steepest in its middle: 1.5 times its mean slope.
    slope = -np.diff(moved) / np.diff(away)
    assert slope.max() == pytest.approx(1.5 * 4.0 / FADE, rel=1e-3)


def test_a_turn_of_the_skin_does_not_swing_what_is_far_from_it():
    """Turned by 10° about its own end: a point 20 mm behind moves no more than one an edge away."""
    skin = strip()
    end = skin.vertices[:, 1].max()
    turn = cmfsim.rigid_motion((0, 0, 0), 10.0, (1, 0, 0), (0, end, 0))
    moved = skin.vertices @ turn[:3, :3].T + turn[:3, 3] - skin.vertices
    points = np.array([[5.0, end + away, 0.0] for away in (STEP, 10.0, 20.0)])
    size = np.linalg.norm(carried_points(skin, moved, points), axis=1)
    assert size.max() < 2.0 * STEP * np.sin(np.radians(10.0))
    near = skin.vertices + [0.0, 0.0, 1.0]
    np.testing.assert_allclose(
        carried_points(skin, moved, near), near @ turn[:3, :3].T + turn[:3, 3] - near, atol=1e-9
    )


def test_points_near_the_skin_are_attached_where_they_are():
    skin = strip()
    points = np.array([[5.0, 11.0, 1.5], [5.0, 11.0, 40.0]])
    found = attachment(skin.searched, points)
    np.testing.assert_array_equal(found.places[0], points[0])
    np.testing.assert_allclose(found.closest[:, 2], 0.0, atol=1e-12)
    assert found.share.tolist() == [1.0, 0.0]
