"""Skin that is stretched or turned over as no skin is, on surfaces and in a prediction."""

import numpy as np
import pytest

import cmfsim
from cmfsim.solving.models import tear_finding
from shared_values import coarse_demo_patient

# Two triangles with a common edge, 4 mm wide.
SQUARE = cmfsim.SurfaceData(
    [[0, 0, 0], [4, 0, 0], [4, 4, 0], [0, 4, 0]], np.array([[0, 1, 2], [0, 2, 3]])
)


def stretched(factor, skin=SQUARE):
    """The finding on a skin stretched along x."""
    return tear_finding(skin, skin.vertices * [factor - 1.0, 0.0, 0.0])


def test_edges_stretched_by_more_than_half_are_counted():
    assert stretched(1.49) is None
    found = stretched(1.6)
    # Both edges along x; the diagonal becomes 1.33 times as long.
    assert "2 edges" in found.what
    assert "from 4.0 to 6.4 mm" in found.what
    assert found.code == "skin-torn"
    assert found.severity == "warning"
    assert found.where == "about (2, 0, 0) mm"


def test_what_is_too_small_to_be_seen_is_not_counted():
    tiny = cmfsim.SurfaceData(0.4 * SQUARE.vertices, SQUARE.triangles)
    assert stretched(1.6, tiny) is None
    assert stretched(-1.0, cmfsim.SurfaceData(0.2 * SQUARE.vertices, SQUARE.triangles)) is None


def test_triangles_that_turn_over_are_counted():
    """Mirrored, no edge is longer; both triangles face the other way."""
    found = stretched(-1.0)
    assert found.what == "2 triangles are turned over in the predicted skin"
    assert stretched(-2.0).what.endswith(", and 2 triangles are turned over")


@pytest.fixture(scope="module")
def patient(tmp_path_factory):
    return coarse_demo_patient(tmp_path_factory)


def test_a_prediction_warns_of_torn_skin(patient):
    """A motion that no surgeon plans tears the skin; the case's own does not."""
    for size, torn in ((4.0, False), (60.0, True)):
        motion = cmfsim.rigid_motion(translation=(0.0, -size, 0.0))
        found = cmfsim.predict_patient(patient.with_plan({"maxilla": motion}), "H")
        assert ("skin-torn" in {f.code for f in found.findings}) == torn
        assert ("skin-torn" in {f["code"] for f in found.summary["findings"]}) == torn


def test_no_row_of_dents_where_the_tissue_ends(patient):
    """The whole mandible 5 mm back: skin on the planes follows, and fades behind them.

    What is farther from the planes keeps its solution to the bit.
    """
    back = cmfsim.rigid_motion(translation=(0.0, 5.0, 0.0))
    jaw = dict.fromkeys(("mandible_body", "ramus_left", "ramus_right"), back)
    found = cmfsim.predict_patient(patient.with_plan(jaw), "H")
    skin, end, moved = found.skin_before, found.patient.skin_end, found.skin_displacements
    solved = found.result.displacements[found.skin_nodes]
    inner = np.setdiff1d(np.arange(len(solved)), end.vertices)
    np.testing.assert_array_equal(moved[inner], solved[inner])
    on_plane = end.vertices[np.linalg.norm(solved[end.vertices], axis=1) == 0.0]
    leads = on_plane[moved[on_plane, 1].argmax()]
    assert moved[leads, 1] > 0.5
    behind = skin.vertices[leads] + [[0.0, 5.0, 0.0], [0.0, 80.0, 0.0]]
    near, far = found.carried(behind)
    assert 0.5 < near[1] <= moved[:, 1].max()
    assert not far.any()
