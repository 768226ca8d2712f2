"""Volumes laid on each other: known motions of closed-form fields and of the real CT."""

import functools

import numpy as np
import pytest

import cmfsim
import real_heads

itk = pytest.importorskip("SimpleITK")

SPACING = np.array([3.0, 3.5, 4.0])
ORIGIN = np.array([-70.0, -75.0, 900.0])
SHAPE = (48, 44, 40)
MIDDLE = ORIGIN + 0.5 * SPACING * (np.array(SHAPE) - 1)
QUICK = cmfsim.AlignmentOptions(resolutions=(8.0, 4.0), samples=20_000)


def blobs(points, seed=3):
    """A sum of Gaussians about the middle of the grid: known everywhere, interpolated nowhere."""
    rng = np.random.default_rng(seed)
    total = np.zeros(points.shape[:-1])
    for centre, width, height in zip(
        MIDDLE + rng.uniform(-40, 40, (40, 3)),
        rng.uniform(6, 14, 40),
        rng.uniform(-600, 1200, 40),
        strict=True,
    ):
        total += height * np.exp(-((points - centre) ** 2).sum(axis=-1) / (2 * width**2))
    return total


def field(to_fixed=None, seed=3):
    """The blobs as seen after a motion: value(y) = blobs(M y)."""
    places = ORIGIN + SPACING * np.stack(np.indices(SHAPE), axis=-1)
    if to_fixed is not None:
        places = places @ to_fixed[:3, :3].T + to_fixed[:3, 3]
    return cmfsim.ImageData(blobs(places, seed).astype(np.float32), SPACING, ORIGIN)


def apart(found, true, centre):
    """Shift at a centre, mm, and turn, degrees, between two motions."""
    rest = cmfsim.decompose_motion(found @ np.linalg.inv(true), centre)
    return float(np.linalg.norm(rest.translation)), rest.angle


@pytest.mark.parametrize(
    ("shift", "angle", "axis"),
    [((0, 0, 0), 0, (1, 0, 0)), ((12, -13, 9), 10, (1, 2, -1)), ((-11, 5, 16), -10, (0, 0, 1))],
)
def test_a_known_motion_is_recovered(shift, angle, axis):
    true = cmfsim.rigid_motion(shift, angle, axis, MIDDLE)
    found = cmfsim.register_volumes(field(true), field(), options=QUICK)
    moved, turned = apart(found.matrix, true, MIDDLE)
    assert moved < 0.1
    assert turned < 0.1
    assert found.similarity > 0.98
    assert len(found.iterations) == 2
    assert set(found.as_dict()) >= {"matrix", "similarity", "overlap"}


def test_another_unit_of_the_values_does_not_matter():
    """Mutual information sees which values go together, not the values."""
    true = cmfsim.rigid_motion((8, -6, 5), 7, (1, 1, 0), MIDDLE)
    moving = field(true)
    other = moving.with_values(300.0 + 0.02 * moving.values)
    found = cmfsim.register_volumes(other, field(), options=QUICK)
    assert max(apart(found.matrix, true, MIDDLE)) < 0.1


def test_what_is_masked_out_has_no_say():
    """The larger, lower part goes elsewhere: with it the answer is off by mm, without it not."""
    true = cmfsim.rigid_motion((4, -3, 2), 4, (1, 1, 0), MIDDLE)
    moving, lower = field(true), field(cmfsim.rigid_motion((10, -3, 2), 4, (1, 1, 0), MIDDLE))
    z = moving.axes()[2]
    mixed = moving.with_values(np.where(z < MIDDLE[2] + 4, lower.values, moving.values))
    mask = moving.with_values((np.broadcast_to(z, SHAPE) > MIDDLE[2] + 8).astype(np.uint8))
    centre = MIDDLE + [0, 0, 40]
    masked = cmfsim.register_volumes(mixed, field(), mask=mask, options=QUICK)
    # A tenth of a voxel: the blobs are smooth, and few lie in the mask.
    assert max(apart(masked.matrix, true, centre)) < 0.4
    whole = cmfsim.register_volumes(mixed, field(), options=QUICK)
    assert max(apart(whole.matrix, true, centre)) > 2.0


def test_the_result_is_the_same_each_time_and_for_any_number_of_threads():
    true = cmfsim.rigid_motion((6, -3, 2), 5, (1, 1, 0), MIDDLE)
    moving, fixed = field(true), field()
    threads = itk.ProcessObject.GetGlobalDefaultNumberOfThreads()
    try:
        found = []
        for count in (1, 2, 3):
            itk.ProcessObject.SetGlobalDefaultNumberOfThreads(count)
            found.append(cmfsim.register_volumes(moving, fixed, options=QUICK).matrix)
    finally:
        itk.ProcessObject.SetGlobalDefaultNumberOfThreads(threads)
    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_array_equal(found[0], found[2])


@functools.cache
def coarse_ct():
    """The real CT as stored, its 2.9 × 2.9 × 4 mm version, and its mask."""
    image = cmfsim.read_image(real_heads.data_folder() / "ct_phantom" / "ct.nii.gz")
    return image, binned(image)


def binned(image):
    full = itk.GetImageFromArray(np.ascontiguousarray(image.values.transpose(2, 1, 0)))
    full.SetSpacing(image.spacing.tolist())
    full.SetOrigin(image.lowest.tolist())
    small = itk.BinShrink(itk.Cast(full, itk.sitkFloat32), [3, 3, 2])
    values = itk.GetArrayFromImage(small).transpose(2, 1, 0)
    return cmfsim.ImageData(values, small.GetSpacing(), small.GetOrigin())


@pytest.mark.parametrize(
    ("shift", "angle", "axis"), [((12, -13, 9.4), 10, (1, 2, -1.5)), ((0, 20, 0), -10, (1, 0, 0))]
)
def test_a_known_motion_of_the_real_ct_is_recovered(shift, angle, axis):
    """From 20 mm and 10° away to 0.1 mm and 0.1°, by the skull above the jaws alone."""
    image, coarse = coarse_ct()
    middle = 0.5 * (image.lowest + image.highest)
    true = cmfsim.rigid_motion(shift, angle, axis, middle)
    full = itk.GetImageFromArray(np.ascontiguousarray(image.values.transpose(2, 1, 0)))
    full.SetSpacing(image.spacing.tolist())
    full.SetOrigin(image.lowest.tolist())
    warp = itk.AffineTransform(3)
    warp.SetMatrix(true[:3, :3].ravel().tolist())
    warp.SetTranslation(true[:3, 3].tolist())
    moved = itk.GetArrayFromImage(
        itk.Resample(itk.Cast(full, itk.sitkFloat32), full, warp, itk.sitkLinear, -1024.0)
    ).transpose(2, 1, 0)
    mask = cmfsim.undeformed_mask(coarse, real_heads.landmarks("ct_phantom"), margin=6.0)
    options = cmfsim.AlignmentOptions(resolutions=(6.0, 3.0))
    found = cmfsim.register_volumes(
        binned(image.with_values(moved)), coarse, mask=mask, options=options
    )
    centre = (np.argwhere(mask.values) * mask.spacing + mask.lowest).mean(axis=0)
    moved, turned = apart(found.matrix, true, centre)
    assert moved < 0.1
    assert turned < 0.1


def test_the_mask_is_the_skull_above_the_jaws():
    _, coarse = coarse_ct()
    landmarks = real_heads.landmarks("ct_phantom")
    mask = cmfsim.undeformed_mask(coarse, landmarks)
    assert mask.sample([landmarks["glabella"] + [0, 4, 0]])[0] > 0.5
    for name in ("gonion_L", "pogonion", "supra_m2_R", "mental_eminence"):
        if name in landmarks:
            assert mask.sample([landmarks[name]])[0] == 0.0
    few = {k: v for k, v in landmarks.items() if k != "suborbital_L"}
    with pytest.raises(cmfsim.LandmarkError, match="lack suborbital_L"):
        cmfsim.undeformed_mask(coarse, few)
    with pytest.raises(cmfsim.RegistrationError, match="no voxel above 5000 HU"):
        cmfsim.undeformed_mask(coarse, landmarks, threshold=5000)
    line = dict(landmarks)
    for i, name in enumerate(("suborbital_L", "suborbital_R", "supraglenoid_L", "supraglenoid_R")):
        line[name] = MIDDLE + np.array([10.0 * i, 0, 0])
    with pytest.raises(cmfsim.LandmarkError, match="nearly on one line"):
        cmfsim.undeformed_mask(coarse, line)


def test_what_cannot_be_registered_is_named():
    fixed, moving = field(), field()
    empty = fixed.with_values(np.zeros(SHAPE, np.uint8))
    small = np.zeros(SHAPE, np.uint8)
    small[20:25, 20:25, 20:25] = 1
    flat = fixed.with_values(np.full(SHAPE, 7.0))
    bad = np.array(fixed.values)
    bad[1, 2, 3] = np.nan
    cases = [
        ({"mask": empty}, "mask is empty"),
        ({"mask": cmfsim.ImageData(np.ones((4, 5, 6)), (1, 1, 1))}, "another grid"),
        ({"mask": fixed.with_values(small)}, "at least 20 mm"),
        ({"initial": np.diag([2.0, 1, 1, 1])}, "not rigid"),
        ({"initial": np.eye(3)}, r"\(3, 3\)"),
        ({"fixed": flat}, "fixed volume is 7 nearly everywhere"),
        ({"moving": fixed.with_values(bad)}, "1 voxels that are not finite"),
    ]
    for arguments, pattern in cases:
        given = {"moving": moving, "fixed": fixed, **arguments}
        with pytest.raises(cmfsim.RegistrationError, match=pattern) as caught:
            cmfsim.register_volumes(
                given["moving"],
                given["fixed"],
                options=QUICK,
                **{k: v for k, v in arguments.items() if k in ("mask", "initial")},
            )
        assert isinstance(caught.value, ValueError)
    for options, pattern in [
        ({"resolutions": (2.0, 4.0)}, "each finer than the last"),
        ({"samples": 1}, "samples is 1"),
    ]:
        with pytest.raises(cmfsim.RegistrationError, match=pattern):
            cmfsim.AlignmentOptions(**options)


def test_volumes_that_do_not_fit_are_refused(monkeypatch):
    fixed = field()
    away = cmfsim.rigid_motion((400, 0, 0))
    with pytest.raises(cmfsim.RegistrationError, match="overlap enough"):
        cmfsim.register_volumes(field(), fixed, initial=away, options=QUICK)
    options = cmfsim.AlignmentOptions(resolutions=(8.0,))
    monkeypatch.setattr("cmfsim.imaging.two_scans.alignment.LEAST_SIMILARITY", 0.9)
    with pytest.raises(cmfsim.RegistrationError, match="do not match after registration"):
        cmfsim.register_volumes(field(seed=99), fixed, options=options)
    monkeypatch.setattr("cmfsim.imaging.two_scans.alignment.MOST_STEPS", 2)
    true = cmfsim.rigid_motion((8, -6, 5), 7, (1, 1, 0), MIDDLE)
    with pytest.raises(cmfsim.RegistrationError, match="within 2 steps"):
        cmfsim.register_volumes(field(true), fixed, options=options)
