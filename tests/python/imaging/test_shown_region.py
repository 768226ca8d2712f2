"""What an image shows is told from the padding around it, however it is turned."""

import dataclasses

import numpy as np
import pytest

from cmfsim.imaging.bones.bone import Bone
from cmfsim.imaging.head import _beyond
from cmfsim.imaging.intensities.intensity import calibration
from cmfsim.imaging.morphology import padding, shown_region
from cmfsim.imaging.skins.skin import Skin
from cmfsim.imaging.working_grid import Working
from cmfsim.values.motion import rigid_motion
from synthetic_head import made_head

pytest.importorskip("SimpleITK", reason="needs SimpleITK (pip install '.[imaging]')")
pytest.importorskip("scipy.ndimage", reason="needs scipy")

SHAPE = (90, 100, 80)
HALF = (30.0, 32.0, 24.0)
MIDDLE = (np.array(SHAPE) - 1.0) / 2.0
PLACES = np.stack(np.meshgrid(*map(np.arange, SHAPE), indexing="ij"), axis=-1) - MIDDLE


def noisy(seed=0):
    """Noise about air with a head of muscle and a nose."""
    values = np.random.default_rng(seed).normal(-1000.0, 15.0, SHAPE)
    x, y, z = np.moveaxis(PLACES, -1, 0)
    head = (x / 28.0) ** 2 + (y / 34.0) ** 2 + (z / 50.0) ** 2 < 1.0
    head |= (np.abs(x) < 5.0) & (np.abs(y + 34.0) < 8.0) & (np.abs(z) < 6.0)
    return np.where(head, 40.0 + 0.5 * values + 500.0, values), head


def turned(axis, angle):
    return rigid_motion(angle=angle, axis=axis, centre=(0, 0, 0))[:3, :3]


def box(turn, half=HALF):
    own = PLACES @ turn
    return (np.abs(own) < half).all(axis=-1), own


@pytest.mark.parametrize("fill", [-3024.0, -1024.0, 0.0])
@pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), (12.0, 0.0, 0.0), (-15.0, 8.0, 20.0)])
def test_a_turned_or_widened_box_is_found_to_a_voxel(angles, fill):
    turn = np.eye(3)
    for axis, angle in zip(np.eye(3), angles, strict=True):
        turn = turn @ turned(axis, angle)
    within, own = box(turn)
    values = np.where(within, noisy()[0], fill)
    region = shown_region(values)
    depth = region.depth(PLACES.reshape(-1, 3) + MIDDLE).reshape(SHAPE)
    true = (np.array(HALF) - np.abs(own)).min(axis=-1)
    np.testing.assert_allclose(depth[true > 0.0], true[true > 0.0], atol=1.6)
    np.testing.assert_array_equal(padding(values, region), ~within)


def test_a_round_field_is_found_also_where_the_borders_of_the_image_cut_it():
    x, y, _ = np.moveaxis(PLACES, -1, 0)
    away = np.hypot(x, y)
    for radius in (42.0, 48.0):
        region = shown_region(np.where(away < radius, noisy()[0], -2000.0))
        depth = region.depth(PLACES.reshape(-1, 3) + MIDDLE).reshape(SHAPE)
        beside = (np.abs(x) < 30.0) & (np.abs(y) < 40.0) & (np.abs(PLACES[..., 2]) < 30.0)
        beside &= radius - away < 8.0
        np.testing.assert_allclose(depth[beside], (radius - away)[beside], atol=1.2)


def test_a_head_in_even_air_is_no_region():
    values, head = noisy()
    assert shown_region(np.where(head, values, -1024.0)) is None
    assert shown_region(values) is None
    assert shown_region(np.full(SHAPE, 7)) is None


def test_padding_of_the_value_of_water_does_not_count_as_tissue():
    values = made_head(3.5).image.values.astype(np.float64)
    values += 15.0 * np.random.default_rng(0).standard_normal(values.shape)
    widened = np.pad(values, 20)
    assert calibration(widened).offset == pytest.approx(calibration(values).offset, abs=1.0)


@pytest.mark.parametrize("nod", [0.0, -20.0])
def test_a_jaw_that_padding_cuts_off_is_reported(nod):
    _, head = noisy()
    turn = turned((1, 0, 0), nod)
    within, _ = box(turn, (34.0, 44.0, 24.0))
    region = shown_region(np.where(within, noisy()[0], -1024.0))
    border = np.zeros((2, 3), dtype=bool)
    work = Working(np.zeros(SHAPE, np.float32), np.ones(3), np.zeros(3), border, np.ones(3))
    skin = Skin.__new__(Skin)
    object.__setattr__(skin, "mask", head & within)
    bone = Bone.__new__(Bone)
    jaw = head & within & (PLACES[..., 1] < -15.0) & (PLACES[..., 2] < 0.0)
    object.__setattr__(bone, "solid", jaw)
    assert _beyond(work, skin, bone) == []
    found = _beyond(dataclasses.replace(work, shown=region), skin, bone)
    assert [finding.code for finding in found] == ["ct-cut-off"]
    assert "chin cut off" in found[0].what
