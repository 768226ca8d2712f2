"""Line integrals through slices, and slices from them: parallel rays in one plane.

The image's own rays, as far as an image still shows them: those through metal carry its streaks.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.imaging.morphology import Volume, sparse

# Directions over half a turn: at the rim of a head (100 mm) they are 1.3 mm apart.
DIRECTIONS = 240


@dataclass(frozen=True, eq=False)
class Projector:
    """The rays of slices of one size.

    Attributes
    ----------
    shares : (rays, pixels) sparse float32
        By linear interpolation between neighbouring rays; those of one direction follow each other.
    rays : int
        In each direction.
    area : float, mm²
        Of a pixel.
    step : float, mm
        Between rays.
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
