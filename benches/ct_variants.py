"""A CT made harder: what other scanners, patients and exports do to an image."""

import numpy as np
from scipy import ndimage
from skimage.transform import iradon, radon

from cmfsim import ImageData

# Parts of the phantom's tooth rows, LPS mm: upper and lower, left and right, and one in front.
FILLINGS = (
    (35.0, -265.0, 378.0),
    (-30.0, -268.0, 378.0),
    (20.0, -292.0, 380.0),
    (38.0, -262.0, 362.0),
    (-34.0, -262.0, 362.0),
    (-16.0, -290.0, 366.0),
)


def coarser(image: ImageData, factors: tuple[int, int, int]) -> ImageData:
    """Means over blocks of voxels."""
    f = np.array(factors)
    n = np.array(image.values.shape) // f
    part = image.values[tuple(slice(0, a * b) for a, b in zip(n, f, strict=True))]
    blocks = part.reshape(n[0], f[0], n[1], f[1], n[2], f[2]).mean(axis=(1, 3, 5))
    origin = np.asarray(image.origin) + 0.5 * (f - 1) * np.asarray(image.spacing)
    return ImageData(np.round(blocks).astype(np.int16), image.spacing * f, origin)


def cropped(
    image: ImageData, axis: int, *, low: float = -np.inf, high: float = np.inf
) -> ImageData:
    """The part between two places along an axis, mm."""
    along = image.axes()[axis].ravel()
    kept = np.flatnonzero((along >= low) & (along <= high))
    index = [slice(None)] * 3
    index[axis] = slice(kept[0], kept[-1] + 1)
    origin = np.array(image.origin)
    origin[axis] = along[kept[0]]
    return ImageData(image.values[tuple(index)], image.spacing, origin)


def with_noise(image: ImageData, sigma: float, seed: int = 0) -> ImageData:
    """Independent noise of a standard deviation (HU) in each voxel."""
    noise = np.random.default_rng(seed).normal(0.0, sigma, image.values.shape)
    return image.with_values(np.round(image.values + noise).clip(-1024, 3071).astype(np.int16))


def with_metal(
    image: ImageData,
    places: tuple[tuple[float, float, float], ...] = FILLINGS,
    radius: float = 4.0,
    least_transmission: float = 6.0,
) -> ImageData:
    """Fillings of metal and the streaks that photon starvation makes of them.

    Each slice with metal is projected; line integrals beyond `least_transmission` (so that fewer
    than exp(−6) of the photons arrive) are cut and grow noisy, and the slice is reconstructed.
    """
    x, y, z = image.axes()
    metal = np.zeros(image.values.shape, dtype=bool)
    for a, b, c in places:
        metal |= (x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2 < radius**2
    values = image.values.astype(np.float64)
    rng = np.random.default_rng(1)
    for k in np.flatnonzero(metal.any(axis=(0, 1))):
        values[:, :, k] += _streaks(values[:, :, k], metal[:, :, k], image, least_transmission, rng)
    values[metal] = 3071.0
    return image.with_values(np.round(values).clip(-1024, 3071).astype(np.int16))


def _streaks(
    slice_hu: np.ndarray,
    metal: np.ndarray,
    image: ImageData,
    least_transmission: float,
    rng: np.random.Generator,
) -> np.ndarray:
    # Water attenuates 0.02 per mm at 70 keV, fillings some 20 times as much.
    size = max(slice_hu.shape)
    wide = np.full((size, size), -1000.0)
    wide[: slice_hu.shape[0], : slice_hu.shape[1]] = slice_hu
    filled = np.zeros((size, size), dtype=bool)
    filled[: metal.shape[0], : metal.shape[1]] = metal
    step = float(np.asarray(image.spacing)[0])
    mu = 0.02 * step * np.clip(1.0 + wide / 1000.0, 0.0, None)
    mu[filled] = 0.4 * step
    angles = np.linspace(0.0, 180.0, 240, endpoint=False)
    lines = radon(mu, angles, circle=False)
    bad = lines > least_transmission
    measured = np.where(bad, least_transmission + rng.normal(0.0, 0.6, lines.shape), lines)
    error = iradon(measured - lines, angles, circle=False, output_size=size)
    error[filled] = 0.0
    streaks: np.ndarray = 1000.0 * error / (0.02 * step)
    return streaks[: slice_hu.shape[0], : slice_hu.shape[1]]


def with_pillow(image: ImageData, hu: float = -200.0) -> ImageData:
    """A dense pillow under the back of the head, touching it over a palm's width."""
    values = np.asarray(image.values).copy()
    x, y, z = image.axes()
    middle, back, height = _back_of_head(image)
    block = (
        (np.abs(x - middle) < 70.0)
        & (y > back - 12.0)
        & (y < back + 25.0)
        & (np.abs(z - height) < 45.0)
    )
    values[block & (values < hu)] = hu
    return image.with_values(values)


def with_holder(image: ImageData, hu: float = 120.0, thickness: float = 6.0) -> ImageData:
    """A shell of plastic round the back and the sides of the head, touching it."""
    values = np.asarray(image.values).copy()
    x, y, z = image.axes()
    middle, back, height = _back_of_head(image)
    radius = 84.0
    centre = back + 3.0 - radius
    distance = np.hypot(x - middle, y - centre)
    shell = (distance > radius - thickness) & (distance < radius) & (y > centre + 5.0)
    shell = shell & (np.abs(z - height) < 50.0)
    values[shell & (values < hu)] = hu
    return image.with_values(values)


def _back_of_head(image: ImageData) -> tuple[float, float, float]:
    """Middle x, hindmost y and its z of the bone, 5 mm of skin added, mm."""
    bone = ndimage.binary_opening(image.values > 400)
    x, y, z = (a.ravel() for a in image.axes())
    last = np.flatnonzero(bone.any(axis=(0, 2)))[-1]
    place = np.argwhere(bone[:, last])
    return float(x[place[:, 0]].mean()), float(y[last]) + 5.0, float(z[place[:, 1]].mean())


def without_couch(image: ImageData, behind: float) -> ImageData:
    """Air behind a place, mm."""
    values = np.asarray(image.values).copy()
    values[:, (image.axes()[1] > behind).ravel()] = -1000
    return image.with_values(values)


def saturated(image: ImageData, at: float) -> ImageData:
    """Values cut off at a number of HU, as scanners and exports do."""
    return image.with_values(np.minimum(image.values, at).astype(np.int16))


def with_tube(
    image: ImageData, skin: np.ndarray, hu: float = 250.0, radius: float = 5.0
) -> ImageData:
    """A tube taped to one cheek: a hollow cylinder of plastic that touches the skin.

    `skin` holds the middle of the tube, (n, 3) mm, along the face.
    """
    values = np.asarray(image.values).copy()
    x, y, z = image.axes()
    nearest = np.full(values.shape, np.inf)
    for a, b, c in skin:
        nearest = np.minimum(nearest, np.sqrt((x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2))
    outside = values < -300
    values[outside & (nearest < radius)] = hu
    values[outside & (nearest < radius - 2.5)] = -1000
    return image.with_values(values)
