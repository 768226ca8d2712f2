"""Rigid registration of two scans of one head by mutual information (paper 3, Figure 5)."""

import contextlib
import itertools
import logging
import math
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim._core import rigid_matrix
from cmfsim.errors import BoundaryError, RegistrationError, RegistrationInputError
from cmfsim.imaging.morphology import Mask, as_itk, box_of, resampled_to, simpleitk, smoothed
from cmfsim.values.checks import Floats, Plain, as_positive, as_whole, check_instance, in_files
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

_LOG = logging.getLogger(__name__)

# Bins of the joint histogram along each axis, and the seed of the points.
BINS, SEED = 48, 1
# Steps at each resolution.
MOST_STEPS = 300
# At the end, the share of the mask in the moving volume, and the correlation of both volumes over
# it. Scans of one head reach 0.9; of two heads, or at a wrong place, 0.3.
LEAST_OVERLAP = LEAST_SIMILARITY = 0.5

# Values outside these shares of the voxels, %, (metal, noise) would spend the histogram's bins.
CLIPPED = (0.2, 99.8)


@dataclass(frozen=True)
class AlignmentOptions:
    """Options of the registration of two volumes; the defaults suit a CT of a head.

    Attributes
    ----------
    resolutions : tuple of float, mm
        Voxel sizes, coarse to fine. Starts further away than ten of the first may fail.
    samples : int
        Points of the mask that the metric is taken over, at random places (Mattes et al. 2003).

    Raises
    ------
    RegistrationError, CaseError
        (also `ValueError`) A value out of its range; not a number.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.AlignmentOptions(resolutions=(8, 4)).samples
    60000
    """

    resolutions: tuple[float, ...] = (6.0, 3.0, 1.5)
    samples: int = 60_000

    def __post_init__(self) -> None:
        sizes = tuple(as_positive("resolution", s) for s in self.resolutions)
        if not sizes or any(a <= b for a, b in itertools.pairwise(sizes)):
            raise RegistrationInputError(
                f"resolutions are {sizes} mm: give at least one, each finer than the last"
            )
        object.__setattr__(self, "resolutions", sizes)
        as_whole("samples", self.samples, 1000, error=RegistrationInputError)


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
            transform, moving, fixed, mask, size=size, share=options.samples / count, places=places
        )


def _descend(
    transform: Any, moving: Any, fixed: Any, mask: Any, *, size: float, share: float, places: Places
) -> tuple[int, float]:
    """Goes down the metric until the step is too small to matter."""
    method = simpleitk().ImageRegistrationMethod()
    method.SetMetricAsMattesMutualInformation(BINS)
    method.SetMetricFixedMask(mask)
    method.SetMetricSamplingStrategy(method.RANDOM)
    method.SetMetricSamplingPercentage(min(1.0, share), SEED)
    method.SetInterpolator(simpleitk().sitkLinear)
    method.SetOptimizerAsRegularStepGradientDescent(
        learningRate=FIRST_STEP * size,
        minStep=LAST_STEP * size,
        numberOfIterations=MOST_STEPS,
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
            f"the registration did not converge at {size:g} mm within {MOST_STEPS} steps; start "
            "closer with `initial`, or use a mask that shows the same bone in both"
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


@dataclass(frozen=True, eq=False)
class VolumeAlignment(Plain):
    """Position of a volume in the frame of another.

    Attributes
    ----------
    matrix : (4, 4) float64, mm
        Maps points of the moving volume to the fixed one.
    information : float
        Mutual information of both over the mask at the end, nats.
    similarity : float
        Correlation of both over the mask, −1 to 1.
    overlap : float
        Share of the mask that lies inside the moving volume.
    iterations : tuple of int
        At each resolution.
    """

    matrix: Floats
    information: float = field(metadata=in_files("information_nats"))
    similarity: float
    overlap: float
    iterations: tuple[int, ...]


def register_volumes(
    moving: ImageData,
    fixed: ImageData,
    *,
    mask: ImageData | None = None,
    initial: ArrayLike | None = None,
    options: AlignmentOptions | None = None,
) -> VolumeAlignment:
    """The rigid motion that aligns a moving volume with a fixed one.

    Parameters
    ----------
    moving, fixed : ImageData
        Scans of one head; their values need not be in the same unit.
    mask : ImageData, optional
        On the grid of `fixed`, not 0 where both show the same: the skull that the operation did not
        change (`undeformed_mask`). Without it, all of `fixed` is used, including moved jaws and
        skin.
    initial : (4, 4) float64, mm, optional
        Rigid motion to start from; by default the positions stated in the files.
    options : AlignmentOptions, optional

    Raises
    ------
    RegistrationError
        A mask on another grid, empty or too small, values without contrast, an initial matrix that
        is not rigid (also `ValueError`); volumes that do not overlap, no convergence, volumes that
        do not match at the end.
    ImageError
        SimpleITK is missing.

    Notes
    -----
    Mutual information after Mattes et al. (2003), by SimpleITK, from coarse to fine. The result is
    the same for any number of threads. The step is scaled by the inertia of the mask: a turn and a
    shift that move its points equally far count the same; otherwise the rotation of a round skull
    would converge slowly.

    Examples
    --------
    >>> import cmfsim
    >>> mask = cmfsim.undeformed_mask(before, landmarks)  # doctest: +SKIP
    >>> found = cmfsim.register_volumes(after, before, mask=mask)  # doctest: +SKIP
    >>> found.matrix @ [*place_in_after, 1.0]  # doctest: +SKIP
    """
    options = AlignmentOptions() if options is None else options
    for name, image in (("moving volume", moving), ("fixed volume", fixed)):
        check_instance(name, image, ImageData)
    chosen = _checked_mask(mask, fixed)
    start = np.eye(4) if initial is None else _rigid(initial)
    places = Places(chosen, fixed)
    low, high = _range("moving volume", moving.values)
    far = Clipped(moving, low, high)
    low, high = _range("fixed volume", fixed.values[chosen])
    near = Clipped(fixed, low, high)
    transform = places.transform(inverse(start))
    iterations: list[int] = []
    information = 0.0
    for size in options.resolutions:
        steps, information = align(
            transform,
            far.at(size, None),
            near.at(size, places.box),
            chosen,
            grid=fixed,
            size=size,
            options=options,
            places=places,
        )
        iterations.append(steps)
        _LOG.info("alignment at %g mm: %d steps, %.4f nats", size, steps, information)
    to_moving = matrix_of(transform)
    similarity, overlap = _agreement(to_moving, moving, fixed, places, options)
    if overlap < LEAST_OVERLAP:
        raise RegistrationError(
            f"only {overlap:.0%} of the mask lies in the moving volume (correlation there "
            f"{similarity:.2f}): at least {LEAST_OVERLAP:.0%} is needed; bring the "
            "volumes closer with `initial`, or restrict the mask to what both scans show"
        )
    if similarity < LEAST_SIMILARITY:
        raise RegistrationError(
            f"the volumes do not match after registration: correlation {similarity:.2f}, needed "
            f"{LEAST_SIMILARITY:g}; start closer with `initial`, mask out what was "
            "moved, and check that both show the same person"
        )
    return VolumeAlignment(inverse(to_moving), information, similarity, overlap, tuple(iterations))


def _agreement(
    to_moving: Floats,
    moving: ImageData,
    fixed: ImageData,
    places: Places,
    options: AlignmentOptions,
) -> tuple[float, float]:
    """The correlation of both volumes over the mask, and the share of it inside the moving one."""
    points = places.points[:: max(1, len(places.points) // options.samples)]
    there = points @ to_moving[:3, :3].T + to_moving[:3, 3]
    inside = ((there >= moving.lowest) & (there <= moving.highest)).all(axis=1)
    overlap = float(inside.mean())
    if np.count_nonzero(inside) < 2:
        return 0.0, overlap
    a, b = fixed.sample(points[inside]), moving.sample(there[inside])
    a, b = a - a.mean(), b - b.mean()
    size = float(np.linalg.norm(a) * np.linalg.norm(b))
    return (float(a @ b) / size if size > 0.0 else 0.0), overlap


def _checked_mask(mask: ImageData | None, fixed: ImageData) -> Mask:
    if mask is None:
        return np.ones(fixed.values.shape, dtype=bool, order="F")
    check_instance("mask", mask, ImageData)
    same = mask.values.shape == fixed.values.shape and np.allclose(mask.lowest, fixed.lowest)
    if not (same and np.allclose(mask.spacing, fixed.spacing)):
        raise RegistrationInputError(
            f"the mask is on another grid ({mask.values.shape} at {mask.lowest.tolist()} mm) "
            f"than the fixed volume ({fixed.values.shape} at {fixed.lowest.tolist()} mm)"
        )
    chosen = np.asfortranarray(mask.values != 0)
    if not chosen.any():
        raise RegistrationInputError("the mask is empty: mark the bone that was not moved")
    return chosen


def _range(name: str, values: NDArray[Any]) -> tuple[float, float]:
    """The values between which nearly all lie."""
    if not np.isfinite(values).all():
        raise RegistrationInputError(
            f"{name} has {np.count_nonzero(~np.isfinite(values))} voxels that are not finite"
        )
    low, high = (float(v) for v in np.percentile(values, CLIPPED))
    if not low < high:
        raise RegistrationInputError(
            f"{name} is {low:g} nearly everywhere (in the mask), so it cannot be registered"
        )
    return low, high


def _rigid(matrix: ArrayLike) -> Floats:
    try:
        return rigid_matrix(matrix, "initial")
    except BoundaryError as error:
        raise RegistrationInputError(str(error)) from error
