"""A rigid transform bettered step by step at one resolution, by mutual information (SimpleITK)."""

import contextlib
import math
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np

from cmfsim.errors import RegistrationError, RegistrationInputError
from cmfsim.imaging.morphology import Mask, as_itk, box_of, resampled_to, simpleitk, smoothed
from cmfsim.imaging.two_scans.alignment_options import AlignmentOptions
from cmfsim.values.checks import Floats
from cmfsim.values.image_data import ImageData

_ONE_AT_A_TIME = threading.Lock()

# A mask needs this many voxels at the coarsest resolution for a histogram, and this extent, mm, for
# an angle.
LEAST_VOXELS = 500
LEAST_EXTENT = 20.0
# First and last step of a resolution, as shares of its voxel size: the metric has no shape finer
# than that, and the measured error is a fiftieth of a voxel.
FIRST_STEP = 0.7
LAST_STEP = 1.0 / 1500.0
# Factor on the step when the gradient turns about.
RELAXATION = 0.8
# Gradients below this end a resolution, 1/mm; the length of the step decides before.
LEAST_GRADIENT = 1e-9


class Places:
    """The mask in mm: where it lies, how far it reaches, how it turns."""

    def __init__(self, chosen: Mask, fixed: ImageData) -> None:
        spacing = fixed.spacing
        self.box = box_of(chosen, 2)
        index = np.argwhere(chosen)
        self.points = fixed.lowest + index * spacing
        self.centre = self.points.mean(axis=0)
        spread = ((self.points - self.centre) ** 2).mean(axis=0)
        extent = np.ptp(self.points, axis=0)
        if (extent < LEAST_EXTENT).any():
            raise RegistrationInputError(
                f"the mask measures {' × '.join(f'{e:.0f}' for e in extent)} mm: at least "
                f"{LEAST_EXTENT:g} mm along each axis are needed to find a rotation"
            )
        # Mean square of the shift of the mask's points by a turn of 1 rad about each axis, mm².
        self.inertia = spread.sum() - spread

    def transform(self, to_moving: Floats) -> Any:
        """An Euler transform about the middle of the mask, from fixed places to moving ones."""
        transform = simpleitk().Euler3DTransform()
        transform.SetCenter(self.centre.tolist())
        transform.SetMatrix(to_moving[:3, :3].ravel().tolist(), 1e-6)
        shift = to_moving[:3, :3] @ self.centre + to_moving[:3, 3] - self.centre
        transform.SetTranslation(shift.tolist())
        return transform


class Clipped:
    """A volume within a range of values, at any resolution."""

    def __init__(self, image: ImageData, low: float, high: float) -> None:
        self.image = image
        self.low, self.high = low, high

    def at(self, size: float, box: tuple[slice, ...] | None) -> Any:
        """An ITK image of cubic voxels of a size, mm, of the whole volume or a block of it."""
        spacing = self.image.spacing
        part = self.image.values if box is None else self.image.values[box]
        first = np.zeros(3) if box is None else np.array([b.start for b in box])
        values = np.asfortranarray(np.clip(part, self.low, self.high), dtype=np.float32)
        # A Gaussian of half a voxel, less the blur that the volume's own voxels are.
        width = 0.25 * (size**2 - float(np.median(spacing)) ** 2)
        if width > 0.0:
            values = smoothed(values, math.sqrt(width), spacing)
        shape = tuple(int(n) for n in np.floor((np.array(part.shape) - 1) * spacing / size) + 1)
        cubic = resampled_to(values, spacing, np.zeros(3), shape, np.full(3, size))
        image = as_itk(cubic, np.full(3, size))
        image.SetOrigin((self.image.lowest + first * spacing).tolist())
        return image


def align(
    transform: Any,
    moving: Any,
    fixed: Any,
    chosen: Mask,
    *,
    grid: ImageData,
    size: float,
    options: AlignmentOptions,
    places: Places,
) -> tuple[int, float]:
    """Betters a transform at one resolution; the steps taken and the information reached."""
    itk = simpleitk()
    mask = as_itk(np.asfortranarray(chosen), grid.spacing)
    mask.SetOrigin(grid.lowest.tolist())
    mask = itk.Resample(mask, fixed, itk.Transform(), itk.sitkNearestNeighbor)
    count = int(itk.GetArrayViewFromImage(mask).sum())
    if count < LEAST_VOXELS:
        raise RegistrationInputError(
            f"the mask has {count} voxels of {size:g} mm: at least {LEAST_VOXELS} are needed; "
            "make the mask larger, or the resolutions finer"
        )
    with _one_thread():
        return _descend(
            transform,
            moving,
            fixed,
            mask,
            size=size,
            options=options,
            share=options.samples / count,
            places=places,
        )


def _descend(
    transform: Any,
    moving: Any,
    fixed: Any,
    mask: Any,
    *,
    size: float,
    options: AlignmentOptions,
    share: float,
    places: Places,
) -> tuple[int, float]:
    """Goes down the metric until the step is too small to matter."""
    method = simpleitk().ImageRegistrationMethod()
    method.SetMetricAsMattesMutualInformation(options.bins)
    method.SetMetricFixedMask(mask)
    method.SetMetricSamplingStrategy(method.RANDOM)
    method.SetMetricSamplingPercentage(min(1.0, share), int(options.seed) + 1)
    method.SetInterpolator(simpleitk().sitkLinear)
    method.SetOptimizerAsRegularStepGradientDescent(
        learningRate=FIRST_STEP * size,
        minStep=LAST_STEP * size,
        numberOfIterations=options.max_iterations,
        relaxationFactor=RELAXATION,
        gradientMagnitudeTolerance=LEAST_GRADIENT,
    )
    method.SetOptimizerScales([*places.inertia, 1.0, 1.0, 1.0])
    method.SetInitialTransform(transform, True)  # noqa: FBT003 (ITK's own signature: in place)
    try:
        method.Execute(fixed, moving)
    except RuntimeError as error:
        raise RegistrationError(
            f"the volumes do not overlap enough at {size:g} mm to continue "
            f"({str(error).strip().splitlines()[-1]}); bring them closer with `initial`"
        ) from error
    steps = int(method.GetOptimizerIteration())
    reason = method.GetOptimizerStopConditionDescription()
    if "Maximum number" in reason:
        raise RegistrationError(
            f"the registration did not converge at {size:g} mm within {options.max_iterations} "
            "steps; start closer with `initial`, use a mask that shows the same bone in both, or "
            "raise max_iterations"
        )
    return steps, -float(method.GetMetricValue())


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Has ITK sum on one thread: the last digits of its metric depend on the number of threads.

    The metric heeds the default of the process alone, so two registrations wait for each other.
    """
    process = simpleitk().ProcessObject
    with _ONE_AT_A_TIME:
        before = process.GetGlobalDefaultNumberOfThreads()
        process.SetGlobalDefaultNumberOfThreads(1)
        try:
            yield
        finally:
            process.SetGlobalDefaultNumberOfThreads(before)


def matrix_of(transform: Any) -> Floats:
    """The (4, 4) matrix of an Euler transform."""
    matrix = np.eye(4)
    matrix[:3, :3] = np.reshape(transform.GetMatrix(), (3, 3))
    centre = np.array(transform.GetCenter())
    matrix[:3, 3] = np.array(transform.GetTranslation()) + centre - matrix[:3, :3] @ centre
    return matrix


def inverse(rigid: Floats) -> Floats:
    """The rigid motion back."""
    matrix = np.eye(4)
    matrix[:3, :3] = rigid[:3, :3].T
    matrix[:3, 3] = -rigid[:3, :3].T @ rigid[:3, 3]
    return matrix
