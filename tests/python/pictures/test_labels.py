"""Names of landmarks: each is there, within its view, and none covers another."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_pictures import read

import cmfsim
from cmfsim.pictures import canvas, landmarks, picture_landmarks

SIZE = (700, 700)
VIEWS = {"front": ((1, 0, 0), None), "left": ((0, 1, 0), "_R"), "right": ((0, -1, 0), "_L")}


@given(
    st.lists(st.floats(0.0, 100.0), min_size=1, max_size=12), st.floats(0.1, 20.0), st.booleans()
)
def test_heights_are_spread_by_isotonic_regression(heights, gap, bounded):
    """Scipy's regression of the heights with i·gap taken off has the least squares."""
    optimize = pytest.importorskip("scipy.optimize")
    steps = gap * np.arange(len(heights))
    low, high = (0.0, max(100.0, steps[-1])) if bounded else (-1e6, 1e6)
    found = landmarks.spread(heights, gap, low, high)
    order = np.argsort(heights, kind="stable")
    best = optimize.isotonic_regression(np.asarray(heights)[order] - steps).x
    expected = np.clip(best, low, high - steps[-1]) + steps
    np.testing.assert_allclose(found[order], expected, atol=1e-9)
    assert (np.diff(found[order]) >= gap - 1e-9).all()


def test_names_without_room_stand_closer_and_stay_inside():
    found = landmarks.spread([50.0, 50.0, 50.0, 50.0], 10.0, 40.0, 52.0)
    np.testing.assert_allclose(np.sort(found), [40.0, 44.0, 48.0, 52.0])
    assert landmarks.spread([], 1.0, 0.0, 1.0).shape == (0,)


def _overlap(one, other):
    return min(one[2], other[2]) > max(one[0], other[0]) + 1e-6 and (
        min(one[3], other[3]) > max(one[1], other[1]) + 1e-6
    )


@pytest.mark.parametrize(
    "seed", [s if s < 5 else pytest.param(s, marks=pytest.mark.slow) for s in range(20)]
)
def test_no_name_covers_another_on_any_head(seed):
    head = cmfsim.make_head(cmfsim.HeadParameters.random(seed))
    for sites, count in ((head.skull_landmarks, 32), (head.skin_landmarks, 14)):
        assert len(sites) == count
        for across, hidden in VIEWS.values():
            shown = {n: np.asarray(p) for n, p in sites.items() if not n.endswith(hidden or "?")}
            at = np.array(list(shown.values()))
            at = np.column_stack([at @ across, at[:, 2]])
            at = 2.5 * (at - at.mean(axis=0)) + 350.0
            boxes = landmarks.label_places(at, list(shown), SIZE).boxes
            assert len(boxes) == len(shown)
            assert not any(_overlap(a, b) for a, b in itertools.combinations(boxes, 2))
            assert (boxes[:, 0] >= -1e-6).all()
            assert (boxes[:, 2] <= SIZE[0] + 1e-6).all()
            assert (boxes[:, 1] >= landmarks.CAPTION - 1e-6).all()


def test_a_name_stands_on_the_side_of_its_point():
    at = [[100.0, 300.0], [600.0, 300.0], [350.0, 400.0], [352.0, 200.0]]
    found = landmarks.label_places(at, ["a", "b", "c", "d"], SIZE)
    assert found.left.tolist() == [True, False, False, True]


def test_every_name_is_drawn_where_it_was_placed(tmp_path):
    """Twenty points in one place: every name is legible, and its line leads to the point."""
    pytest.importorskip("pyvista")
    try:
        canvas.check_can_draw("a picture")
    except cmfsim.CaseError as error:
        pytest.skip(f"cannot draw here: {error}")
    names = [f"supra_glenoid_{i}" for i in range(20)]
    points = [landmarks.Label(name, np.array([0.1 * i, 0.0, 0.0])) for i, name in enumerate(names)]
    corners = np.array([[-100.0, -100.0, -100.0], [100.0, 100.0, 100.0]])
    path = tmp_path / "labels.png"
    toward = np.array([0.0, -1.0, 0.0])
    canvas.draw(
        path,
        [canvas.View("front", "")],
        corners,
        SIZE,
        lambda plotter, _: landmarks.add_labels(plotter, toward, points),
    )
    image = read(path)
    scale = SIZE[1] / (2.0 * canvas.MARGIN * 100.0)
    at = np.array([[350.0 + 0.1 * i * scale, 350.0] for i in range(20)])
    found = landmarks.label_places(at, names, SIZE)
    for left, bottom, right, top in found.boxes:
        inside = image[round(SIZE[1] - top) : round(SIZE[1] - bottom), round(left) : round(right)]
        dark = (inside < 110).all(axis=2)
        # Letters, and not the line alone: over most of the width, in several rows.
        assert dark.any(axis=0).mean() > 0.5
        assert dark.any(axis=1).sum() >= 8
        # No letter is cut off at either end.
        assert not dark[:, 0].any() or not dark[:, -1].any()
    assert (image[340:360, 345:362] < 110).all(axis=2).any()


def test_a_view_that_does_not_exist_is_refused(tmp_path):
    with pytest.raises(cmfsim.CaseError, match="view is 'top'"):
        picture_landmarks(
            tmp_path / "x.png", {}, None, {"skull": {"nasion": (0, 0, 0)}}, views=["top"]
        )
    with pytest.raises(cmfsim.CaseError, match="no view to draw"):
        picture_landmarks(tmp_path / "x.png", {}, None, {"skull": {"a": (0, 0, 0)}}, views=[])
    with pytest.raises(cmfsim.CaseError, match="no landmark to draw"):
        picture_landmarks(tmp_path / "x.png", {}, None, {"skull": {}})
