"""The segmentation of heads: a made one with known truth, and variants of a real CT."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

import cmfsim
from benches.scenes import ct_variants as variants
from cmfsim import ImageData, ImageError, SegmentOptions, segment_head
from cmfsim.imaging.intensities import intensity
from cmfsim.registration.proposed.shape_model import fitted_head
from phantom_reference import check_face, dice, distances, face, parted_as, surface_points
from phantom_reference import reference as reference_surfaces
from synthetic_head import made_head

pytest.importorskip("SimpleITK", reason="needs SimpleITK (pip install '.[imaging]')")
ndimage = pytest.importorskip("scipy.ndimage", reason="needs scipy")
measure = pytest.importorskip("skimage.measure", reason="needs scikit-image")

# For what does not depend on where the jaws part.
WHOLE = SegmentOptions(part_jaws=False)
DATA = Path(os.environ.get("CMFSIM_DATA", Path(__file__).parents[4] / "shared/data"))
PHANTOM = DATA / "ct_phantom"


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


def test_the_same_image_gives_the_same_bits(head, anatomy):
    again = segment_head(head.image, landmarks=head.landmarks)
    assert again.skin.values.tobytes() == anatomy.skin.values.tobytes()
    for name, level in anatomy.bones.items():
        assert again.bones[name].values.tobytes() == level.values.tobytes()


def test_one_bone_is_left_where_jaws_are_not_to_be_parted_and_stages_are_named_in_order(head):
    stages = []
    whole = segment_head(head.image, WHOLE, progress=stages.append)
    assert set(whole.bones) == {"skull"}
    assert stages == ["grid", "metal", "skin", "bone", "air"]


@pytest.mark.parametrize(
    ("slope", "offset", "dtype"),
    [(1.0, 1024.0, np.uint16), (1.0, 32768.0, np.uint16), (9.7, 9950.0, np.uint16)],
)
def test_other_scales_than_hu_are_recognised_and_said(head, anatomy, slope, offset, dtype):
    raw = np.clip(np.round(head.image.values * slope + offset), 0, 65535).astype(dtype)
    found = segment_head(head.image.with_values(raw), landmarks=head.landmarks)
    assert "ct-not-hu" in codes(found)
    assert dice(found.skin.values > 0, anatomy.skin.values > 0) > 0.99
    assert dice(found.bones["mandible"].values > 0, anatomy.bones["mandible"].values > 0) > 0.95


def test_values_from_nought_to_one_are_recognised(head, anatomy):
    scaled = ((head.image.values + 1024.0) / 4000.0).astype(np.float32)
    found = segment_head(head.image.with_values(scaled), WHOLE)
    assert "ct-not-hu" in codes(found)
    assert dice(found.skin.values > 0, anatomy.skin.values > 0) > 0.99


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


def test_a_flipped_head_is_an_error_finding(head):
    back = segment_head(head.image.with_values(head.image.values[:, ::-1].copy()), WHOLE)
    assert any(f.code == "ct-flipped" and f.severity == "error" for f in back.findings)
    turned = segment_head(head.image.with_values(head.image.values[:, :, ::-1].copy()), WHOLE)
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


def test_metal_is_found_where_the_image_is_cut_off_below_the_usual_threshold(head):
    found = segment_head(with_fillings(head, 2000.0), WHOLE)
    assert {"metal", "ct-saturated"} <= codes(found)
    (metal,) = [f for f in found.findings if f.code == "metal"]
    assert "2 pieces" in metal.what
    assert "above 1940 HU" in metal.what
    # What the case sets counts.
    options = SegmentOptions(metal_threshold=2400.0, part_jaws=False)
    set_higher = segment_head(with_fillings(head, 2000.0), options)
    assert not {"metal", "ct-saturated"} & codes(set_higher)


def test_an_image_cut_off_too_low_to_tell_metal_is_reported(head):
    found = segment_head(with_fillings(head, 1500.0), WHOLE)
    assert "metal" not in codes(found)
    (finding,) = [f for f in found.findings if f.code == "ct-saturated"]
    assert finding.severity == "warning"
    assert "metal_threshold" in finding.fix
    options = SegmentOptions(metal_threshold=1400.0, part_jaws=False)
    lower = segment_head(with_fillings(head, 1500.0), options)
    assert "metal" in codes(lower)


def test_one_bright_voxel_is_no_saturation(head):
    values = head.image.values.copy()
    values[40, 20, 20] = 2000
    found = segment_head(head.image.with_values(values), WHOLE).findings
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
    values = np.full((60, 60, 60), -1000, dtype=np.int16)
    values[(np.hypot(x, y) < 24.0) & (np.abs(z) < 40.0)] = 40
    values[(np.hypot(x, y) < 9.0) & (np.abs(z) < 40.0)] = 900
    with pytest.raises(ImageError, match=r"13\d cm³.*at least 250"):
        segment_head(ImageData(values, (2.0, 2.0, 2.0)))


def test_a_stated_scale_is_used_and_checked(head, anatomy):
    stored = head.image.with_values(head.image.values + np.int16(1024))
    found = segment_head(stored, SegmentOptions(rescale=(1.0, -1024.0)), landmarks=head.landmarks)
    assert "ct-not-hu" not in codes(found)
    np.testing.assert_array_equal(found.skin.values, anatomy.skin.values)
    with pytest.raises(ImageError, match="correct rescale"):
        segment_head(stored, SegmentOptions(rescale=(1.0, 0.0)))
    with pytest.raises(ValueError, match="slope"):
        SegmentOptions(rescale=(0.0, 0.0))


# The real CT -----------------------------------------------------------------------------------

needs_phantom = pytest.mark.skipif(
    not (PHANTOM / "ct.nii.gz").is_file(), reason=f"needs the head phantom's CT in {PHANTOM}"
)


@pytest.fixture(scope="session")
def phantom():
    return cmfsim.read_image(PHANTOM / "ct.nii.gz")


@pytest.fixture(scope="session")
def phantom_landmarks():
    document = json.loads((PHANTOM / "skull_landmarks.mrk.json").read_text())
    points = document["markups"][0]["controlPoints"]
    return {p["label"]: np.array(p["position"]) for p in points}


@pytest.fixture(scope="session")
def phantom_anatomy(phantom, phantom_landmarks):
    """Segmented as the reference was: bone's surface lies at 250 HU."""
    options = SegmentOptions(bone_threshold=250.0)
    return segment_head(phantom, options, landmarks=phantom_landmarks)


@pytest.fixture(scope="session")
def coarse_phantom(phantom):
    return variants.coarser(phantom, (2, 2, 1))


@pytest.fixture(scope="session")
def reference():
    return reference_surfaces()


@needs_phantom
def test_the_real_skin_is_that_of_the_reference(phantom_anatomy, reference):
    distance = distances(face(surface_points(phantom_anatomy.skin)), reference["skin"])
    assert np.median(distance) < 0.1
    assert np.percentile(distance, 95.0) < 0.5
    volume = np.count_nonzero(phantom_anatomy.skin.values > 0) * np.prod(
        phantom_anatomy.skin.spacing
    )
    assert volume == pytest.approx(4.197e6, rel=0.01)


@needs_phantom
def test_the_real_bone_is_that_of_the_reference(phantom_anatomy, reference):
    both = np.maximum(*(level.values for level in phantom_anatomy.bones.values()))
    level = phantom_anatomy.skin.with_values(both)
    distance = distances(face(surface_points(level)), reference["bone"])
    assert np.median(distance) < 0.15
    assert np.percentile(distance, 95.0) < 1.0


@needs_phantom
def test_the_real_jaws_are_parted(phantom_anatomy, reference):
    assert parted_as(phantom_anatomy, reference) > 0.98
    volume = np.count_nonzero(phantom_anatomy.bones["mandible"].values > 0) * np.prod(
        phantom_anatomy.skin.spacing
    )
    assert volume == pytest.approx(79.9e3, rel=0.05)


def _skin_of(image, landmarks, options=None):
    anatomy = segment_head(image, options, landmarks=landmarks)
    return anatomy, face(surface_points(anatomy.skin))


# Others are built from in pipeline/test_hard_heads.py, which looks at their faces as well.
VARIANTS = {
    "pillow": (
        lambda i: variants.with_pillow(variants.without_couch(i, -107.0)),
        {"rest-removed"},
        0.3,
        1.0,
        0.9,
    ),
    "holder": (
        lambda i: variants.with_holder(variants.without_couch(i, -107.0)),
        {"rest-removed"},
        0.3,
        1.0,
        0.9,
    ),
    "scaled": (
        lambda i: i.with_values(((i.values.astype(np.float64) + 1024) * 9.7 + 321).astype("u2")),
        {"ct-not-hu"},
        0.3,
        1.0,
        0.85,
    ),
    "slices of 4 mm": (
        lambda i: variants.coarser(i, (1, 1, 2)),
        {"ct-spacing-coarse"},
        0.3,
        2.0,
        0.85,
    ),
}


@needs_phantom
@pytest.mark.parametrize(
    "name",
    [
        name if name in {"pillow", "slices of 4 mm"} else pytest.param(name, marks=pytest.mark.slow)
        for name in VARIANTS
    ],
)
def test_a_hard_variant_of_the_real_ct_keeps_its_face(
    name, coarse_phantom, phantom_landmarks, reference
):
    make, expected, median, p95, parted = VARIANTS[name]
    anatomy = segment_head(make(coarse_phantom), landmarks=phantom_landmarks)
    assert expected <= codes(anatomy)
    assert not [f for f in anatomy.findings if f.severity == "error"]
    check_face(anatomy, reference, median, p95, parted)


@needs_phantom
def test_the_real_face_has_nothing_attached(phantom_anatomy):
    assert not {"skin-attachment", "ct-saturated", "metal"} & codes(phantom_anatomy)


@needs_phantom
def test_the_real_jaws_are_parted_without_landmarks(coarse_phantom, reference):
    anatomy = segment_head(coarse_phantom)
    assert "jaws-parted-by-shape" in codes(anatomy)
    assert parted_as(anatomy, reference) > 0.85


@needs_phantom
@pytest.mark.parametrize(
    ("axis", "code"), [pytest.param(1, "ct-flipped", marks=pytest.mark.slow), (2, "ct-flipped")]
)
def test_a_flipped_real_ct_is_found(coarse_phantom, axis, code):
    flipped = coarse_phantom.with_values(np.flip(coarse_phantom.values, axis))
    anatomy = segment_head(flipped, WHOLE)
    assert code in {f.code for f in anatomy.findings if f.severity == "error"}


@needs_phantom
def test_a_turned_header_gives_the_same_face(
    tmp_path, coarse_phantom, phantom_landmarks, reference
):
    sitk = pytest.importorskip("SimpleITK")

    image = sitk.GetImageFromArray(np.ascontiguousarray(coarse_phantom.values.T))
    image.SetSpacing(coarse_phantom.spacing.tolist())
    image.SetOrigin(coarse_phantom.origin.tolist())
    # Voxels resampled on a tilted grid, as a gantry or another orientation gives them.
    c, s = np.cos(np.radians(10.0)), np.sin(np.radians(10.0))
    grid = sitk.Image(image.GetSize(), image.GetPixelID())
    grid.SetSpacing(image.GetSpacing())
    grid.SetDirection([1, 0, 0, 0, c, -s, 0, s, c])
    middle = np.array(coarse_phantom.lowest + coarse_phantom.highest) / 2.0
    half = np.array(image.GetSize()) * np.array(image.GetSpacing()) / 2.0
    grid.SetOrigin((middle - np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ half).tolist())
    sitk.WriteImage(sitk.Resample(image, grid, defaultPixelValue=-1024), str(tmp_path / "t.nrrd"))
    _, points = _skin_of(cmfsim.read_image(tmp_path / "t.nrrd"), phantom_landmarks)
    distance = distances(points[points[:, 2] > 340.0], reference["skin"])
    # Voxels of 2 mm, interpolated twice.
    assert np.median(distance) < 0.6
    assert np.percentile(distance, 95.0) < 1.5
