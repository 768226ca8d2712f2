"""Vessels with contrast agent are taken out of the bone; bone of their density stays."""

import os
from pathlib import Path

import numpy as np
import pytest

import cmfsim
from benches.scenes.clinic_scans import with_contrast
from cmfsim import SegmentOptions, segment_head
from cmfsim.pipeline.proposing import UNDER_THINGS, _by_vessels
from cmfsim.values.proposed_landmarks import ProposedSite
from synthetic_head import made_head

pytest.importorskip("SimpleITK", reason="needs SimpleITK (pip install '.[imaging]')")
pytest.importorskip("scipy.ndimage", reason="needs scipy")

from cmfsim.imaging.bones.vessels import without_vessels

WHOLE = SegmentOptions(part_jaws=False)
DATA = Path(os.environ.get("CMFSIM_DATA", Path(__file__).parents[4] / "shared/data"))
PHANTOM = DATA / "ct_phantom"


def codes(anatomy):
    return {f.code for f in anatomy.findings}


def added(found, plain):
    """Volume of the bone that one scan has more than the other, mm³."""
    one, other = (a.bones["skull"] for a in (found, plain))
    more = (one.values > 0.0) & (other.values <= 0.0)
    return float(np.count_nonzero(more) * np.prod(one.spacing))


def with_rods(image, hu, length, radius=7.0):
    """The image with a rod on each side of the neck, from its lower border up."""
    x, y, z = image.axes()
    values = np.array(image.values)
    rods = np.hypot(np.abs(x) - 36.0, y - 20.0) < radius
    values[rods & (z < z.min() + length) & (values < 200.0)] = hu
    return image.with_values(values)


@pytest.fixture(scope="module")
def head():
    return made_head()


@pytest.fixture(scope="module")
def plain(head):
    return segment_head(head.image, WHOLE)


def test_vessels_leave_the_bone_as_it_is_without_them(head, plain):
    found = segment_head(with_rods(head.image, 320.0, 100.0), WHOLE)
    (finding,) = [f for f in found.findings if f.code == "bone-vessels"]
    assert finding.severity == "warning"
    assert "320 HU" in finding.what
    away = np.hypot(np.abs(found.vessels[:, 0]) - 36.0, found.vessels[:, 1] - 20.0)
    assert len(away)
    assert np.quantile(away, 0.95) < 7.0
    assert not len(plain.vessels)
    assert "bone-vessels" not in codes(plain)
    assert added(found, plain) < 200.0
    assert added(plain, found) < 200.0


@pytest.mark.parametrize(
    ("hu", "length", "radius"),
    [(900.0, 100.0, 7.0), (320.0, 45.0, 7.0), (320.0, 100.0, 14.0)],
    ids=["compact", "short", "wide"],
)
def test_bone_that_is_no_vessel_stays(head, plain, hu, length, radius):
    found = segment_head(with_rods(head.image, hu, length, radius), WHOLE)
    assert "bone-vessels" not in codes(found)
    assert added(found, plain) > 2000.0


def test_sites_beside_a_vessel_that_was_taken_out_are_doubtful():
    sites = {"near": ProposedSite(np.zeros(3), 2.0), "far": ProposedSite(np.full(3, 6.0), 2.0)}
    marked = _by_vessels(sites, np.array([[3.0, 0.0, 0.0], [-90.0, 0.0, 0.0]]))
    assert "bone-vessels" in marked["near"].doubt
    assert marked["near"].error == UNDER_THINGS
    assert marked["far"] is sites["far"]
    assert _by_vessels(sites, np.zeros((0, 3))) == sites


@pytest.mark.parametrize(("density", "vessel"), [(900.0, True), (400.0, False)])
def test_bone_that_is_nowhere_compact_is_no_vessel(density, vessel):
    """A rod of 320 HU beside a plate: a vessel only where the plate is much denser."""
    x, y, _ = np.ogrid[:40, :40, :90]
    hu = np.full((40, 40, 90), 40.0, np.float32, order="F")
    hu[:12] = density
    rod = np.broadcast_to(np.hypot(x - 28.0, y - 20.0) < 5.0, hu.shape)
    hu[rod] = 320.0
    _, kept, vessels, findings = without_vessels(hu, hu > 250.0, np.ones(3))
    assert bool(findings) is vessel
    assert (vessels is not None) is vessel
    assert bool((kept & rod).any()) is not vessel
    assert kept[:12].all()


@pytest.mark.skipif(
    not (PHANTOM / "ct.nii.gz").is_file(), reason=f"needs the head phantom's CT in {PHANTOM}"
)
def test_large_vessels_of_a_real_skull_are_taken_out():
    """Of 28 cm³ of vessels, 5 remain: branches of 3 mm that touch bone or skin."""
    image = cmfsim.read_image(PHANTOM / "ct.nii.gz")
    skull, skin = (
        cmfsim.read_landmarks(PHANTOM / f"{kind}_landmarks.mrk.json") for kind in ("skull", "skin")
    )
    plain = segment_head(image, WHOLE)
    found = segment_head(with_contrast(image, skull, skin), WHOLE)
    assert "bone-vessels" not in codes(plain)
    assert "bone-vessels" in codes(found)
    assert added(found, plain) < 6000.0
    assert added(plain, found) < 1000.0
