"""Sites of the skin by definition, in depth maps of faces whose mouth and nose are known."""

import numpy as np
import pytest

from cmfsim.registration.proposed.definitions.depth_maps import STEP, DepthMap
from cmfsim.registration.proposed.definitions.skin_sites import (
    MOUTH_CORNER,
    _peaks,
    find_skin_sites,
)

pytest.importorskip("scipy")

# What the skull says: where lips and nose are looked for, mm.
SKULL = {
    "rhinion": np.array([0.0, -95.0, 10.0]),
    "mid_philtrum": np.array([0.0, -95.0, -25.0]),
    "supradentale": np.array([0.0, -92.0, -33.0]),
    "pogonion": np.array([0.0, -92.0, -82.0]),
}
# The middle of the nose's tip and of the mouth, and the end of the nose downwards, mm.
TIP, MOUTH, BASE = -12.0, -46.0, -20.0


def _ramp(values, width):
    """1 below −width, 0 above it, and even between."""
    return np.clip(0.5 - values / (2.0 * width), 0.0, 1.0)


def face(mouth=(27.0, 27.0), nose=(18.0, 18.0), rise=0.0, gap=0.0):
    """The front view of a face: how far mouth and nose reach to the left and to the right, mm.

    rise: How much higher the left corner of the mouth is than the right one, mm.
    gap: How far the lips are apart, mm.
    """
    low = np.array([-70.0, -110.0])
    x = (low[0] + STEP * np.arange(int(140 / STEP)))[:, None]
    z = (low[1] + STEP * np.arange(int(160 / STEP)))[None]
    y = -100.0 + 0.012 * x**2 + 0.0 * z
    reach = np.where(x > 0.0, *nose)
    sides = _ramp(np.abs(x) - reach * np.clip((30.0 - z) / 42.0, 0.3, 1.0), 2.5)
    out = 20.0 * np.clip((30.0 - z) / 42.0, 0.2, 1.0) * _ramp(BASE - z, 2.0)
    y = y - out * sides * (1.0 - 0.3 * (x / reach) ** 2 * (np.abs(x) < reach))
    corner = np.where(x > 0.0, *mouth)
    height = MOUTH + rise * x / sum(mouth)
    within = _ramp(np.abs(x) - corner, 3.0)
    for above in (7.0, -8.0):
        y = y - 3.0 * within * np.exp(-0.5 * ((z - height - above) / 4.0) ** 2)
    y = y + 2.0 * within * np.exp(-0.5 * ((z - height) / 1.5) ** 2)
    if gap:
        y = np.where((np.abs(z - height) < 0.5 * gap) & (np.abs(x) < corner), -60.0, y)
    # The chin stands out below the lower lip.
    y = y - 4.0 * np.exp(-0.5 * ((z + 80.0) / 8.0) ** 2) * np.exp(-0.5 * (x / 15.0) ** 2)
    return DepthMap(low, y)


def test_corners_of_the_mouth_lie_where_the_line_between_the_lips_ends():
    even = find_skin_sites(face(), SKULL)
    wide = find_skin_sites(face(mouth=(31.0, 23.0), rise=6.0), SKULL)
    # The line leaves the average by 4 mm on either side, and each corner by 3 mm in height.
    for letter, side in (("L", 1.0), ("R", -1.0)):
        moved = wide[f"cheilion_{letter}"] - even[f"cheilion_{letter}"]
        assert moved[0] == pytest.approx(4.0, abs=1.2)
        assert moved[2] == pytest.approx(3.0 * side, abs=1.5)


def test_an_open_mouth_has_its_corners_where_an_average_one_has():
    found = find_skin_sites(face(gap=20.0), SKULL)
    for letter, side in (("L", 1.0), ("R", -1.0)):
        across = found[f"cheilion_{letter}"][0] - found["labiale_superius"][0]
        assert across == pytest.approx(side * MOUTH_CORNER, abs=0.1)


@pytest.mark.parametrize("nose", [(22.0, 15.0), (14.0, 14.0)])
def test_wings_of_the_nose_lie_where_its_sides_end(nose):
    usual, found = find_skin_sites(face(), SKULL), find_skin_sites(face(nose=nose), SKULL)
    for letter, side, reach in (("L", 1.0, nose[0]), ("R", -1.0, nose[1])):
        moved = side * (found[f"alare_{letter}"][0] - usual[f"alare_{letter}"][0])
        assert moved == pytest.approx(reach - 18.0, abs=0.8)


def test_a_nose_that_the_image_cuts_off_on_one_side_keeps_its_other_wing():
    whole = face()
    values = np.array(whole.values)
    values[whole.rows < -8.0] = np.nan
    half = find_skin_sites(DepthMap(whole.low, values), SKULL)
    wing = find_skin_sites(whole, SKULL)["alare_L"]
    np.testing.assert_allclose(half["alare_L"], wing, atol=0.5)


@pytest.mark.parametrize("step", [0.0, 0.5])
def test_peaks_are_those_of_scipy_flat_ones_too(step):
    signal = pytest.importorskip("scipy.signal")
    rng = np.random.default_rng(3)
    for least in (0.15, 0.5, 1.0) * 20:
        line = np.cumsum(rng.normal(size=rng.integers(3, 80)))
        line = np.round(line / step) * step if step else line
        assert _peaks(line, least) == signal.find_peaks(line, prominence=least)[0].tolist()
