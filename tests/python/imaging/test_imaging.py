"""The segmentation of a synthetic head with known truth."""

import numpy as np
import pytest

from benches.scenes import ct_variants as variants
from cmfsim import ImageData, ImageError, SegmentOptions, segment_head
from cmfsim.imaging.intensities import intensity
from cmfsim.registration.proposed.shape_model import fitted_head
from phantom_reference import dice, surface_points
from synthetic_head import made_head

pytest.importorskip("SimpleITK", reason="needs SimpleITK (pip install '.[imaging]')")
ndimage = pytest.importorskip("scipy.ndimage", reason="needs scipy")
measure = pytest.importorskip("skimage.measure", reason="needs scikit-image")

# For what does not depend on where the jaws part.
WHOLE = SegmentOptions(part_jaws=False)


def on_truth(level, head, mask):
    """The level's inside and the truth, on the level's grid."""
    steps = np.round((level.lowest - head.image.lowest) / np.asarray(level.spacing)).astype(int)
    part = tuple(slice(a, a + n) for a, n in zip(steps, level.values.shape, strict=True))
    return level.values > 0.0, mask[part]


def codes(anatomy):
    return {f.code for f in anatomy.findings}


@pytest.fixture(scope="session")
def head():
    return made_head()


@pytest.fixture(scope="session")
def anatomy(head):
    return segment_head(head.image, landmarks=head.landmarks)


@pytest.fixture(scope="session")
def coarse():
    """The head in voxels of 4 mm, for what does not depend on their size."""
    return made_head(4.0)


@pytest.fixture(scope="session")
def coarse_anatomy(coarse):
    return segment_head(coarse.image, landmarks=coarse.landmarks)


def test_the_made_head_is_found_within_its_voxels(head, anatomy):
    inside, truth = on_truth(anatomy.skin, head, head.skin)
    assert dice(inside, truth) > 0.99
    found, truth = on_truth(anatomy.bones["mandible"], head, head.mandible)
    assert dice(found, truth) > 0.9


def test_the_made_head_has_nothing_on_its_skin(anatomy):
    # Its neck is cut off right below the fold under the jaw: no rim is seen there.
    assert "skin-attachment" not in codes(anatomy)


def test_the_couch_is_removed_and_said(anatomy):
    assert "rest-removed" in codes(anatomy)
    assert anatomy.skin.values[:, (anatomy.skin.axes()[1] > 112.0).ravel()].max() <= 0.0


def test_the_brain_is_inside_the_cranium(head, anatomy):
    found, brain = on_truth(anatomy.bones["cranium"], head, head.brain)
    assert np.count_nonzero(found & brain) > 0.995 * np.count_nonzero(brain)


def test_the_airway_is_air_inside_the_skin(head, anatomy):
    found, tube = on_truth(anatomy.air, head, head.airway)
    inside, _ = on_truth(anatomy.skin, head, head.skin)
    bone, _ = on_truth(anatomy.bones["cranium"], head, head.skin)
    # Bone encloses the way past the palate; the nostril's first millimetres lie outside.
    deep = tube & ~bone & (anatomy.air.axes()[1] > -95.0)
    assert dice(found, deep) > 0.8
    assert inside[found].all()


def test_no_voxel_is_both_bone_and_outside_or_two_bones(anatomy):
    cranium, mandible = (anatomy.bones[n].values > 0.0 for n in ("cranium", "mandible"))
    assert not (cranium & mandible).any()
    assert (anatomy.skin.values[cranium | mandible] > 0.0).all()
    assert np.isfinite(anatomy.skin.values).all()
    assert max(np.abs(level.values).max() for level in anatomy.bones.values()) <= 1.0


def test_no_level_comes_near_zero_away_from_its_surface(anatomy):
    cube = np.ones((3, 3, 3))
    levels = {"skin": anatomy.skin, "cranium": anatomy.bones["cranium"], "air": anatomy.air}
    for level in levels.values():
        inside = level.values > 0.0
        deep = ndimage.binary_erosion(inside, cube, iterations=2)
        far = ndimage.binary_erosion(~inside, cube, iterations=2)
        assert deep.any()
        small = np.abs(level.values[deep | far]) < 0.3
        # A smoothed rim may stand a voxel out from its mask, as in slits one voxel wide between
        # roots.
        assert np.count_nonzero(small) < 2e-5 * small.size


def test_the_jaws_are_parted_without_landmarks_and_it_is_said(head, monkeypatch):
    # Ellipsoids are little like a head: it would be compared with heads that lie otherwise.
    monkeypatch.setattr(fitted_head, "SURE_FIT", fitted_head.LEAST_FIT)
    guessed = segment_head(head.image)
    assert "jaws-parted-by-shape" in codes(guessed)
    found, truth = on_truth(guessed.bones["mandible"], head, head.mandible)
    assert dice(found, truth) > 0.85


def test_the_same_image_gives_the_same_bits(coarse, coarse_anatomy):
    again = segment_head(coarse.image, landmarks=coarse.landmarks)
    assert again.skin.values.tobytes() == coarse_anatomy.skin.values.tobytes()
    for name, level in coarse_anatomy.bones.items():
        assert again.bones[name].values.tobytes() == level.values.tobytes()


def test_one_bone_is_left_where_jaws_are_not_to_be_parted_and_stages_are_named_in_order(coarse):
    stages = []
    whole = segment_head(coarse.image, WHOLE, progress=stages.append)
    assert set(whole.bones) == {"skull"}
    assert stages == ["grid", "metal", "skin", "bone", "air"]


@pytest.mark.parametrize(
    ("slope", "offset", "dtype"),
    [(1.0, 1024.0, np.uint16), (1.0, 32768.0, np.uint16), (9.7, 9950.0, np.uint16)],
)
def test_other_scales_than_hu_are_recognised_and_said(coarse, coarse_anatomy, slope, offset, dtype):
    raw = np.clip(np.round(coarse.image.values * slope + offset), 0, 65535).astype(dtype)
    found = segment_head(coarse.image.with_values(raw), landmarks=coarse.landmarks)
    assert "ct-not-hu" in codes(found)
    assert dice(found.skin.values > 0, coarse_anatomy.skin.values > 0) > 0.99
    assert (
        dice(found.bones["mandible"].values > 0, coarse_anatomy.bones["mandible"].values > 0) > 0.95
    )


def test_values_from_nought_to_one_are_recognised(coarse, coarse_anatomy):
    scaled = ((coarse.image.values + 1024.0) / 4000.0).astype(np.float32)
    found = segment_head(coarse.image.with_values(scaled), WHOLE)
    assert "ct-not-hu" in codes(found)
    assert dice(found.skin.values > 0, coarse_anatomy.skin.values > 0) > 0.99


def test_a_head_of_plastic_is_no_mr_image(head):
    """Layers of water and of 100 to 700 HU for its soft tissue: as a skull phantom has them."""
    hu = head.image.values.astype(float)
    z = np.linspace(0.0, 1.0, hu.shape[2])
    layers = np.where(z < 0.35, 20.0, 100.0 + 600.0 * z)
    plastic = np.where((hu > -300) & (hu < 250), layers, hu)
    found = intensity.calibration(plastic.astype(np.int16))
    assert (found.slope, found.has_air) == (1.0, True)
    assert "ct-unusual" in {finding.code for finding in found.findings}
    with pytest.raises(ImageError, match="An MR image cannot be used"):
        intensity.calibration(np.clip(1.7 * (plastic + 1000.0), 0.0, None).astype(np.int16))


def test_the_noise_of_a_cone_beam_scanner_does_not_hide_the_scale(head):
    """0.6 × (HU + 1000), with noise of 150 HU that reconstruction has sharpened."""
    noise = np.random.default_rng(3).standard_normal(head.image.values.shape)
    noise -= ndimage.gaussian_filter(noise, 2.0)
    hu = head.image.values + 150.0 / noise.std() * noise
    scale = intensity.calibration((0.6 * (hu + 1000.0)).astype(np.float32))
    assert scale.slope == pytest.approx(1.0 / 0.6, rel=0.03)
    assert scale.offset == pytest.approx(-1000.0, abs=30.0)
    assert [finding.code for finding in scale.findings] == ["ct-not-hu"]


def test_an_image_without_bright_bone_is_no_ct(head):
    """Bone as dark as air, as in MR, whose other tissue is alike throughout."""
    dark = np.where(head.image.values > 250.0, -1000.0, head.image.values)
    with pytest.raises(ImageError, match=r"0\.0 % as bright as bone \(1 to"):
        intensity.calibration(0.5 * (dark + 1000.0))


def test_a_ct_in_hu_is_left_alone(anatomy):
    assert "ct-not-hu" not in codes(anatomy)


def test_coarse_voxels_are_reported(anatomy, coarse_anatomy):
    assert "ct-spacing-coarse" not in codes(anatomy)
    assert "ct-spacing-coarse" in codes(coarse_anatomy)


def test_an_mr_image_is_refused(head):
    rng = np.random.default_rng(0)
    hu = head.image.values
    # T1: fat and brain bright and uneven, bone and air dark, Rician background.
    tissue = np.where((hu > -300) & (hu < 300), rng.uniform(200.0, 900.0, hu.shape), 0.0)
    mr = np.hypot(tissue + rng.normal(0, 15, hu.shape), rng.normal(0, 15, hu.shape))
    with pytest.raises(ImageError) as caught:
        segment_head(head.image.with_values(mr.astype(np.int16)))
    assert isinstance(caught.value, ValueError)
    # The same may befall a CT: what to do then.
    assert "rescale = [1, 0] in [image]" in str(caught.value)
    stated = intensity.calibration(head.image.values, (1.0, 0.0))
    assert (stated.slope, stated.offset, stated.findings) == (1.0, 0.0, ())


@pytest.mark.parametrize(
    ("values", "text"),
    [
        (np.zeros((60, 60, 60)), "0 nearly throughout"),
        (np.full((60, 60, 60), -1000), "nearly throughout"),
        (np.zeros((60, 60, 1)), "at least 8 voxels"),
    ],
)
def test_images_without_a_head_are_refused(values, text):
    with pytest.raises(ImageError, match=text):
        segment_head(ImageData(values, (2.0, 2.0, 2.0)))


def test_voxels_that_are_not_finite_are_refused(head):
    values = head.image.values.astype(np.float32)
    values[3, 4, 5] = np.inf
    with pytest.raises(ImageError, match=r"image\[3, 4, 5\] is inf"):
        segment_head(head.image.with_values(values))


def test_metres_are_refused(head):
    with pytest.raises(ImageError, match="mm"):
        segment_head(ImageData(head.image.values, np.full(3, 0.002)))


def test_thresholds_must_ascend():
    with pytest.raises(ImageError, match="must increase"):
        SegmentOptions(skin_threshold=300.0)
    with pytest.raises(ValueError, match="closing"):
        SegmentOptions(closing=0.0)


def test_a_flipped_head_is_an_error_finding(coarse):
    back = segment_head(coarse.image.with_values(coarse.image.values[:, ::-1].copy()), WHOLE)
    assert any(f.code == "ct-flipped" and f.severity == "error" for f in back.findings)
    turned = segment_head(coarse.image.with_values(coarse.image.values[:, :, ::-1].copy()), WHOLE)
    assert any(f.code == "ct-flipped" and f.severity == "error" for f in turned.findings)


def test_metal_spikes_do_not_leave_the_skin(head):
    x, y, z = head.image.axes()
    values = head.image.values.astype(np.float64)
    layer = np.abs(z + 60.0) < 5.0
    for side in (-1.0, 1.0):
        distance = np.sqrt((x - side * 28.0) ** 2 + (y + 40.0) ** 2)
        angle = np.arctan2(y + 40.0, x - side * 28.0)
        rays = np.where(np.cos(14.0 * angle) > 0.9, 1.0, np.where(np.cos(14 * angle) < -0.9, -1, 0))
        values += 1400.0 * rays * np.exp(-distance / 40.0) * layer
        values[np.broadcast_to((distance < 5.0) & layer, values.shape)] = 3071.0
    hard = head.image.with_values(np.clip(values, -1024, 3071).astype(np.int16))
    found = segment_head(hard, landmarks=head.landmarks)
    assert "metal" in codes(found)
    inside, truth = on_truth(found.skin, head, head.skin)
    assert dice(inside, truth) > 0.985
    spikes = surface_points(found.bones["mandible"])
    assert np.abs(spikes[:, 0]).max() < 45.0
    assert spikes[:, 1].min() > -93.0


def with_fillings(head, hu):
    """Two fillings of a value in the tooth rows."""
    x, y, z = head.image.axes()
    values = head.image.values.astype(np.float64)
    for side in (-1.0, 1.0):
        ball = np.sqrt((x - side * 28.0) ** 2 + (y + 40.0) ** 2 + (z + 60.0) ** 2) < 5.0
        values[ball] = hu
    return head.image.with_values(values.astype(np.int16))


def test_metal_is_found_where_the_image_is_cut_off_below_the_usual_threshold(coarse):
    found = segment_head(with_fillings(coarse, 2000.0), WHOLE)
    assert {"metal", "ct-saturated"} <= codes(found)
    (metal,) = [f for f in found.findings if f.code == "metal"]
    assert "2 pieces" in metal.what
    assert "above 1940 HU" in metal.what
    # What the case sets counts.
    options = SegmentOptions(metal_threshold=2400.0, part_jaws=False)
    set_higher = segment_head(with_fillings(coarse, 2000.0), options)
    assert not {"metal", "ct-saturated"} & codes(set_higher)


def test_an_image_cut_off_too_low_to_tell_metal_is_reported(coarse):
    found = segment_head(with_fillings(coarse, 1500.0), WHOLE)
    assert "metal" not in codes(found)
    (finding,) = [f for f in found.findings if f.code == "ct-saturated"]
    assert finding.severity == "warning"
    assert "metal_threshold" in finding.fix
    options = SegmentOptions(metal_threshold=1400.0, part_jaws=False)
    lower = segment_head(with_fillings(coarse, 1500.0), options)
    assert "metal" in codes(lower)


def test_one_bright_voxel_is_no_saturation(coarse):
    values = coarse.image.values.copy()
    values[40, 20, 20] = 2000
    found = segment_head(coarse.image.with_values(values), WHOLE).findings
    assert "ct-saturated" not in {f.code for f in found if f.severity == "warning"}


@pytest.mark.parametrize(("hu", "kind"), [(250.0, "plastic"), (60.0, "other side")])
def test_a_tube_on_the_cheek_is_reported_and_not_removed(head, anatomy, hu, kind):
    level = anatomy.skin
    x, _, z = (a.ravel() for a in level.axes())
    column = int(np.argmin(np.abs(x - 40.0)))
    rows = [k for k in range(len(z)) if -75.0 < z[k] < -20.0]
    first = [int(np.argmax(level.values[column, :, k] > 0.0)) for k in rows]
    middle = [level.lowest + [0, np.asarray(level.spacing)[1] * j - 4.0, 0] for j in first]
    path = np.array([[x[column], m[1], z[k]] for m, k in zip(middle, rows, strict=True)])
    found = segment_head(variants.with_tube(head.image, path, hu), WHOLE)
    (finding,) = [f for f in found.findings if f.code == "skin-attachment"]
    assert kind in finding.what
    assert finding.severity == "warning"
    place = [float(n) for n in finding.where.split("(")[1].split(")")[0].split(",")]
    assert np.linalg.norm(np.array(place) - path.mean(axis=0)) < 15.0
    # It is still skin.
    assert found.skin.sample([path[len(path) // 2] - [0, 3.0, 0]])[0] > 0.0
    assert "skin-attachment" not in codes(anatomy)


def test_a_part_that_is_too_small_for_a_head_is_refused():
    x, y, z = np.ogrid[-60:60:2.0, -60:60:2.0, -60:60:2.0]
    values = np.random.default_rng(0).normal(-1000.0, 15.0, (60, 60, 60)).astype(np.int16)
    values[(np.hypot(x, y) < 24.0) & (np.abs(z) < 40.0)] = 40
    values[(np.hypot(x, y) < 9.0) & (np.abs(z) < 40.0)] = 900
    with pytest.raises(ImageError, match=r"13\d cm³.*at least 250"):
        segment_head(ImageData(values, (2.0, 2.0, 2.0)))


def test_a_stated_scale_is_used_and_checked(coarse, coarse_anatomy):
    stored = coarse.image.with_values(coarse.image.values + np.int16(1024))
    found = segment_head(stored, SegmentOptions(rescale=(1.0, -1024.0)), landmarks=coarse.landmarks)
    assert "ct-not-hu" not in codes(found)
    np.testing.assert_array_equal(found.skin.values, coarse_anatomy.skin.values)
    with pytest.raises(ImageError, match="correct rescale"):
        segment_head(stored, SegmentOptions(rescale=(1.0, 0.0)))
    with pytest.raises(ValueError, match="slope"):
        SegmentOptions(rescale=(0.0, 0.0))
