"""Things on the face: the windpipe under thin skin is none, hollow things are."""

import numpy as np
import pytest
from scipy import ndimage

import cmfsim
from synthetic_head import AIR, SOFT, made_head

pytest.importorskip("SimpleITK", reason="needs SimpleITK (pip install '.[imaging]')")
pytest.importorskip("scipy.ndimage", reason="needs scipy")

# How far the neck goes on below the synthetic head, mm.
NECK = 60.0


@pytest.fixture(scope="module")
def head():
    return made_head()


@pytest.fixture(scope="module")
def long_neck(head):
    """The head with a longer neck, in which a wide windpipe comes under the skin: 4 mm of it."""
    image = head.image
    step = float(image.spacing[2])
    count = round(NECK / step)
    values = np.asarray(image.values, dtype=np.float32)
    neck = np.repeat(values[:, :, :1], count, axis=2)
    origin = np.array(image.origin) - [0.0, 0.0, count * step]
    x, y, _ = image.axes()
    z = (origin[2] + step * np.arange(count))[None, None, :]
    # The neck's front is at y = -22. What is closed off by a narrow place counts as head, so that
    # lips and teeth are wide apart and the throat is 31 mm wide.
    forwards = np.minimum((image.origin[2] - z) / 15.0, 1.0)
    neck[np.broadcast_to(np.hypot(x, y - 2.0) < 12.0, neck.shape)] = SOFT
    neck[np.hypot(x / 1.5, y - 2.0 + 10.0 * forwards) < 10.5] = AIR
    z = image.axes()[2]
    values = np.array(values)
    values[(np.abs(x) < 20.0) & (np.abs(z + 56.0) < 12.0) & (y < 2.0)] = AIR
    values[(np.hypot(x / 1.5, y - 2.0) < 10.5) & (z < -50.0)] = AIR
    return cmfsim.ImageData(np.concatenate([neck, values], axis=2), image.spacing, origin)


def attachments(image, head):
    found = cmfsim.segment_head(image, landmarks=head.landmarks)
    return [finding for finding in found.findings if finding.code == "skin-attachment"]


def test_the_skin_over_a_windpipe_is_no_thing_on_the_face(head, long_neck):
    assert attachments(long_neck, head) == []


@pytest.mark.parametrize("content", [SOFT, 250.0])
def test_a_tube_in_the_windpipe_changes_nothing(head, long_neck, content):
    """A tracheal tube, 10 mm across with a wall of one voxel, down to the end of the image."""
    x, y, z = long_neck.axes()
    values = np.array(long_neck.values)
    forwards = np.clip((head.image.origin[2] - z) / 15.0, 0.0, 1.0)
    away = np.hypot(x, y - 2.0 + 10.0 * forwards)
    values[(away > 2.5) & (away < 5.0) & (z < -60.0)] = content
    assert attachments(long_neck.with_values(values), head) == []


def test_a_hollow_post_beside_the_chin_is_reported(head, long_neck):
    """Its air is closed in slice by slice down to the end of the image, as a windpipe's is."""
    x, y, z = long_neck.axes()
    values = np.array(long_neck.values)
    outside = values < -500.0
    away = np.hypot(x - 25.0, y + 98.0) + 0.0 * z
    post = (away < 14.0) & (z < -50.0) & (outside | (y < -60.0))
    values[post] = SOFT
    values[post & (away < 10.0)] = AIR
    (finding,) = attachments(long_neck.with_values(values), head)
    assert "mm" in finding.what


def test_a_shell_on_the_cheek_is_reported_though_its_air_is_narrow(head, long_neck):
    """40 mm of a curved plate that stands off the cheek by 10 mm and touches it at its edges."""
    x, y, z = long_neck.axes()
    values = np.array(long_neck.values)
    # The made face is an ellipsoid: the same, larger, on one side alone.
    larger = ((x / 72.0) ** 2 + ((y + 45.0) / 62.0) ** 2 + ((z + 45.0) / 82.0) ** 2) < 1.0
    gap = ((x / 68.0) ** 2 + ((y + 45.0) / 58.0) ** 2 + ((z + 45.0) / 78.0) ** 2) < 1.0
    part = (x > 8.0) & (y < -58.0) & (z > -75.0) & (z < -25.0) & (values < -500.0)
    values[part & larger] = SOFT
    inner = (x > 12.0) & (y < -62.0) & (z > -71.0) & (z < -29.0)
    values[part & gap & inner] = AIR
    assert attachments(long_neck.with_values(values), head)


def test_pads_of_a_clamp_as_dense_as_bone_are_reported_and_no_bone(head):
    """10 mm of hard plastic against either cheek: thick, and each the mirror image of the other."""
    x, y, z = head.image.axes()
    values = np.array(head.image.values)
    larger = ((x / 68.0) ** 2 + ((y + 45.0) / 58.0) ** 2 + ((z + 45.0) / 78.0) ** 2) < 1.0
    near = (np.abs(x) > 44.0) & (np.abs(y + 45.0) < 25.0) & (np.abs(z + 50.0) < 25.0)
    values[larger & near & (values < -500.0)] = 450.0
    plain, found = (
        cmfsim.segment_head(image, landmarks=head.landmarks)
        for image in (head.image, head.image.with_values(values))
    )
    codes = [finding.code for finding in found.findings]
    assert codes.count("skin-attachment") == 2
    for name, bone in plain.bones.items():
        assert np.count_nonzero(found.bones[name].values > 0.0) == pytest.approx(
            np.count_nonzero(bone.values > 0.0), rel=0.01
        )


@pytest.mark.parametrize(
    ("density", "spread", "is_reported"), [(110.0, 8.0, True), (110.0, 90.0, False)]
)
def test_a_soft_rest_round_the_chin_is_reported_and_streaks_there_are_not(
    head, density, spread, is_reported
):
    """On both sides alike, as thick as the chin itself, and without a step at its rim."""
    x, y, z = head.image.axes()
    values = np.array(head.image.values)
    away = (x / 62.0) ** 2 + ((y + 45.0) / 58.0) ** 2 + ((z + 60.0) / 70.0) ** 2
    rest = (away < 1.0) & (y < -60.0) & (z < -70.0) & (values < 0.0)
    noise = np.random.default_rng(1).normal(0.0, spread, values.shape)
    # Streaks run through several voxels.
    values[rest] = (
        density + (noise if spread < 50.0 else 3.0 * ndimage.gaussian_filter(noise, 1.0))[rest]
    )
    found = attachments(head.image.with_values(values), head)
    assert any("denser all through" in finding.what for finding in found) == is_reported


def test_the_shell_of_a_mask_that_is_left_out_of_the_head_is_reported(head):
    """Its rim changes the skin that it touches, and landmarks with it: 7 mm at the nose."""
    x, y, z = head.image.axes()
    values = np.array(head.image.values)
    front = (np.abs(x) < 30.0) & (np.abs(z + 68.0) < 28.0) & (np.abs(y + 103.0) < 1.5)
    values[front] = SOFT
    found = cmfsim.segment_head(head.image.with_values(values), landmarks=head.landmarks)
    (finding,) = [finding for finding in found.findings if finding.code == "skin-attachment"]
    assert "left out" in finding.what
    inside = found.attached[0]
    assert (inside[0] < [0.0, -103.0, -68.0]).all()
    assert (inside[1] > [0.0, -103.0, -68.0]).all()
