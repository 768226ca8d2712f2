"""Rigid registration of two scans of one head by mutual information (paper 3, Figure 5)."""

import logging
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim._core import rigid_matrix
from cmfsim.errors import BoundaryError, RegistrationError, RegistrationInputError
from cmfsim.imaging.morphology import Mask
from cmfsim.imaging.two_scans.alignment_options import AlignmentOptions
from cmfsim.imaging.two_scans.mutual_information import Clipped, Places, align, inverse, matrix_of
from cmfsim.values.checks import Floats, check_instance
from cmfsim.values.image_data import ImageData

_LOG = logging.getLogger(__name__)

# Values outside these shares of the voxels, %, (metal, noise) would spend the histogram's bins.
CLIPPED = (0.2, 99.8)


@dataclass(frozen=True, eq=False)
class VolumeAlignment:
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
    information: float
    similarity: float
    overlap: float
    iterations: tuple[int, ...]

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as JSON holds them."""
        return {
            "matrix": self.matrix.tolist(),
            "information_nats": self.information,
            "similarity": self.similarity,
            "overlap": self.overlap,
            "iterations": list(self.iterations),
        }


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

    Returns
    -------
    VolumeAlignment

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
    if overlap < options.least_overlap:
        raise RegistrationError(
            f"only {overlap:.0%} of the mask lies in the moving volume (correlation there "
            f"{similarity:.2f}): at least {options.least_overlap:.0%} is needed; bring the "
            "volumes closer with `initial`, or restrict the mask to what both scans show"
        )
    if similarity < options.least_similarity:
        raise RegistrationError(
            f"the volumes do not match after registration: correlation {similarity:.2f}, needed "
            f"{options.least_similarity:g}; start closer with `initial`, mask out what was "
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
