"""The round field of view of cone-beam and zoomed CTs, outside which an image has one value."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.imaging.morphology import Mask

# Slices in which the field is looked for.
SLICES = 5
# Less of a slice than this is no padding: the corners of a square beside its circle are 0.21 of it.
LEAST_PADDING = 0.03
# Padding begins, and the image ends, within this of the circle, voxels.
RIM = 2.0


@dataclass(frozen=True)
class RoundField:
    """A cylinder along z.

    middle: (2,), of its axis along x and y, voxels (or mm).
    radii: (2,). Its half widths along x and y, voxels (or mm).
    """

    middle: NDArray[np.float64]
    radii: NDArray[np.float64]

    def scaled(self, spacing: NDArray[np.float64], origin: NDArray[np.float64]) -> "RoundField":
        """The same in mm."""
        return RoundField(origin + spacing * self.middle, spacing * self.radii)

    def inside(self, shape: tuple[int, ...], margin: float = 0.0) -> Mask:
        """Which columns (x, y) of the image lie inside, farther than a margin (voxels)."""
        x, y = (np.arange(n) - m for n, m in zip(shape[:2], self.middle, strict=True))
        a, b = np.maximum(self.radii - margin, 1e-9)
        found: Mask = (x[:, None] / a) ** 2 + (y[None] / b) ** 2 < 1.0
        return found


def round_field(values: NDArray[Any]) -> RoundField | None:
    """The round field of view; None where the image has another shape.

    All four corners of a slice have the same value then, which nearly nothing has inside a circle,
    and everything outside of it. A field that the borders of the image cut straight is not found.
    """
    layers = np.unique(np.linspace(0, values.shape[2] - 1, SLICES + 2).astype(int)[1:-1])
    corners = values[[0, 0, -1, -1], [0, -1, 0, -1]][:, layers]
    value = corners.flat[0]
    if not (corners == value).all():
        return None
    shown = (values[:, :, layers] != value).any(axis=2)
    if not LEAST_PADDING <= 1.0 - shown.mean() <= 1.0 - LEAST_PADDING:
        return None
    ends = [np.flatnonzero(shown.any(axis=1 - axis))[[0, -1]] for axis in (0, 1)]
    middle = np.array([0.5 * (a + b) for a, b in ends])
    radii = np.array([0.5 * (b - a) + 0.5 for a, b in ends])
    field = RoundField(middle, radii)
    within = field.inside(shown.shape, RIM)
    beyond = ~field.inside(shown.shape, -RIM)
    every = (values[:, :, layers] != value)[within].mean()
    if shown[beyond].any() or every < 1.0 - LEAST_PADDING:
        return None
    return field
