"""The built-in template, and a small one of two boxes."""

import numpy as np
import pytest
from box_muscles import box, strap

import cmfsim


@pytest.fixture(scope="module")
def default():
    """The built-in template."""
    return cmfsim.MuscleTemplate.load("default")


@pytest.fixture(scope="module")
def small(default):
    """Two boxes on either side of a skull that is a box, with the built-in one's landmarks."""
    points = dict(default.landmarks)
    low, high = np.min(list(points.values()), axis=0), np.max(list(points.values()), axis=0)
    left = strap("masseter_L", (40, -60, -50), (50, -40, -10), boxes=2)
    right = strap("masseter_R", (-50, -60, -50), (-40, -40, -10), boxes=2)
    return cmfsim.MuscleTemplate(
        name="small",
        muscles=(left, right),
        skull=box(low, high),
        landmarks=points,
        definitions=cmfsim.SKULL_LANDMARKS,
        licence='none "at all"\n\x7f',
        attribution="nobody",
        source="a test",
        concepts={"masseter_L": ("X1", "X2")},
    )


@pytest.fixture
def folder(small, tmp_path):
    """The small template on disk."""
    pytest.importorskip("meshio")
    small.save(tmp_path / "atlas")
    return tmp_path / "atlas"
