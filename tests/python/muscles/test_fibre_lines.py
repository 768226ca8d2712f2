"""Fibre lines of flat muscles follow the rule that they are drawn by, and stay inside."""

import numpy as np
import pytest

import cmfsim
from cmfsim.muscles.template.fibre_lines import fan_lines, lane_lines


def shell(height, corners, *, cells=24, thickness=2.0):
    """A closed shell over a patch of the plane: (u, v) in the unit square to x, y, and z above."""
    u, v = np.meshgrid(np.linspace(0, 1, cells), np.linspace(0, 1, cells), indexing="ij")
    x, y = corners(u.ravel(), v.ravel())
    top = np.column_stack([x, y, height(x, y) + 0.5 * thickness])
    low = top - [0.0, 0.0, thickness]
    index = np.arange(cells * cells).reshape(cells, cells)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    quads = np.stack([a, b, c, d], axis=-1).reshape(-1, 4)
    upper = np.vstack([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    lower = upper[:, ::-1] + len(top)
    rim = np.concatenate([index[:-1, 0], index[-1, :-1], index[:0:-1, -1], index[0, :0:-1]])
    after = np.roll(rim, -1)
    sides = np.vstack(
        [
            np.column_stack([after, rim, rim + len(top)]),
            np.column_stack([after, rim + len(top), after + len(top)]),
        ]
    )
    return cmfsim.SurfaceData(np.vstack([top, low]), np.vstack([upper, lower, sides]))


def bent(x, y):
    """A sheet that bends as over a skull."""
    return 6.0 * np.cos(x / 25.0) + 0.02 * y**2


def fan_patch(u, v):
    """From the tip at the origin 60 mm far, 70° wide."""
    radius, angle = 2.0 + 58.0 * u, np.radians(-35.0 + 70.0 * v)
    return radius * np.cos(angle), radius * np.sin(angle)


def test_the_lines_of_a_fan_run_to_its_tip_in_the_middle_of_the_sheet():
    fan = shell(bent, fan_patch)
    lines = fan_lines(fan, (0.0, 0.0, 6.0), (0.0, 0.0, 1.0), lines=7)
    assert len(lines) == 7
    for line in lines:
        radius = np.hypot(line[:, 0], line[:, 1])
        assert (np.diff(radius) < 0.0).all(), "from origin to insertion"
        angle = np.arctan2(line[:, 1], line[:, 0])
        assert np.ptp(angle) < 1e-9, "straight in the view along the thin axis"
        assert np.abs(line[:, 2] - bent(line[:, 0], line[:, 1])).max() < 0.1
    spread = np.degrees([np.arctan2(line[0, 1], line[0, 0]) for line in lines])
    assert spread.max() - spread.min() > 55.0


def test_the_lines_of_a_fan_that_points_backwards_are_not_cut_at_a_half_turn():
    turned = shell(bent, lambda u, v: [-c for c in fan_patch(u, v)])
    lines = fan_lines(turned, (0.0, 0.0, 6.0), (0.0, 0.0, 1.0), lines=7)
    assert min(len(line) for line in lines) > 20


def test_lanes_are_parallel_and_run_from_origin_to_insertion():
    sheet = shell(bent, lambda u, v: (80.0 * u - 40.0, 30.0 * v))
    lines = lane_lines(sheet, (1.0, 0.2, 0.0), (0.0, 0.0, 1.0), lines=5)
    for line in lines:
        step = np.diff(line[:, :2], axis=0)
        assert (step @ [1.0, 0.2] > 0.0).all()
        assert np.abs(step @ [-0.2, 1.0]).max() < 1e-9
        assert np.abs(line[:, 2] - bent(line[:, 0], line[:, 1])).max() < 0.1


def test_a_gap_ends_a_line_instead_of_being_crossed():
    """Two patches side by side: a line along both keeps to the longer."""
    one = shell(bent, lambda u, v: (50.0 * u, 20.0 * v))
    two = shell(bent, lambda u, v: (70.0 + 20.0 * u, 20.0 * v))
    n = len(one.vertices)
    both = cmfsim.SurfaceData(
        np.vstack([one.vertices, two.vertices]),
        np.vstack([one.triangles, two.triangles.astype(int) + n]),
    )
    for line in lane_lines(both, (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)):
        assert line[:, 0].max() <= 50.0


def test_a_surface_of_one_face_has_no_middle_and_is_refused():
    face = cmfsim.SurfaceData([[0, 0, 0], [60, 0, 0], [0, 40, 0]], [[0, 1, 2]])
    with pytest.raises(cmfsim.MeshError, match="closed"):
        lane_lines(face, (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    with pytest.raises(ValueError, match="closed"):
        fan_lines(face, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
