"""A head of ellipsoids and bars as a CT, with its parts known."""

import functools
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from cmfsim import ImageData

AIR, SOFT, BONE = -1000.0, 40.0, 900.0


@dataclass(frozen=True)
class Head:
    """The CT and the truth: masks of skin (all inside), mandible, airway and brain."""

    image: ImageData
    skin: np.ndarray
    mandible: np.ndarray
    airway: np.ndarray
    brain: np.ndarray
    landmarks: dict


def _row(x, y, inner, outer, behind):
    """A horseshoe open to the back."""
    r = np.hypot(x, 0.8 * (y + 45.0))
    arch = (y <= -45.0) & (r > inner) & (r < outer)
    sides = (y > -45.0) & (y < behind) & (np.abs(x) > inner) & (np.abs(x) < outer)
    return arch | sides


@functools.cache
def made_head(step: float = 2.5, *, couch: bool = True) -> Head:
    """A head with skull, separate but touching mandible, airway from nostrils to neck, couch."""
    low, high = np.array([-90.0, -115.0, -125.0]), np.array([90.0, 145.0, 140.0])
    count = ((high - low) / step).astype(int)
    x, y, z = (
        (low[a] + step * np.arange(count[a])).reshape([-1 if a == b else 1 for b in range(3)])
        for a in range(3)
    )

    def ball(cx, cy, cz, a, b, c):
        return ((x - cx) / a) ** 2 + ((y - cy) / b) ** 2 + ((z - cz) / c) ** 2 < 1.0

    skin = ball(0, 10, 40, 76, 95, 83) | ball(0, -45, -45, 58, 48, 68)
    skin = skin | ((np.hypot(x, y - 30.0) < 52.0) & (z < 20.0)) | ball(0, -92, -18, 14, 16, 18)
    brain = ball(0, 10, 40, 62, 81, 69) & (z > -28.0)
    skull = ball(0, 10, 40, 69, 88, 76) & ~brain
    row = _row(x, y, 20.0, 32.0, -10.0)
    upper = row & (z > -52.0) & (z < 10.0)
    palate = (np.hypot(x, 0.8 * (y + 45.0)) < 32.0) & (y < -10.0) & (z > -38.0) & (z < -28.0)
    teeth = _row(x, y, 23.0, 29.0, -15.0) & (z > -68.0) & (z < -50.0)
    body = _row(x, y, 22.0, 34.0, 12.0) & (z > -98.0) & (z < -66.0)
    rami = (np.abs(x) > 26.0) & (np.abs(x) < 34.0) & (y > -6.0) & (y < 12.0)
    rami = rami & (z > -98.0) & (z < -34.0)
    mandible = body | rami | (teeth & (z < -60.0))
    skull = skull & ~ndimage.binary_dilation(np.broadcast_to(rami, skull.shape), iterations=2)
    bone = skull | upper | palate | teeth | mandible
    tube = (np.hypot(x, z + 18.0) < 5.0) & (y < 5.0)
    tube = (tube | (np.hypot(x, y - 2.0) < 8.0) & (z < -13.0)) & skin
    bone = bone & ~tube
    hu = np.where(skin, SOFT, AIR)
    hu[bone] = BONE
    hu[tube] = AIR
    if couch:
        hu[:, ((y > 107.0) & (y < 130.0)).ravel(), :] = 0.0
    hu = ndimage.gaussian_filter(hu, 0.6, mode="nearest")
    hu += np.random.default_rng(0).normal(0.0, 8.0, hu.shape)
    landmarks = {
        "menton": (0.0, -84.0, -97.0),
        "pogonion": (0.0, -85.0, -85.0),
        "supradentale": (0.0, -80.0, -51.0),
        "infradentale": (0.0, -80.0, -69.0),
        "occlusal_line_L": (30.0, -5.0, -60.0),
        "occlusal_line_R": (-30.0, -5.0, -60.0),
        "gonion_L": (32.0, 10.0, -96.0),
        "gonion_R": (-32.0, 10.0, -96.0),
        "nasion": (0.0, -72.0, 16.0),
    }
    image = ImageData(np.round(hu).astype(np.int16), np.full(3, step), low)
    shape = image.values.shape
    return Head(
        image,
        skin,
        np.broadcast_to(mandible, shape) & ~tube,
        np.broadcast_to(tube, shape),
        brain,
        {name: np.array(place) for name, place in landmarks.items()},
    )
