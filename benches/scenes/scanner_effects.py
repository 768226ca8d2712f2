"""Effects of X-rays, detectors and reconstruction on the image of a head, added to a clean CT.

Metal: line integrals through the slice at three energies, the detector's counts with scatter and
Poisson noise, and filtered back projection of the difference that the metal makes. Beam hardening
and photon starvation then give the dark bands and the streaks that scanners show.

Attenuation coefficients are those of Hubbell & Seltzer (NIST, 1995) to two digits.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage
from skimage.transform import iradon, radon

from cmfsim import ImageData

# A spectrum of 120 kV in three lines: parts of the photons at 50, 70 and 90 keV.
SPECTRUM = np.array([0.35, 0.40, 0.25])
# Attenuation at these energies, 1/mm.
WATER = np.array([0.0227, 0.0195, 0.0180])
BONE = np.array([0.081, 0.052, 0.041])
METALS = {
    "amalgam": np.array([8.2, 3.4, 3.3]),
    "steel": np.array([1.54, 0.65, 0.36]),
    "titanium": np.array([0.55, 0.245, 0.153]),
}
# HU of the bone that the coefficients are of.
DENSE = 1700.0
# Directions of the projections, and how often a direction is measured in a slice.
ANGLES = np.linspace(0.0, 180.0, 400, endpoint=False)
# Photons that leave the tube towards one element of the detector, and the part of them that
# arrives scattered.
PHOTONS = 2.0e5
SCATTER = 2.0e-4
# 12 bits with an offset of 1024, and the range of an extended scale, HU.
CLIPPED, EXTENDED = 3071.0, 30000.0


@dataclass(frozen=True)
class Pieces:
    """Metal of one kind: the part of each voxel that it fills."""

    kind: str
    filled: np.ndarray


def with_metal_scanned(
    image: ImageData, pieces: Sequence[Pieces], *, top: float = CLIPPED, seed: int = 0
) -> ImageData:
    """The image as a scanner would show it with metal, cut off at `top` HU."""
    values = image.values.astype(np.float64)
    rng = np.random.default_rng(seed)
    layers = np.flatnonzero(sum(p.filled.any(axis=(0, 1)).astype(int) for p in pieces))
    step = float(np.asarray(image.spacing)[0])
    for k in layers.tolist():
        here = [(METALS[p.kind], p.filled[:, :, k]) for p in pieces if p.filled[:, :, k].any()]
        values[:, :, k] += _difference(values[:, :, k], here, step, rng)
    kind = np.int16 if top < 32767 else np.int32
    return image.with_values(np.round(values).clip(-1024, top).astype(kind))


def _difference(
    hu: np.ndarray,
    metals: Sequence[tuple[np.ndarray, np.ndarray]],
    step: float,
    rng: np.random.Generator,
) -> np.ndarray:
    """What metal changes in one slice, HU."""
    size = max(hu.shape)
    square = [(0, size - n) for n in hu.shape]
    wide = np.pad(hu, square, constant_values=-1000.0)
    bone = np.clip((wide - 100.0) / (DENSE - 100.0), 0.0, 1.0)
    water = np.where(wide > 100.0, 1.1 * (1.0 - bone), np.clip(1.0 + wide / 1000.0, 0.0, None))
    paths = [_lines(part) * step for part in (water, bone)]
    clean = paths[0][..., None] * WATER + paths[1][..., None] * BONE
    loaded = clean.copy()
    for attenuation, filled in metals:
        path = _lines(np.pad(filled, square)) * step
        loaded += path[..., None] * attenuation
    effective = float(SPECTRUM @ WATER)
    counts = PHOTONS * (np.exp(-loaded) @ SPECTRUM + SCATTER)
    measured = -np.log(np.maximum(rng.poisson(counts), 1.0) / PHOTONS)
    expected = -np.log(np.exp(-clean) @ SPECTRUM)
    # Only rays that metal or its shadow changes: elsewhere the clean image has its own noise.
    touched = np.abs(loaded - clean).max(axis=-1) > 1e-6
    error = np.where(touched, measured - expected, 0.0)
    change = iradon(error, ANGLES, circle=False, output_size=size, filter_name="hann")
    found: np.ndarray = 1000.0 * change / (effective * step)
    return found[: hu.shape[0], : hu.shape[1]]


def _lines(part: np.ndarray) -> np.ndarray:
    lines: np.ndarray = radon(part, ANGLES, circle=False)
    return lines


def fillings(
    image: ImageData, places: Sequence[tuple[float, float, float]], radius: float = 4.0
) -> Pieces:
    """Balls of amalgam."""
    filled = np.zeros(image.values.shape)
    for a, b, c in places:
        x, y, z = image.axes()
        away = np.sqrt((x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2)
        filled = np.maximum(filled, np.clip(radius - away + 0.5, 0.0, 1.0))
    return Pieces("amalgam", filled)


def on_bone(
    image: ImageData, kind: str, places: Sequence[tuple[float, float]], size: Sequence[float]
) -> Pieces:
    """Blocks of metal in front of the bone: centres (x, z) and their size along x, y, z, mm."""
    x, y, z = (a.ravel() for a in image.axes())
    filled = np.zeros(image.values.shape)
    for a, c in places:
        column = image.values[np.argmin(np.abs(x - a)), :, np.argmin(np.abs(z - c))]
        bone = np.flatnonzero(column > 300)
        if not len(bone):
            continue
        centre = (a, y[bone[0]] - 0.5 * size[1], c)
        part = 1.0
        for axis, s, m in zip(image.axes(), size, centre, strict=True):
            step = abs(float(axis.ravel()[1] - axis.ravel()[0]))
            part = part * np.clip((0.5 * s - np.abs(axis - m)) / step + 0.5, 0.0, 1.0)
        filled = np.maximum(filled, part)
    return Pieces(kind, filled)


@dataclass(frozen=True)
class ConeBeam:
    """How a cone-beam scanner shows a head.

    Attributes
    ----------
    slope, offset : float
        Grey value = slope·HU + offset.
    cupping : float, HU
        Loss in the middle of the head against its rim.
    contrast : float
        What scatter leaves of the differences from soft tissue.
    noise : float, HU
    radius : float, mm
        Of the field of view; what lies outside has one value.
    middle : (float, float), mm
        x and y of its axis.
    rim : float, HU
        Excess at the border of a field of view that does not hold the head.
    """

    slope: float = 1.0
    offset: float = 0.0
    cupping: float = 150.0
    contrast: float = 0.85
    noise: float = 100.0
    radius: float = np.inf
    middle: tuple[float, float] = (0.0, 0.0)
    rim: float = 200.0
    top: float = 4095.0
    seed: int = field(default=0)


def cone_beam(image: ImageData, scanner: ConeBeam) -> ImageData:
    """The image as a cone-beam scanner would show it."""
    hu = image.values.astype(np.float64)
    head = ndimage.binary_fill_holes(ndimage.binary_opening(hu > -300, iterations=2))
    inside = ndimage.distance_transform_edt(head, sampling=image.spacing)
    depth = np.clip(inside / 60.0, 0.0, 1.0)
    hu = np.where(hu > -300, 40.0 + scanner.contrast * (hu - 40.0), hu)
    hu -= scanner.cupping * (2.0 * depth - depth**2)
    hu += scanner.noise * _reconstructed_noise(hu.shape, scanner.seed)
    x, y, _ = image.axes()
    out = scanner.radius - np.hypot(x - scanner.middle[0], y - scanner.middle[1])
    if np.isfinite(scanner.radius):
        hu += scanner.rim * np.exp(-np.abs(out) / 6.0) * head
    grey = np.round(scanner.slope * hu + scanner.offset)
    low = -1000.0 * scanner.slope + scanner.offset - 3.0 * scanner.noise * scanner.slope
    grey = np.where(out < 0.0, min(low, 0.0) if low < 0.0 else 0.0, grey)
    return image.with_values(grey.clip(min(low, 0.0), scanner.top).astype(np.int16))


def _reconstructed_noise(shape: tuple[int, ...], seed: int) -> np.ndarray:
    """Noise with the spectrum of filtered back projection in each slice, of variance 1."""
    noise = np.random.default_rng(seed).standard_normal(shape)
    fx, fy = np.fft.fftfreq(shape[0])[:, None], np.fft.fftfreq(shape[1])[None]
    radius = np.hypot(fx, fy)
    # A ramp under a Hann window gives the noise a power spectrum like its product.
    window = np.sqrt(radius) * 0.5 * (1.0 + np.cos(np.pi * np.clip(2.0 * radius, 0.0, 1.0)))
    shaped = np.fft.ifft2(np.fft.fft2(noise, axes=(0, 1)) * window[..., None], axes=(0, 1)).real
    scaled: np.ndarray = shaped / shaped.std()
    return scaled


def as_magnetic_resonance(image: ImageData, seed: int = 0) -> ImageData:
    """The head as a T1-weighted MR image: air and compact bone dark, fat and marrow bright."""
    hu = image.values.astype(np.float64)
    tissue = np.interp(
        hu, [-400.0, -150.0, -60.0, 20.0, 60.0, 150.0, 400.0], [0.0, 900, 900, 300, 420, 500, 40.0]
    )
    x, y, z = image.axes()
    coil = 1.0 + 0.3 * np.sin(x / 90.0) + 0.25 * np.cos(y / 110.0) + 0.1 * np.sin(z / 80.0)
    rng = np.random.default_rng(seed)
    noisy = np.hypot(tissue * coil + rng.normal(0.0, 15.0, hu.shape), rng.normal(0.0, 15, hu.shape))
    return image.with_values(np.round(noisy).astype(np.int16))
