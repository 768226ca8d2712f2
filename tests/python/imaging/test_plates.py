"""Flat things on the face: pads are found by the step all round them, faces have no such step."""

import os
from pathlib import Path

import numpy as np
import pytest

import cmfsim
from benches.scenes import ct_variants as variants
from synthetic_head import made_head

pytest.importorskip("SimpleITK", reason="needs SimpleITK (pip install '.[imaging]')")
pytest.importorskip("scipy.ndimage", reason="needs scipy")

from cmfsim.imaging.skins.plates import STEP, find_plates

DATA = Path(os.environ.get("CMFSIM_DATA", Path(__file__).parents[4] / "shared" / "data"))
# A face of two ellipsoids: middles and half axes, mm; y points backwards.
BALLS = (((0.0, 0.0, 40.0), (75.0, 95.0, 80.0)), ((0.0, -45.0, -40.0), (58.0, 50.0, 65.0)))
# Where pads lie: in which direction from the middle of one of the two.
PLACES = {
    "cheek": (1, (0.9, -0.4, 0.1)),
    "forehead": (0, (0.0, -1.0, 0.25)),
    "side of the forehead": (0, (0.5, -0.9, 0.3)),
    "chin": (1, (0.0, -0.9, -0.3)),
    "under the jaw": (1, (0.2, -0.3, -1.0)),
}


@pytest.fixture(scope="module")
def face():
    """Points of a grid, how deep each lies in the face, and the level of the face there."""
    axes = [np.arange(a, b, STEP) for a, b in ((-85, 85), (-110, 30), (-120, 130))]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    depth = _depth(points)
    return points, depth, level_of(depth)


def _depth(points):
    """How deep points lie in the larger of two ellipsoids, to first order, mm."""
    depths = []
    for middle, half in BALLS:
        away = np.linalg.norm((points - middle) / half, axis=-1)
        slope = np.linalg.norm((points - middle) / np.square(half), axis=-1)
        depths.append(away * (1.0 - away) / np.maximum(slope, 1e-9))
    return np.maximum(*depths)


def level_of(depth):
    """What a scan shows of it: air, skin, and 3 mm of both between."""
    return np.asfortranarray(np.clip(depth / 1.5, -1.0, 1.0).astype(np.float32))


def with_pad(face, place, width, thickness):
    """The level with a square pad of a width and a thickness, and the pad's middle."""
    points, signed, level = face
    # Elsewhere the pad lies outside, or in what is face without it.
    near = (signed > -thickness - 2.0) & (signed < 2.0)
    ball, towards = PLACES[place]
    towards = np.array(towards) / np.linalg.norm(towards)
    middle = np.array(BALLS[ball][0])
    away, depth = points[near] - middle, signed[near]
    along = away @ towards
    across = away - along[:, None] * towards
    side = np.cross(towards, [0.0, 0.0, 1.0] if abs(towards[2]) < 0.8 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    up = np.cross(side, towards)
    wide = np.maximum(np.abs(across @ side), np.abs(across @ up))
    pad = np.minimum(thickness + depth, 0.5 * width - wide)
    pad[along < 0.0] = -10.0
    padded = level.copy(order="K")
    padded[near] = level_of(np.maximum(depth, pad))
    top = np.argwhere(near)[(pad > 0.0) & (depth < 0.0)]
    return padded, top.mean(axis=0)


def found_on(level):
    rows = np.flatnonzero((level > 0.0).any(axis=(0, 2)))
    return find_plates(level, np.full(3, STEP), int(rows[0] + 0.6 * len(rows)))


def test_a_smooth_face_has_no_plates(face):
    assert found_on(face[2]) == []


# The others, in between, take as long again.
OFTEN = {(22.0, 3.0), (40.0, 5.0), (60.0, 8.0)}
SIZES = [
    (w, t) if (w, t) in OFTEN else pytest.param(w, t, marks=pytest.mark.slow)
    for w in (22.0, 30.0, 40.0, 60.0)
    for t in (3.0, 5.0, 8.0)
]


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize(("width", "thickness"), SIZES)
def test_pads_are_found_where_they_lie(face, place, width, thickness):
    level, middle = with_pad(face, place, width, thickness)
    (found,) = found_on(level)
    assert np.linalg.norm((found.mean(axis=0) - middle) * STEP) < 8.0
    assert np.ptp(found, axis=0).max() * STEP > 0.7 * width - 6.0


def test_a_swelling_without_a_step_is_none(face):
    """10 mm of a smooth swelling on one cheek."""
    points, signed, _ = face
    away = np.linalg.norm(points - [48.0, -60.0, -35.0], axis=-1)
    swollen = signed + 10.0 * np.exp(-0.5 * (away / 18.0) ** 2)
    assert found_on(level_of(swollen)) == []


def test_a_pit_is_none(face):
    """A hole of 24 mm and 6 mm deep: its rim looks inwards."""
    points, signed, _ = face
    away = np.linalg.norm((points - [48.0, -60.0, -35.0]), axis=-1)
    hole = np.minimum(12.0 - away, 6.0 - signed)
    assert found_on(level_of(np.minimum(signed, -hole))) == []


def test_a_fold_between_jaw_and_neck_is_none():
    """Skin between it and the end of the image: its border faces outwards, but is not convex."""
    assert attachments(made_head(2.0).image) == []


@pytest.mark.parametrize("hu", [-100.0, 40.0, 250.0])
def test_a_pad_on_a_scan_is_reported_whatever_its_density(hu):
    image = variants.with_pad(made_head(2.0).image, (45.0, -70.0, -45.0), 40.0, 5.0, hu)
    (finding,) = attachments(image)
    place = [float(n) for n in finding.where.split("(")[1].split(")")[0].split(",")]
    assert np.linalg.norm(np.array(place) - [45.0, -70.0, -45.0]) < 20.0


@pytest.fixture(scope="module")
def real_scan():
    path = DATA / "ct_phantom" / "ct.nii.gz"
    if not path.is_file():
        pytest.skip(f"{path} is absent: set CMFSIM_DATA to the folder of real data")
    return cmfsim.read_image(path)


def attachments(image):
    """What is reported on the skin of a scan whose jaws are left together."""
    found = cmfsim.segment_head(image, cmfsim.SegmentOptions(part_jaws=False))
    return [f for f in found.findings if f.code == "skin-attachment"]


def test_nothing_is_reported_on_a_real_scan(real_scan):
    assert attachments(real_scan) == []


@pytest.mark.slow
def test_nothing_is_reported_at_the_size_of_a_child(real_scan):
    spacing = 0.75 * np.asarray(real_scan.spacing)
    assert attachments(cmfsim.ImageData(real_scan.values, spacing, real_scan.origin)) == []


@pytest.mark.parametrize(
    ("place", "width", "thickness"),
    [
        pytest.param((60.0, -272.0, 372.0), 40.0, 5.0, marks=pytest.mark.slow),
        # Rims that meet the fold below the lip or the one between jaw and neck.
        ((0.0, -304.0, 340.0), 40.0, 3.0),
        pytest.param((0.0, -304.0, 340.0), 60.0, 5.0, marks=pytest.mark.slow),
        pytest.param((0.0, -260.0, 318.0), 20.0, 8.0, marks=pytest.mark.slow),
        pytest.param((0.0, -260.0, 318.0), 60.0, 5.0, marks=pytest.mark.slow),
    ],
)
def test_a_pad_on_a_real_scan_is_reported(real_scan, place, width, thickness):
    """What was silent: soft tissue on cheek, chin and neck (docs/real_scans.md)."""
    (finding,) = attachments(variants.with_pad(real_scan, place, width, thickness))
    assert "flat" in finding.what
