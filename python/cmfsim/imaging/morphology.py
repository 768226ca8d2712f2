"""Distances, growing and shrinking of masks in mm, over SimpleITK and scipy.

Arrays have axes x, y, z and Fortran order, which is the order of ITK's memory: both sides then see
the same bytes, and element-wise work runs straight through memory.
"""

from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import ImageError

__all__ = [
    "Mask",
    "Volume",
    "as_array",
    "as_itk",
    "binned",
    "closed",
    "depth",
    "dilated",
    "label",
    "largest",
    "ndimage",
    "opened",
    "reached",
    "resampled_to",
    "simpleitk",
    "sizes_of",
    "smoothed",
    "watershed",
]

Mask = NDArray[np.bool_]
Volume = NDArray[np.float32]


def simpleitk() -> Any:
    """The package SimpleITK."""
    return _package("SimpleITK")


def ndimage() -> Any:
    """The package scipy.ndimage."""
    return _package("scipy.ndimage")


def _package(name: str) -> Any:
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        raise ImageError(
            f"CTs are segmented with {name}, which is missing: pip install 'cmfsim[imaging]'"
        ) from error


def watershed(height: Volume, seeds: NDArray[Any], mask: Mask) -> NDArray[Any]:
    """The seed whose flood reaches each voxel of the mask first, rising over the height."""
    flood = _package("skimage.segmentation").watershed
    basins: NDArray[Any] = flood(height.T, seeds.T, mask=mask.T).T
    return basins


def as_itk(array: NDArray[Any], spacing: NDArray[np.float64]) -> Any:
    """An ITK image of an array, its first voxel at the origin."""
    values = array.view(np.uint8) if array.dtype == bool else array
    image = simpleitk().GetImageFromArray(values.T)
    image.SetSpacing([float(s) for s in spacing])
    return image


def as_array(image: Any) -> NDArray[Any]:
    """The voxels of an ITK image with axes x, y, z, in Fortran order."""
    voxels: NDArray[Any] = simpleitk().GetArrayFromImage(image)
    return voxels.T


def depth(mask: Mask, spacing: NDArray[np.float64]) -> Volume:
    """The distance to the surface, mm: positive inside the mask, negative outside.

    The surface runs half way between voxels of the mask and others, so no value is 0.
    """
    if mask.all() or not mask.any():
        far = np.float32(np.linalg.norm(np.array(mask.shape) * spacing))
        return np.full(mask.shape, far if mask.any() else -far, dtype=np.float32, order="F")
    itk = simpleitk()
    image = itk.SignedMaurerDistanceMap(
        as_itk(mask, spacing), insideIsPositive=True, squaredDistance=False, useImageSpacing=True
    )
    distance = as_array(image)
    # ITK measures from the voxels of the mask's rim, which lie half a voxel inside.
    distance += np.float32(0.5 * spacing.min())
    return distance


def _padded(mask: Mask, radius: float, spacing: NDArray[np.float64]) -> tuple[Mask, Any]:
    """The mask continued past its borders, and the place of the mask in it."""
    steps = [int(np.ceil(radius / s)) + 1 for s in spacing]
    inner = tuple(slice(n, n + m) for n, m in zip(steps, mask.shape, strict=True))
    return np.asfortranarray(np.pad(mask, [(n, n) for n in steps], mode="edge")), inner


def opened(mask: Mask, radius: float, spacing: NDArray[np.float64]) -> Mask:
    """What balls of a radius (mm) can sweep inside the mask, as if it went on past the border."""
    wide, inner = _padded(mask, radius, spacing)
    core = depth(wide, spacing) > radius
    if not core.any():
        return np.zeros_like(mask)
    return np.asfortranarray((depth(core, spacing) > -radius)[inner]) & mask


def closed(mask: Mask, radius: float, spacing: NDArray[np.float64]) -> Mask:
    """The mask with what balls of a radius (mm) cannot reach from outside."""
    wide, inner = _padded(mask, radius, spacing)
    grown = depth(wide, spacing) > -radius
    return np.asfortranarray((depth(grown, spacing) > radius)[inner]) | mask


def dilated(mask: Mask, radius: float, spacing: NDArray[np.float64]) -> Mask:
    """The voxels less than a radius (mm) from the mask."""
    return depth(mask, spacing) > -radius


def label(mask: Mask, *, corners: bool = False) -> tuple[NDArray[np.int32], int]:
    """Connected pieces numbered from 1, and how many; joined over faces, or corners too."""
    scipy = ndimage()
    structure = scipy.generate_binary_structure(3, 3) if corners else None
    # scipy walks C order: the transposed view has it.
    labels = np.empty(mask.T.shape, dtype=np.int32)
    count = scipy.label(mask.T, structure, output=labels)
    return labels.T, int(count)


def sizes_of(labels: NDArray[np.int32], count: int) -> NDArray[np.intp]:
    """How many voxels each label has; that of 0 is given as 0."""
    sizes = np.bincount(labels.ravel(order="K"), minlength=count + 1)
    sizes[0] = 0
    return sizes


def largest(mask: Mask) -> Mask:
    """The largest connected piece."""
    labels, count = label(mask)
    if count <= 1:
        return mask
    piece: Mask = labels == np.argmax(sizes_of(labels, count))
    return piece


def reached(mask: Mask, seeds: Mask) -> Mask:
    """The connected pieces of the mask that hold a seed."""
    labels, count = label(mask)
    hit = np.zeros(count + 1, dtype=bool)
    hit[labels[seeds & mask]] = True
    hit[0] = False
    pieces: Mask = hit[labels]
    return pieces


def smoothed(
    values: NDArray[Any], sigma: float, spacing: NDArray[np.float64] | None = None
) -> Volume:
    """Values after a Gaussian of sigma mm (voxels where no spacing is given)."""
    itk = simpleitk()
    steps = np.ones(3) if spacing is None else spacing
    image = itk.Cast(as_itk(values, steps), itk.sitkFloat32)
    smooth: Volume = as_array(itk.SmoothingRecursiveGaussian(image, float(sigma)))
    return smooth


def binned(
    values: NDArray[Any], factors: tuple[int, ...], spacing: NDArray[np.float64]
) -> tuple[NDArray[Any], NDArray[np.float64], NDArray[np.float64]]:
    """Means over blocks of voxels, their spacing and the shift of the first centre, mm."""
    if max(factors) == 1:
        return values, spacing, np.zeros(3)
    blocks = [min(int(f), n) for f, n in zip(factors, values.shape, strict=True)]
    image = simpleitk().BinShrink(as_itk(values, spacing), blocks)
    shift = np.array(image.GetOrigin())
    return as_array(image), spacing * np.array(blocks), shift


def resampled_to(
    values: NDArray[Any],
    spacing: NDArray[np.float64],
    shift: NDArray[np.float64],
    shape: tuple[int, ...],
    target: NDArray[np.float64],
) -> Volume:
    """Linear interpolation on another grid, border values continued.

    `spacing` and `shift` are the values' voxel size and first centre, as seen from the first centre
    of the new grid, which has the voxel size `target`; all mm.
    """
    itk = simpleitk()
    image = as_itk(values, spacing)
    image.SetOrigin([float(s) for s in shift])
    resampler = itk.ResampleImageFilter()
    resampler.SetSize([int(n) for n in shape])
    resampler.SetOutputSpacing([float(s) for s in target])
    resampler.SetOutputOrigin([0.0, 0.0, 0.0])
    resampler.SetInterpolator(itk.sitkLinear)
    resampler.UseNearestNeighborExtrapolatorOn()
    resampler.SetOutputPixelType(itk.sitkFloat32)
    fine: Volume = as_array(resampler.Execute(image))
    return fine
