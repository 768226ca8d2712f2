"""Images: scalar values on an axis-aligned grid in LPS."""

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.errors import CaseInputError
from cmfsim.values.checks import Floats, Frozen, as_point, as_rows, as_unmasked, brief, keep

# Points that are looked up at a time.
AT_A_TIME = 8192


@dataclass(frozen=True, eq=False)
class ImageData(Frozen):
    """A scalar image on an axis-aligned grid: values[i, j, k] lies at origin + (i, j, k)·spacing.

    Attributes
    ----------
    values : (nx, ny, nz) array of real numbers
        Axes along +L, +P, +S. Kept as given, without a copy; treated as read-only.
    spacing : (3,) float64, mm
    origin : (3,) float64, mm
        Centre of voxel (0, 0, 0), LPS.

    Raises
    ------
    CaseError
        (also `ValueError`) Not three axes, an empty axis, spacing not positive, NaN or infinity in
        spacing or origin.

    Examples
    --------
    >>> import cmfsim, numpy as np
    >>> image = cmfsim.ImageData(np.zeros((4, 5, 6)), spacing=(1, 1, 2), origin=(0, 0, 10))
    >>> image.highest.tolist()
    [3.0, 4.0, 20.0]
    """

    values: NDArray[Any]
    spacing: Floats
    origin: Floats

    __repr__ = brief

    def __init__(
        self, values: NDArray[Any], spacing: ArrayLike, origin: ArrayLike = (0.0, 0.0, 0.0)
    ) -> None:
        values = as_unmasked("image", values)
        if values.ndim != 3 or 0 in values.shape:
            raise CaseInputError(f"image has shape {values.shape}: three axes, none empty, needed")
        if values.dtype.kind not in "fiub":
            raise CaseInputError(f"image has dtype {values.dtype}: real numbers are needed")
        steps = as_point("image spacing", spacing)
        if (steps <= 0.0).any():
            raise CaseInputError(f"image spacing is {steps.tolist()} mm: must be above 0")
        keep(self, values=values, spacing=steps, origin=as_point("image origin", origin))

    @property
    def lowest(self) -> Floats:
        """Centre of the first voxel, (3,) mm."""
        return self.origin

    @property
    def highest(self) -> Floats:
        """Centre of the last voxel, (3,) mm."""
        steps = np.array(self.values.shape) - 1
        return self.lowest + steps * self.spacing

    @property
    def single(self) -> NDArray[np.float32]:
        """The values in single precision, not copied where they are."""
        return self.values.astype(np.float32, copy=False)

    def with_values(self, values: NDArray[Any]) -> "ImageData":
        """Other values on the same grid."""
        if np.shape(values) != self.values.shape:
            raise CaseInputError(f"values have shape {np.shape(values)}, not {self.values.shape}")
        return ImageData(values, self.spacing, self.origin)

    def axes(self) -> tuple[Floats, Floats, Floats]:
        """The coordinates of the voxel centres along each axis, mm, shaped to broadcast."""
        x, y, z = (
            o + s * np.arange(n)
            for o, s, n in zip(self.lowest, self.spacing, self.values.shape, strict=True)
        )
        return x[:, None, None], y[None, :, None], z[None, None, :]

    def sample(self, points: ArrayLike) -> Floats:
        """The values at points, trilinear; beyond the border those of the nearest border point.

        Parameters
        ----------
        points : (n, 3) float64, mm

        Returns
        -------
        (n,) float64
        """
        places = as_rows("points", points, 3)
        found = np.empty(len(places))
        contiguous = self.values.flags.c_contiguous or self.values.flags.f_contiguous
        values = self.values if contiguous else np.ascontiguousarray(self.values)
        flat = values.ravel(order="K")
        # What one step along each axis adds to a voxel's number in the order of memory.
        steps = np.array(values.strides) // values.itemsize
        # Some thousand points at a time: their weights stay in the cache.
        for begin in range(0, len(places), AT_A_TIME):
            part = slice(begin, begin + AT_A_TIME)
            found[part] = self._trilinear(places[part], flat, steps)
        return found

    def _trilinear(self, points: Floats, flat: NDArray[Any], steps: NDArray[np.intp]) -> Floats:
        # Along each axis: what both sides of a point add to a voxel's number, each with its weight.
        sides = []
        for axis, step in enumerate(steps):
            last = self.values.shape[axis] - 1
            place = points[:, axis] - self.lowest[axis]
            place /= self.spacing[axis]
            np.clip(place, 0.0, float(last), out=place)
            low = np.minimum(place.astype(np.intp), max(last - 1, 0))
            after = place - low
            high = np.minimum(low + 1, last)
            sides.append(((low * step, 1.0 - after), (high * step, after)))
        total = np.zeros(len(points))
        for (k, w), (j, v), (i, u) in itertools.product(*reversed(sides)):
            part = u * v
            part *= w
            part *= flat.take(i + j + k)
            total += part
        return total
