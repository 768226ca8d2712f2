"""The segmentation of a real head's CT and of variants of it, against reference surfaces."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

import cmfsim
from benches.scenes import ct_variants as variants
from cmfsim import SegmentOptions, segment_head
from phantom_reference import check_face, distances, face, parted_as, surface_points
from phantom_reference import reference as reference_surfaces

pytest.importorskip("SimpleITK", reason="needs SimpleITK (pip install '.[imaging]')")
pytest.importorskip("scipy.ndimage", reason="needs scipy")
pytest.importorskip("skimage.measure", reason="needs scikit-image")

# For what does not depend on where the jaws part.
WHOLE = SegmentOptions(part_jaws=False)
DATA = Path(os.environ.get("CMFSIM_DATA", Path(__file__).parents[4] / "shared/data"))
PHANTOM = DATA / "ct_phantom"

pytestmark = pytest.mark.skipif(
    not (PHANTOM / "ct.nii.gz").is_file(), reason=f"needs the head phantom's CT in {PHANTOM}"
)


def codes(anatomy):
    return {f.code for f in anatomy.findings}


@pytest.fixture(scope="session")
def phantom():
    return cmfsim.read_image(PHANTOM / "ct.nii.gz")


@pytest.fixture(scope="session")
def phantom_landmarks():
    document = json.loads((PHANTOM / "skull_landmarks.mrk.json").read_text())
    points = document["markups"][0]["controlPoints"]
    return {p["label"]: np.array(p["position"]) for p in points}


@pytest.fixture(scope="session")
def coarse_phantom(phantom):
    return variants.coarser(phantom, (2, 2, 1))


@pytest.fixture(scope="session", params=["coarse", pytest.param("whole", marks=pytest.mark.slow)])
def real(request):
    """The real head segmented as the reference was, whose bone's surface lies at 250 HU.

    And how much farther off it may be than in the CT's own voxels.
    """
    coarse = request.param == "coarse"
    image = request.getfixturevalue("coarse_phantom" if coarse else "phantom")
    marks = request.getfixturevalue("phantom_landmarks")
    options = SegmentOptions(bone_threshold=250.0)
    return segment_head(image, options, landmarks=marks), 2.0 if coarse else 1.0


@pytest.fixture(scope="session")
def reference():
    return reference_surfaces()


def test_the_real_skin_is_that_of_the_reference(real, reference):
    anatomy, slack = real
    distance = distances(face(surface_points(anatomy.skin)), reference["skin"])
    assert np.median(distance) < slack * 0.1
    assert np.percentile(distance, 95.0) < slack * 0.5
    volume = np.count_nonzero(anatomy.skin.values > 0) * np.prod(anatomy.skin.spacing)
    assert volume == pytest.approx(4.197e6, rel=0.01)


def test_the_real_bone_is_that_of_the_reference(real, reference):
    anatomy, slack = real
    both = np.maximum(*(level.values for level in anatomy.bones.values()))
    distance = distances(face(surface_points(anatomy.skin.with_values(both))), reference["bone"])
    assert np.median(distance) < slack * 0.15
    assert np.percentile(distance, 95.0) < slack * 1.0


def test_the_real_jaws_are_parted(real, reference):
    anatomy, slack = real
    assert parted_as(anatomy, reference) > 1.0 - slack * 0.02
    jaw = anatomy.bones["mandible"]
    volume = np.count_nonzero(jaw.values > 0) * np.prod(jaw.spacing)
    assert volume == pytest.approx(79.9e3, rel=slack * 0.05)


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


@pytest.mark.parametrize(
    "name",
    [name if name == "pillow" else pytest.param(name, marks=pytest.mark.slow) for name in VARIANTS],
)
def test_a_hard_variant_of_the_real_ct_keeps_its_face(
    name, coarse_phantom, phantom_landmarks, reference
):
    make, expected, median, p95, parted = VARIANTS[name]
    anatomy = segment_head(make(coarse_phantom), landmarks=phantom_landmarks)
    assert expected <= codes(anatomy)
    assert not [f for f in anatomy.findings if f.severity == "error"]
    check_face(anatomy, reference, median, p95, parted)


def test_the_real_face_has_nothing_attached(real):
    assert not {"skin-attachment", "ct-saturated", "metal"} & codes(real[0])


def test_the_real_jaws_are_parted_without_landmarks(coarse_phantom, reference):
    anatomy = segment_head(coarse_phantom)
    assert "jaws-parted-by-shape" in codes(anatomy)
    assert parted_as(anatomy, reference) > 0.85


# Its small twin is the test of the synthetic head that is flipped.
@pytest.mark.slow
@pytest.mark.parametrize("axis", [1, 2])
def test_a_flipped_real_ct_is_found(coarse_phantom, axis):
    flipped = coarse_phantom.with_values(np.flip(coarse_phantom.values, axis))
    anatomy = segment_head(flipped, WHOLE)
    assert "ct-flipped" in {f.code for f in anatomy.findings if f.severity == "error"}


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
