"""The angles by which other tests judge directions: right to rounding at 0, 180 and between."""

import numpy as np
import pytest

from benches.scenes import meshes
from benches.scenes.angles import angle_between, angle_of_lines, angle_of_rotation

SIZES = (0.0, 1e-12, 1e-9, 1e-6, 0.3, 45.0, 90.0, 135.0, 179.999999, 180.0)


def turned(vector, degrees):
    """A vector turned about an axis at right angles to it."""
    axis = np.cross(vector, (0.3, -0.2, 0.9))
    axis /= np.linalg.norm(axis)
    a = np.radians(degrees)
    return np.cos(a) * np.asarray(vector) + np.sin(a) * np.cross(axis, vector)


@pytest.mark.parametrize("degrees", SIZES)
def test_angles_are_right_at_either_end_of_the_range(degrees):
    """In 200 directions, of any length: an arccosine is wrong by 1e-6° here."""
    one = np.random.default_rng(0).normal(size=(200, 3)) * 7.0
    other = np.array([3.0 * turned(v, degrees) for v in one])
    np.testing.assert_allclose(angle_between(one, other), degrees, rtol=0, atol=1e-13 * 180)
    line = min(degrees, 180.0 - degrees)
    np.testing.assert_allclose(angle_of_lines(one, other), line, rtol=0, atol=1e-13 * 180)


@pytest.mark.parametrize("degrees", SIZES)
def test_the_angle_of_a_rotation_is_its_own(degrees):
    rotation = meshes.rotation((1.0, -2.0, 0.5), degrees)
    assert angle_of_rotation(rotation) == pytest.approx(degrees, rel=1e-12, abs=1e-12)


def test_a_vector_without_a_direction_is_refused():
    with pytest.raises(ValueError, match="length 0"):
        angle_between([[1, 0, 0], [0, 0, 0]], [0, 1, 0])
