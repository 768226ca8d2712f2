"""Errors on the skin and as boxes: colours where they belong, the same bytes each time."""

import sys

import numpy as np
import pytest
from test_pictures import painted, read

import cmfsim
from benches.scenes import meshes
from cmfsim import pictures

pytest.importorskip("pyvista")
pytest.importorskip("matplotlib")
SIZE = (900, 300)
BLUE, RED, GREY = "#1d3f87", "#84172a", "#cfcac2"


@pytest.fixture(scope="module")
def ball():
    return cmfsim.SurfaceData(*meshes.icosphere(3, 20.0))


@pytest.fixture(scope="module", autouse=True)
def _screen(tmp_path_factory, ball):
    """Skips where this machine cannot draw at all, saying why."""
    path = tmp_path_factory.mktemp("screen") / "ball.png"
    try:
        pictures.picture_distances(path, ball, np.zeros(len(ball.vertices)), size=(90, 60))
    except cmfsim.CaseError as error:
        pytest.skip(f"cannot draw here: {error}")


def test_behind_is_blue_in_front_is_red_and_unknown_is_grey(ball, tmp_path):
    """The left half behind by more than the bar, the right in front, the top not evaluated."""
    x, _, z = np.asarray(ball.vertices).T
    distances = np.ma.array(np.where(x > 0, -8.0, 8.0), mask=z > 10.0)
    path = tmp_path / "errors.png"
    pictures.picture_distances(path, ball, distances, regions={"chin": -5.0}, size=SIZE)
    image = read(path)
    right, front, left = (slice(300 * k, 300 * k + 300) for k in range(3))
    # The legend is below the views.
    low = image[:-70]
    assert painted(low, RED, right) > 2000
    assert painted(low, BLUE, right) == 0
    assert painted(low, BLUE, left) > 2000
    # The right of the patient is on the left of the picture.
    assert painted(low, RED, slice(300, 440)) > 1000
    assert painted(low, BLUE, slice(460, 600)) > 1000
    assert painted(low, RED, slice(460, 600)) == 0
    assert painted(image[:120], GREY, front) > 300
    # The swatch of the region has the colour of its mean.
    assert painted(image, BLUE, slice(10, 32)) >= 200


def test_colours_run_evenly_between_the_ends():
    assert pictures.distance_colour(-5.0) == BLUE
    assert pictures.distance_colour(-99.0) == BLUE
    assert pictures.distance_colour(5.0) == RED
    assert pictures.distance_colour(2.0, limit=2.0) == RED
    assert pictures.distance_colour(0.0) == "#f3f1ec"
    channel = [int(pictures.distance_colour(d)[1:3], 16) for d in np.linspace(-5, 0, 40)]
    assert all(np.diff(channel) >= 0)


def test_the_same_errors_give_the_same_files(ball, tmp_path):
    rng = np.random.default_rng(0)
    distances = rng.normal(0, 2, len(ball.vertices))
    groups = {"P1": {"H": distances, "M+S": 0.5 * distances}, "P2": {"H": distances}}
    for name in ("one", "other"):
        pictures.picture_distances(tmp_path / f"{name}.png", ball, distances, size=SIZE)
        pictures.chart_errors(tmp_path / f"{name}.svg", groups)
    for kind in ("png", "svg"):
        one, other = (tmp_path / f"{n}.{kind}" for n in ("one", "other"))
        assert one.read_bytes() == other.read_bytes()


def test_a_chart_says_its_groups_models_and_outliers(tmp_path):
    values = np.r_[np.linspace(0.5, 1.5, 99), 30.0]
    path = tmp_path / "errors.svg"
    pictures.chart_errors(path, {"P1": {"H": values, "mine": -values}, "upper lip": {"H": values}})
    text = path.read_text("utf-8")
    for word in ("P1", "upper lip", ">H<", ">mine<", ">1<", "post-operative skin, mm"):
        assert word in text, word
    assert pictures.MODEL_COLOURS["H"] in text
    pictures.chart_errors(tmp_path / "errors.png", {"P1": {"H": values}})
    image = pytest.importorskip("matplotlib.image").imread(tmp_path / "errors.png")
    colour = [int(pictures.MODEL_COLOURS["H"][k : k + 2], 16) / 255 for k in (1, 3, 5)]
    assert (np.abs(image[:, :, :3] - colour).max(axis=2) < 0.01).sum() > 1000


def test_what_cannot_be_drawn_is_named_and_leaves_nothing(ball, tmp_path, monkeypatch):
    count = len(ball.vertices)
    masked = np.ma.array(np.zeros(count), mask=True)
    for distances, pattern in [
        (np.zeros(3), r"shape \(3,\)"),
        (masked, "nothing to show"),
        (np.full(count, np.nan), r"distances\[0\] is nan"),
    ]:
        with pytest.raises(cmfsim.CaseError, match=pattern):
            pictures.picture_distances(tmp_path / "a.png", ball, distances)
    with pytest.raises(cmfsim.CaseError, match="limit is 0"):
        pictures.picture_distances(tmp_path / "a.png", ball, np.zeros(count), limit=0)
    for errors, pattern in [
        ({}, "no errors to draw"),
        ({"P1": {"H": []}}, "errors of P1, H have shape"),
        ({"P1": {"H": [1.0, np.inf]}}, r"errors of P1, H\[1\] is inf"),
    ]:
        with pytest.raises(cmfsim.CaseError, match=pattern):
            pictures.chart_errors(tmp_path / "a.svg", errors)
    with pytest.raises(cmfsim.CaseError, match=r"written as \.png, \.svg, \.pdf"):
        pictures.chart_errors(tmp_path / "a.gif", {"P1": {"H": [1.0]}})
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(cmfsim.CaseError, match=r"pip install '\.\[report\]'"):
        pictures.chart_errors(tmp_path / "a.svg", {"P1": {"H": [1.0]}})
    assert list(tmp_path.iterdir()) == []
