"""The lateral view: its absorption, its section and its projection against those of spheres."""

import warnings

import numpy as np
import pytest

import cmfsim
from benches.scenes import meshes
from cmfsim.pictures import lateral
from cmfsim.pictures.lateral import (
    BONE,
    PIXEL,
    LateralView,
    _planes,
    _section,
    _shells,
    picture_lateral,
)

pytest.importorskip("matplotlib")
# Of a head in LPS: forwards, up and left, as rows.
AXES = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])


def ball(radius, centre=(0.0, 0.0, 0.0)):
    vertices, triangles = meshes.icosphere(4, radius)
    return cmfsim.SurfaceData(vertices + np.asarray(centre), triangles)


def test_a_shell_absorbs_by_its_area_in_front_of_each_pixel():
    # A sphere of radius r has 2 r / sqrt(r² - d²) of its area in front of a place at distance d.
    found = _shells(ball(30.0), AXES, np.array([[-36.0, 36.0], [-36.0, 36.0]]))
    # Nothing is lost: the area of the sphere.
    assert found.sum() * PIXEL**2 == pytest.approx(4.0 * np.pi * 30.0**2, rel=3e-3)
    # Single pixels hold a whole number of points: means of five by five of them.
    found = found.reshape(24, 5, 24, 5).mean(axis=(1, 3))
    places = 5.0 * PIXEL * (np.arange(24) + 0.5) - 36.0
    distance = np.hypot(*np.meshgrid(places, places))
    inner = distance < 24.0
    exact = 2.0 * 30.0 / np.sqrt(30.0**2 - distance[inner] ** 2)
    assert np.abs(found[inner] / exact - 1.0).max() < 0.06
    assert not found[distance > 33.0].any()


@pytest.mark.parametrize(("forwards", "made"), [(1.0, 2), (-1.0, 4)])
def test_absorption_is_summed_once_for_what_both_views_show_alike(
    forwards, made, monkeypatch, tmp_path
):
    calls = []
    monkeypatch.setattr(lateral, "_shells", lambda *given: calls.append(given) or _shells(*given))
    sites = {"N": np.array([40.0, 40.0]), "Me": np.array([40.0, -40.0])}
    head = {"cranium": ball(8.0)}, ball(40.0), sites
    before = LateralView(*head, AXES, 0.0)
    planned = LateralView(*head, AXES * [[forwards], [1.0], [forwards]], 0.0)
    picture_lateral(tmp_path / "lateral.png", before=before, planned=planned)
    assert len(calls) == made


def test_the_section_lies_on_the_circle_in_the_midsagittal_plane():
    cut = _section(ball(30.0, (4.0, -10.0, 5.0)), AXES, 10.0)
    radius = np.linalg.norm(cut - [10.0, 5.0], axis=2)
    # The plane passes 6 mm to the left of the centre.
    assert np.abs(radius - np.sqrt(30.0**2 - 6.0**2)).max() < 0.1
    length = np.linalg.norm(cut[:, 1] - cut[:, 0], axis=1).sum()
    assert length == pytest.approx(2.0 * np.pi * np.sqrt(864.0), rel=1e-3)


def test_planes_are_drawn_only_where_their_sites_are_known():
    sites = {"N": np.array([90.0, 30.0]), "Or": np.array([80.0, 0.0])}
    assert list(_planes(sites)) == ["FH, estimated"]
    sites |= {"Po": np.array([0.0, 4.0]), "S": np.array([20.0, 35.0])}
    assert list(_planes(sites)) == ["SN", "FH"]
    assert np.array_equal(_planes(sites)["FH"], [[0.0, 4.0], [80.0, 0.0]])


def test_a_segment_is_drawn_where_the_plan_moves_it(tmp_path):
    image = pytest.importorskip("matplotlib.image")
    sites = {"N": np.array([40.0, 40.0]), "Me": np.array([40.0, -40.0])}
    before = LateralView({"cranium": ball(8.0)}, ball(40.0), sites, AXES, 0.0)
    planned = LateralView({"cranium": ball(8.0, (0.0, -20.0, 0.0))}, ball(40.0), sites, AXES, 0.0)
    picture_lateral(tmp_path / "lateral.png", before=before, planned=planned)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        pixels = image.imread(tmp_path / "lateral.png")[:, :, :3]
    ratio = np.exp(-2.0 * BONE)
    red = (pixels[:, :, 0] > 0.6) & (pixels[:, :, 1] < 0.3)
    blue = (pixels[:, :, 2] > 0.4) & (pixels[:, :, 0] < 0.3)
    half = pixels.shape[1] // 2
    assert not red[:, :half].any()
    assert blue[:, :half].any()
    # The tracing before is under that of the plan.
    assert red[:, half:].any()
    assert blue[:, half:].any()
    middle = pixels[:, :half].mean(axis=2)
    assert (np.abs(middle - ratio * np.exp(-0.1)) < 0.06).any()
