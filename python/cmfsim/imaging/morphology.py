"""Distances, growing and shrinking of masks in mm, over the core, SimpleITK and scipy.

Arrays have axes x, y, z and Fortran order, which is the order of ITK's memory: both sides then see
the same bytes, and element-wise work runs straight through memory.
"""

from collections.abc import Callable
from functools import lru_cache
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim import _core
from cmfsim.errors import ImageError, third_party
from cmfsim.values.shown_region import ShownRegion
from cmfsim.values.surface_data import triangle_areas

Mask = NDArray[np.bool_]
Volume = NDArray[np.float32]
Block = tuple[slice, ...]


def simpleitk() -> Any:
    """The package SimpleITK."""
    return _package("SimpleITK")


def ndimage() -> Any:
    """The package scipy.ndimage."""
    return _package("scipy.ndimage")


def load() -> None:
    """Loads what segmentation needs last, which takes half a second."""
    ndimage()
    simpleitk()
    _package("scipy.optimize")
    _package("skimage.segmentation").watershed  # noqa: B018 (loaded when it is first asked for)


def sparse() -> Any:
    """The package scipy.sparse."""
    return _package("scipy.sparse")


def _package(name: str) -> Any:
    return third_party(name, "CTs are segmented", "imaging", ImageError)


def watershed(height: Volume, seeds: NDArray[Any], mask: Mask) -> NDArray[Any]:
    """The seed whose flood reaches each voxel of the mask first, rising over the height."""
    flood = _package("skimage.segmentation").watershed
    basins = np.zeros(mask.shape, dtype=seeds.dtype, order="F")
    box = box_of(mask, 1)
    height, seeds, mask = height[box], seeds[box], mask[box]
    # Floods start at the rims of seeds: those inside them would only lengthen the queue.
    sown = seeds != 0
    enclosed = sown.copy(order="K")
    for axis in range(3):
        along, out = np.moveaxis(seeds, axis, 0), np.moveaxis(enclosed, axis, 0)
        out[1:] &= along[1:] == along[:-1]
        out[:-1] &= along[:-1] == along[1:]
    flooded = flood(height.T, seeds.T, mask=(mask & ~enclosed).T).T
    basins[box] = np.where(enclosed & mask, seeds, flooded)
    return basins


def simplex(
    cost: Callable[[NDArray[np.float64]], float],
    start: NDArray[np.float64],
    steps: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Where a function of few numbers is least, by Nelder and Mead's simplex (1965)."""
    corners = np.vstack([start, start + np.diag(steps)])
    options = {"initial_simplex": corners, "maxiter": 200, "xatol": 1e-3, "fatol": 1e-4}
    minimize = _package("scipy.optimize").minimize
    least: NDArray[np.float64] = minimize(cost, start, method="Nelder-Mead", options=options).x
    return least


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


def distance(targets: Mask, spacing: NDArray[np.float64], within: float = np.inf) -> Volume:
    """The distance of each voxel's centre to the nearest target's, mm.

    Infinite without targets, and where it exceeds `within`, which costs less.
    """
    # The core walks C order: the transposed view has it.
    x, y, z = (float(s) for s in spacing)
    apart: Volume = _core.distance_image(targets.T, (z, y, x), within=within).T
    return apart


def depth(mask: Mask, spacing: NDArray[np.float64], within: float = np.inf) -> Volume:
    """The distance to the surface, mm: positive inside the mask, negative outside.

    The surface runs half way between voxels of the mask and others, so no value is 0. Sizes above
    `within` may be given as infinite.
    """
    if mask.all() or not mask.any():
        far = np.float32(np.linalg.norm(np.array(mask.shape) * spacing))
        return np.full(mask.shape, far if mask.any() else -far, dtype=np.float32, order="F")
    # Both sides are measured from the voxels of the mask's rim, which lie half a voxel inside.
    half = 0.5 * float(spacing.min())
    to_rim = distance(mask & ~shrunk(mask), spacing, within + half)
    np.negative(to_rim, out=to_rim, where=~mask)
    to_rim += np.float32(half)
    return to_rim


def box_of(mask: Mask, margin: int = 0) -> Block:
    """The smallest block that holds the mask, and a margin of voxels where the array has them."""
    box = []
    columns, sheet = np.any(mask, axis=0), np.any(mask, axis=2)
    lines = (sheet.any(axis=1), columns.any(axis=1), columns.any(axis=0))
    for axis, line in enumerate(lines):
        found = np.flatnonzero(line)
        if not len(found):
            return (slice(0, 0),) * 3
        low, high = int(found[0]) - margin, int(found[-1]) + 1 + margin
        box.append(slice(max(low, 0), min(high, mask.shape[axis])))
    return tuple(box)


def _padded(mask: Mask, radius: float, spacing: NDArray[np.float64]) -> tuple[Mask, Any]:
    """The mask continued past its borders, and the place of the mask in it."""
    steps = [int(np.ceil(radius / s)) + 1 for s in spacing]
    inner = tuple(slice(n, n + m) for n, m in zip(steps, mask.shape, strict=True))
    return np.asfortranarray(np.pad(mask, [(n, n) for n in steps], mode="edge")), inner


def opened(mask: Mask, radius: float, spacing: NDArray[np.float64]) -> Mask:
    """What balls of a radius (mm) can sweep inside the mask, as if it went on past the border."""
    swept = np.zeros_like(mask)
    box = box_of(mask, 1)
    part = mask[box]
    if not part.size:
        return swept
    wide, inner = _padded(part, radius, spacing)
    core = depth(wide, spacing, radius) > radius
    if core.any():
        reach = radius + 0.5 * float(spacing.min())
        near = distance(core, spacing, reach) < reach
        swept[box] = near[inner] & part
    return swept


def closed(mask: Mask, radius: float, spacing: NDArray[np.float64]) -> Mask:
    """The mask with what balls of a radius (mm) cannot reach from outside."""
    filled = mask.copy(order="F")
    # Nothing that a ball cannot reach lies outside the box.
    box = box_of(mask, 1)
    part = mask[box]
    if not part.size:
        return filled
    wide, inner = _padded(part, radius, spacing)
    reach = radius + 0.5 * float(spacing.min())
    swollen = distance(wide, spacing, reach) < reach
    filled[box] |= (depth(swollen, spacing, radius) > radius)[inner]
    return filled


def shrunk(mask: Mask) -> Mask:
    """The voxels all of whose 26 neighbours are in the mask; beyond the border it goes on."""
    kept = mask
    for axis in range(3):
        along = np.moveaxis(kept, axis, 0)
        kept = kept.copy(order="K")
        out = np.moveaxis(kept, axis, 0)
        out[1:] &= along[:-1]
        out[:-1] &= along[1:]
    return kept


def grown(mask: Mask) -> Mask:
    """The mask and the voxels that share a face with it."""
    wide = mask.copy(order="K")
    for axis in range(3):
        along, out = np.moveaxis(mask, axis, 0), np.moveaxis(wide, axis, 0)
        out[1:] |= along[:-1]
        out[:-1] |= along[1:]
    return wide


def widened_by(mask: Mask, voxels: int) -> Mask:
    """The mask and all within so many voxels along every axis."""
    # Axis after axis, which costs the same for any number of voxels.
    highest = ndimage().maximum_filter(mask.view(np.uint8), size=2 * voxels + 1)
    wide: Mask = highest.view(bool)
    return wide


def label(mask: Mask, *, corners: bool = False) -> tuple[NDArray[np.int32], NDArray[np.intp]]:
    """Connected pieces numbered from 1, and how many voxels each has, that of 0 given as 0.

    They are joined over faces, or over corners too.
    """
    if not mask.size:
        return np.zeros(mask.shape, dtype=np.int32), np.zeros(1, dtype=np.intp)
    # The core walks C order: the transposed view has it.
    labels, sizes = _core.label_image(mask.T, corners=corners)
    return labels.T, sizes


def chosen(wanted: Mask, labels: NDArray[np.int32]) -> Mask:
    """The voxels whose label is wanted; `wanted` has an entry for each label."""
    voxels = np.empty(labels.T.shape, dtype=bool)
    # A layer at a time stays in the cache; every label has its entry, so that none is clipped.
    for layer, found in zip(labels.T, voxels, strict=True):
        np.take(wanted, layer, out=found, mode="clip")
    return voxels.T


def largest(mask: Mask) -> Mask:
    """The largest connected piece."""
    labels, sizes = label(mask)
    if len(sizes) <= 2:
        return mask
    piece: Mask = labels == np.argmax(sizes)
    return piece


def reached(mask: Mask, seeds: Mask) -> Mask:
    """The connected pieces of the mask that hold a seed."""
    labels, sizes = label(mask)
    hit = np.zeros(len(sizes), dtype=bool)
    hit[labels.T[(seeds & mask).T]] = True
    hit[0] = False
    return chosen(hit, labels)


def filled(mask: Mask) -> Mask:
    """The mask with every hollow that does not reach the front, back or sides of the image.

    The bottom and the top are no way out: trachea and neck are cut there.
    """
    labels, sizes = label(~mask)
    outside = np.zeros(len(sizes), dtype=bool)
    for face in (labels[0], labels[-1], labels[:, 0], labels[:, -1]):
        outside[np.unique(face)] = True
    outside[0] = False
    return ~chosen(outside, labels)


def smoothed(
    values: NDArray[Any], sigma: float, spacing: NDArray[np.float64] | None = None
) -> Volume:
    """Values after a Gaussian of sigma mm (voxels where no spacing is given)."""
    itk = simpleitk()
    steps = np.ones(3) if spacing is None else spacing
    image = as_itk(values.astype(np.float32, copy=False), steps)
    smooth: Volume = as_array(itk.SmoothingRecursiveGaussian(image, float(sigma)))
    return smooth


def binned(
    values: NDArray[Any], factors: tuple[int, ...], spacing: NDArray[np.float64]
) -> tuple[NDArray[Any], NDArray[np.float64], NDArray[np.float64]]:
    """Means over blocks of voxels, their spacing and the shift of the first centre, mm."""
    if max(factors) == 1:
        return values, spacing, np.zeros(3)
    blocks = np.minimum(factors, values.shape)
    nx, ny, nz = values.shape // blocks
    x, y, z = blocks.tolist()
    means = np.empty((nx, ny, nz), dtype=values.dtype, order="F")
    # A layer at a time stays in the cache; summed and rounded in the order of ITK's filter.
    for k in range(nz):
        total = np.zeros((ny, nx))
        for layer in values.T[z * k : z * (k + 1), : ny * y, : nx * x]:
            for row, column in product(range(y), range(x)):
                total += layer[row::y, column::x]
        total *= 1.0 / (x * y * z)
        means[:, :, k] = (total if values.dtype.kind == "f" else np.floor(total + 0.5)).T
    return means, spacing * blocks, 0.5 * (blocks - 1) * spacing


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
    # Places and values have the bits of ITK's filter: along x, places are shares of a line.
    places = [
        (h * np.arange(n) - first) * (1.0 / step)
        for h, n, first, step in zip(target, shape, shift, spacing, strict=True)
    ]
    start, end = (np.array([0.0, shape[0] * target[0]]) - shift[0]) * (1.0 / spacing[0])
    places[0] = start + np.arange(shape[0]) / shape[0] * (end - start)
    inside = [np.clip(p, 0.0, n - 1.0) for p, n in zip(places, values.shape, strict=True)]
    low = [p.astype(np.intp) for p in inside]
    high = [np.minimum(k + 1, n - 1) for k, n in zip(low, values.shape, strict=True)]
    x, y, z = (p - k for p, k in zip(inside, low, strict=True))

    @lru_cache(maxsize=2)
    def layer(k: int) -> NDArray[np.float64]:
        plane = values[:, :, k].T.astype(np.float64)
        rows = plane[:, low[0]] + (plane[:, high[0]] - plane[:, low[0]]) * x
        found: NDArray[np.float64] = rows[low[1]] + (rows[high[1]] - rows[low[1]]) * y[:, None]
        return found

    fine = np.empty(shape, dtype=np.float32, order="F")
    # A layer at a time stays in the cache.
    for k, (below, above) in enumerate(zip(low[2].tolist(), high[2].tolist(), strict=True)):
        fine[:, :, k] = (layer(below) + (layer(above) - layer(below)) * z[k]).T
    # More than half a voxel beyond the first or last centre along any axis, the nearest one counts.
    nearest = [np.floor(p + 0.5).astype(np.intp) for p in inside]
    for axis, (place, n) in enumerate(zip(places, values.shape, strict=True)):
        beyond = np.flatnonzero((place < -0.5) | (place >= n - 0.5))
        if len(beyond):
            own = [beyond if a == axis else np.arange(m) for a, m in enumerate(shape)]
            taken = [near[k] for near, k in zip(nearest, own, strict=True)]
            fine[np.ix_(*own)] = values[np.ix_(*taken)]
    return fine


# Less of an image than this is no padding, and less of what it shows has the padding's value by
# chance.
LEAST_PADDING = 0.03
# Voxels that are looked at to tell padding from air.
SAMPLES = 200_000
# What an image shows has the padding's value neither farther from its border than this nor in the
# layer as wide behind, voxels: air would lie there beside a head.
RIM = 2.0
# Planes of its border are turned so far from one another at least; one that needs more of them than
# boxes and cylinders have is a head in even air.
LEAST_TURN, MOST_PLANES = np.deg2rad(4.0), 200


def shown_region(values: NDArray[Any]) -> ShownRegion | None:
    """The part of an image that padding of one value surrounds, in voxels; None without padding.

    Scanners pad a round field of view, and programs an image that they turn, shear or widen. Every
    such part is convex, and its voxels differ from the padding also along its border.
    """
    corners = values[tuple(np.ix_(*[[0, -1]] * 3))].ravel()
    value = max(corners, key=lambda corner: np.count_nonzero(corners == corner))
    step = max(1, int(np.cbrt(values.size / SAMPLES)))
    padded = values[::step, ::step, ::step] == value
    if not LEAST_PADDING <= padded.mean() <= 1.0 - LEAST_PADDING:
        return None
    ends = np.unique(
        np.vstack([_line_ends(values, value, axis, step) for axis in range(3)]), axis=0
    )
    if np.linalg.matrix_rank(ends - ends[0]) < 3:
        return None
    hull = third_party("scipy.spatial", "images are segmented", "imaging", ImageError)
    hull = hull.ConvexHull(ends)
    sizes = triangle_areas(ends, hull.simplices)
    facing = hull.equations[np.argsort(-sizes, kind="stable"), :3]
    kept: list[NDArray[np.float64]] = []
    while len(facing):
        if len(kept) == MOST_PLANES:
            return None
        kept.append(facing[0])
        facing = facing[facing @ facing[0] < np.cos(LEAST_TURN)]
    normals = np.array(kept)
    region = ShownRegion(normals, np.max(ends[hull.vertices] @ normals.T, axis=0))
    places = step * np.argwhere(np.ones(padded.shape, dtype=bool)).astype(np.float64)
    depth = region.depth(places).reshape(padded.shape)
    odd = max(padded[depth > RIM].mean(), padded[(depth > RIM) & (depth < 2.0 * RIM)].mean())
    return region if odd < LEAST_PADDING else None


def _line_ends(values: NDArray[Any], value: Any, axis: int, step: int) -> NDArray[np.float64]:
    """The first and the last voxel (n, 3) that is not padding of some lines along an axis."""
    shown = np.moveaxis(values, axis, 0)[:, ::step, ::step] != value
    across = np.argwhere(shown.any(axis=0))
    lines = shown[:, across[:, 0], across[:, 1]]
    ends = (lines.argmax(axis=0), len(lines) - 1 - lines[::-1].argmax(axis=0))
    places = (step * across).astype(np.float64)
    return np.vstack([np.insert(places, axis, end, axis=1) for end in ends])


def padding(values: NDArray[Any], region: ShownRegion) -> Mask:
    """The voxels of what surrounds a region: of its value, and joined to the image's border."""
    outside = np.argwhere(np.ones((2, 2, 2))) * (np.array(values.shape) - 1)
    corner = tuple(outside[np.argmin(region.depth(outside.astype(np.float64)))])
    mask = values == values[corner]
    border = np.ones(mask.shape, dtype=bool)
    border[1:-1, 1:-1, 1:-1] = False
    return reached(mask, border)
