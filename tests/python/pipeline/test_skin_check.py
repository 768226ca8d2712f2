"""A skin that lost its nose or its tissue is kept where possible, and reported where not."""

import numpy as np
import pytest

import cmfsim
import real_heads
from benches.scenes import ct_variants as variants
from cmfsim import SegmentOptions, segment_head
from cmfsim.pipeline.building.skin import check_skin

pytest.importorskip("SimpleITK", reason="needs SimpleITK (pip install '.[imaging]')")
pytest.importorskip("skimage", reason="needs scikit-image (pip install '.[imaging]')")

WHOLE = SegmentOptions(part_jaws=False)
# What lies in front of this is nose and lips of the phantom, mm.
NOSE = -310.0


@pytest.fixture(scope="module")
def coarse():
    """The phantom's CT at about 4 mm."""
    image = cmfsim.read_image(real_heads.data_folder() / "ct_phantom" / "ct.nii.gz")
    return variants.coarser(image, (4, 4, 2))


def faded(image, least):
    """Contrast that falls towards the front, as at the end of a cone beam's field of view."""
    y = image.axes()[1]
    share = np.clip(1.0 - (1.0 - least) * (-255.0 - y) / 55.0, least, 1.0)
    return image.with_values(np.round(-1000.0 + (image.values + 1000.0) * share).astype(np.int16))


def in_front(anatomy):
    """Volume of the head in front of the bone of the nose, cm³."""
    y = anatomy.skin.axes()[1].ravel()
    return np.count_nonzero(anatomy.skin.values[:, y < NOSE] > 0) * np.prod(anatomy.skin.spacing)


def test_a_nose_darker_than_fat_keeps_its_skin_and_is_reported(coarse):
    """At 55 % of its contrast all of it lies below the fixed level."""
    clean, weak = (segment_head(image, WHOLE) for image in (coarse, faded(coarse, 0.55)))
    assert "skin-weak" in {finding.code for finding in weak.findings}
    assert "skin-weak" not in {finding.code for finding in clean.findings}
    assert in_front(weak) > 0.8 * in_front(clean) > 0.0


@pytest.mark.parametrize("head", real_heads.HEADS)
def test_a_skin_without_nose_or_tissue_is_reported_and_a_face_is_not(head):
    anatomy, sites = real_heads.anatomy(head), real_heads.landmarks(head)
    assert list(check_skin(anatomy, sites)) == []
    y = anatomy.skin.axes()[1]
    flat = np.where(y < sites["mid_philtrum"][1] - 4.0, -1.0, anatomy.skin.values)
    cut = cmfsim.Anatomy(anatomy.skin.with_values(flat.astype(np.float32)), anatomy.bones)
    found = list(check_skin(cut, sites))
    assert {finding.code for finding in found} == {"skin-implausible"}
    assert any("has no nose" in finding.what for finding in found)
    deeper = np.where(y < sites["pogonion"][1] + 2.0, -1.0, anatomy.skin.values).astype(np.float32)
    bare = cmfsim.Anatomy(anatomy.skin.with_values(deeper), anatomy.bones)
    assert any("missing at" in f.what and "pogonion" in f.what for f in check_skin(bare, sites))
