"""Removal of metal artefacts from slices, by replacing the rays through the metal.

Normalised metal artefact reduction (Meyer et al. 2010): each direction's line integrals are divided
by those of a plain image of air, soft tissue and bone, so that they vary little; across the shadow
of the metal they are interpolated (Kalender et al. 1987) and multiplied back. Only the change is
reconstructed, so that the rest of the image stays sharp.

Rays are parallel, in one plane: the image's own line integrals, as far as an image still shows
them; those through metal carry its streaks.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.imaging.intensities.intensity import SOFT
from cmfsim.imaging.morphology import Mask, Volume, ndimage, sparse

# Directions over half a turn: at the rim of a head (100 mm) they are 1.3 mm apart.
DIRECTIONS = 240

# Rays through less metal than this are kept, mm.
LEAST_PATH = 0.05
# The plain image: air below the first, bone above the second, soft tissue between, HU. It is made
# from an image smoothed by this, mm, and its bone is at most as dense as enamel.
PLAIN = (-500.0, 350.0)
PLAIN_SIGMA = 1.0
ENAMEL = 2000.0
# Rays through less water than this are not normalised, mm.
LEAST_WATER = 5.0
# Threshold of metal, HU; the value of metal itself carries no information.
DENSEST = 2500.0
# Window in which the deviation of soft tissue from a single value is measured, mm; largest
# deviation that counts, HU.
NEARBY = 8.0
FARTHEST = 1000.0
# What is denser than soft tissue is lowered, but not below this, HU, by this many standard
# deviations.
DENSE = 100.0
EXCESS = 2.0
# Number of slices corrected together; more would need more memory without being faster.
TOGETHER = 16


@dataclass(frozen=True, eq=False)
class Projector:
    """The rays of slices of one size.

    shares: (rays, pixels) sparse float32, by linear interpolation between neighbouring rays; those
        of one direction follow each other.
    rays: In each direction.
    area: mm², of a pixel.
    step: mm, between rays.
    """

    shares: Any
    rays: int
    area: float
    step: float

    def lines(self, slices: Volume) -> Volume:
        """Line integrals of slices (x, y, slice): direction, ray, slice."""
        flat = np.ascontiguousarray(slices.reshape(-1, slices.shape[2]))
        found: Volume = self.shares @ flat
        found *= np.float32(self.area / self.step)
        return found.reshape(DIRECTIONS, self.rays, -1)

    def slices(self, lines: Volume, shape: tuple[int, ...]) -> Volume:
        """Slices whose line integrals these are, by filtered back projection.

        Ramachandran & Lakshminarayanan's filter (1971) on rays of this step.
        """
        width = 2 * self.rays
        n = np.minimum(np.arange(width), width - np.arange(width))
        # h(0) = 1/(4 τ²), h(n) = −1/(n π τ)² for odd n, else 0; times the step τ of the sum.
        ramp = np.zeros(width)
        ramp[n % 2 == 1] = -1.0 / (np.pi * n[n % 2 == 1]) ** 2
        ramp[0] = 0.25
        spectrum = np.fft.rfft(ramp).real[None, :, None] / self.step
        filtered = np.fft.irfft(np.fft.rfft(lines, n=width, axis=1) * spectrum, axis=1)
        kept = filtered[:, : self.rays].astype(np.float32).reshape(-1, lines.shape[2])
        back: Volume = (self.shares.T @ kept) * np.float32(np.pi / DIRECTIONS)
        return back.reshape(shape)


def projector(shape: tuple[int, ...], spacing: NDArray[np.float64]) -> Projector:
    """The rays of slices of a shape, as far apart as voxels."""
    x, y = (s * (np.arange(n) - 0.5 * (n - 1)) for s, n in zip(spacing[:2], shape[:2], strict=True))
    step = float(min(spacing[:2]))
    half = int(np.hypot(x[-1], y[-1]) / step) + 2
    rays = 2 * half + 1
    pixels = len(x) * len(y)
    blocks = []
    for angle in np.pi * np.arange(DIRECTIONS) / DIRECTIONS:
        place = (x[:, None] * np.cos(angle) + y[None] * np.sin(angle)).ravel() / step + half
        first = np.floor(place).astype(np.int32)
        share = (place - first).astype(np.float32)
        # Two entries a pixel, column by column: the layout of compressed columns.
        values = np.stack([1.0 - share, share], axis=1).ravel()
        index = np.stack([first, first + 1], axis=1).ravel()
        starts = np.arange(0, 2 * pixels + 1, 2, dtype=np.int32)
        blocks.append(sparse().csc_array((values, index, starts), shape=(rays, pixels)).tocsr())
    return Projector(sparse().vstack(blocks, format="csr"), rays, float(np.prod(spacing[:2])), step)


def without_metal(
    hu: Volume, metal: Mask, spacing: NDArray[np.float64], usual: float
) -> tuple[Volume, NDArray[np.float64], NDArray[np.float64]]:
    """HU of slices (x, y, slice) without metal and most of its streaks.

    Where the slices as they are show soft tissue more evenly than the corrected ones, they are
    kept: the mean of both is weighted by the inverse fourth power of the deviations. What is
    denser than soft tissue is lowered by what these exceed their usual value, so that streaks that
    are left are not bone. Also the deviation of each slice's soft tissue from one value (root mean
    square) before and after, HU.
    """
    rays = projector(hu.shape, spacing)
    flat = (NEARBY / spacing[0], NEARBY / spacing[1], 0.0)
    corrected = np.empty_like(hu, order="F")
    worth = np.zeros((2, hu.shape[2]))
    for start in range(0, hu.shape[2], TOGETHER):
        block = slice(start, start + TOGETHER)
        here, hidden = hu[:, :, block], metal[:, :, block]
        bridged, plain = _reconstructed(here, hidden, rays, spacing)
        soft = _is_soft(plain) & ~hidden
        share = ndimage().gaussian_filter(soft.astype(np.float32), flat) + np.float32(1e-3)
        before, after = (_squares(values, soft) for values in (here, bridged))
        worth[:, block] = _root_mean(before, soft), _root_mean(after, soft)
        # 1 HU² keeps the weights finite where nothing deviates.
        old, new = (ndimage().gaussian_filter(s, flat) / share + 1.0 for s in (before, after))
        weight = old**2 / (old**2 + new**2)
        mixed = here + weight * (bridged - here)
        excess = np.sqrt(weight * new + (1.0 - weight) * old) - usual
        lowered = np.maximum(mixed - EXCESS * np.maximum(excess, 0.0), DENSE)
        corrected[:, :, block] = np.where(mixed > DENSE, lowered, mixed)
    return corrected, worth[0], worth[1]


def deviations(hu: Volume, spacing: NDArray[np.float64]) -> NDArray[np.float64]:
    """Root mean square deviation of each slice's soft tissue from a single value, HU."""
    soft = _is_soft(_plain(hu, spacing))
    return _root_mean(_squares(hu, soft), soft)


def _is_soft(plain: Volume) -> Mask:
    soft: Mask = np.abs(plain - np.float32(1.0 + 1e-3 * SOFT)) < 1e-4
    return soft


def _root_mean(squares: Volume, soft: Mask) -> NDArray[np.float64]:
    counts = np.maximum(soft.sum(axis=(0, 1)), 1)
    deviation: NDArray[np.float64] = np.sqrt(squares.sum(axis=(0, 1)) / counts)
    return deviation


def _squares(hu: Volume, soft: Mask) -> Volume:
    """Squared deviations from soft tissue, HU²; 0 elsewhere."""
    off = np.clip(hu - np.float32(SOFT), -FARTHEST, FARTHEST)
    return np.where(soft, off * off, np.float32(0.0))


def _reconstructed(
    hu: Volume, metal: Mask, rays: Projector, spacing: NDArray[np.float64]
) -> tuple[Volume, Volume]:
    """HU with the rays through metal replaced, and the plain image relative to water."""
    water = np.clip(hu, -1000.0, DENSEST) * np.float32(1e-3) + np.float32(1.0)
    lines = rays.lines(water)
    hidden = rays.lines(metal.astype(np.float32)) > LEAST_PATH
    change = rays.slices(_bridged(lines, hidden, None) - lines, water.shape)
    plain = _plain(1000.0 * (water + change) - 1000.0, spacing)
    change = rays.slices(_bridged(lines, hidden, rays.lines(plain)) - lines, water.shape)
    return 1000.0 * (water + change) - 1000.0, plain


def _bridged(lines: Volume, hidden: Mask, prior: Volume | None) -> Volume:
    """Line integrals, interpolated across the metal's shadow in each direction."""
    scale = np.ones_like(lines) if prior is None else np.maximum(prior, np.float32(LEAST_WATER))
    ratio = lines / scale
    place = np.arange(lines.shape[1])
    for direction, layer in np.argwhere(hidden.any(axis=1)).tolist():
        gap = hidden[direction, :, layer]
        row = ratio[direction, :, layer]
        ratio[direction, gap, layer] = np.interp(place[gap], place[~gap], row[~gap])
    return np.where(hidden, ratio * scale, lines)


def _plain(hu: Volume, spacing: NDArray[np.float64]) -> Volume:
    """Attenuation of air, soft tissue and bone, relative to water."""
    air, bone = PLAIN
    flat = (PLAIN_SIGMA / spacing[0], PLAIN_SIGMA / spacing[1], 0.0)
    smooth = ndimage().gaussian_filter(hu, flat)
    dense = np.where(smooth < bone, SOFT, np.clip(hu, bone, ENAMEL))
    plain = np.where(smooth < air, -1000.0, dense) * 1e-3 + 1.0
    return plain.astype(np.float32, copy=False)
