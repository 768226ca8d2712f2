"""Rigid motions against Rodrigues' formula and their inverse."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import cmfsim
import meshes

numbers = st.floats(-100.0, 100.0)
vectors = st.tuples(numbers, numbers, numbers)
axes = vectors.filter(lambda v: np.linalg.norm(v) > 1e-3)


@given(translation=vectors, angle=st.floats(-720, 720), axis=axes, centre=vectors)
def test_a_motion_turns_about_its_axis_through_its_centre(translation, angle, axis, centre):
    """X ↦ R (x − c) + c + t with R = exp(θ [k]×) (Rodrigues 1840)."""
    m = cmfsim.rigid_motion(translation, angle, axis, centre)
    r = m[:3, :3]
    np.testing.assert_allclose(r, meshes.rotation(axis, angle), rtol=0, atol=1e-12)
    np.testing.assert_allclose(r.T @ r, np.eye(3), rtol=0, atol=1e-14)
    centre_goes = m @ [*centre, 1.0]
    np.testing.assert_allclose(centre_goes[:3], np.add(centre, translation), rtol=0, atol=1e-10)
    assert m[3].tolist() == [0.0, 0.0, 0.0, 1.0]


@given(translation=vectors, angle=st.floats(0, 180), axis=axes, centre=vectors)
def test_decomposing_a_motion_gives_it_back(translation, angle, axis, centre):
    """rigid_motion(decompose_motion(M)) = M, at half turns too."""
    m = cmfsim.rigid_motion(translation, angle, axis, centre)
    found = cmfsim.decompose_motion(m, centre)
    assert 0.0 <= found.angle <= 180.0
    assert np.linalg.norm(found.axis) == pytest.approx(1.0, abs=1e-14)
    assert found.angle == pytest.approx(angle, abs=1e-6)
    again = cmfsim.rigid_motion(found.translation, found.angle, found.axis, found.centre)
    np.testing.assert_allclose(again, m, rtol=0, atol=1e-9)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, -1, 0), (0, 0, 1), (1, 1, 1), (-1, 2, 1e-9)])
@pytest.mark.parametrize("angle", [179.0, 179.999999, 180.0])
def test_half_turns_decompose(axis, angle):
    """The antisymmetric part of R vanishes at 180°: the axis comes from its symmetric part."""
    m = cmfsim.rigid_motion(angle=angle, axis=axis)
    found = cmfsim.decompose_motion(m)
    assert found.angle == pytest.approx(angle, abs=1e-9)
    unit = np.array(axis) / np.linalg.norm(axis)
    assert abs(found.axis @ unit) == pytest.approx(1.0, abs=1e-12)
    if angle < 180.0:
        assert found.axis @ unit > 0.0


def test_right_hand_rule_and_exact_quarter_turns():
    """+90° about z takes x to y, without a trace of cos 90° = 6e-17."""
    for turns in range(-5, 6):
        m = cmfsim.rigid_motion(angle=90.0 * turns, axis=(0, 0, 3))
        expected = [[1, 0], [0, 1], [-1, 0], [0, -1]][turns % 4]
        assert m[:2, 0].tolist() == expected


@pytest.mark.parametrize("length", [1e-300, 1e-200, 1e200])
def test_any_length_of_axis_serves(length):
    """The axis is scaled before it is squared."""
    m = cmfsim.rigid_motion(angle=30, axis=(0, length, 0))
    np.testing.assert_allclose(m[:3, :3], meshes.rotation((0, 1, 0), 30), rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    ("arguments", "pattern"),
    [
        ({"angle": 10, "axis": (0, 0, 0)}, "axis is"),
        ({"axis": (0, 0)}, r"axis has shape \(2,\)"),
        ({"translation": 5}, r"translation has shape \(\)"),
        ({"translation": (0, np.nan, 0)}, r"translation\[1\] is nan"),
        ({"centre": ("a", "b", "c")}, "centre is not three numbers"),
        ({"angle": np.inf}, "angle is inf"),
        ({"angle": "ten"}, "angle is not a number"),
    ],
)
def test_bad_numbers_are_named(arguments, pattern):
    """Which argument, which entry, which value."""
    with pytest.raises(cmfsim.BoundaryError, match=pattern) as caught:
        cmfsim.rigid_motion(**arguments)
    assert isinstance(caught.value, ValueError)


@pytest.mark.parametrize(
    ("matrix", "pattern"),
    [
        (np.eye(3), r"\(3, 3\)"),
        (np.diag([1, 1, 1, np.nan]), r"matrix\[3, 3\] is nan"),
        (np.diag([1, 1, 2, 1.0]), "not rigid"),
        (np.diag([1, 1, -1.0, 1]), "mirrors"),
        (np.diag([1, 1, 1, 2.0]), r"matrix\[3\]"),
    ],
)
def test_what_is_no_rigid_motion_is_refused(matrix, pattern):
    """Shape, NaN, scale, mirror, last row."""
    with pytest.raises(cmfsim.BoundaryError, match=pattern):
        cmfsim.decompose_motion(matrix)
