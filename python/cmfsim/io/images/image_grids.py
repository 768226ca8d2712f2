"""Voxels brought from the grid of their file to one along the patient's axes, LPS."""

import math
from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import ImageError, ImageInputError, third_party
from cmfsim.io.images.image_headers import MOST_VOXELS
from cmfsim.values.finding import Finding
from cmfsim.values.image_data import ImageData

Floats: TypeAlias = NDArray[np.float64]

# An axis farther than this from a patient's axis (as a sine), or from a right angle with another,
# is resampled: 0.06 degrees, which is 0.25 mm over a head.
OBLIQUE = 1e-3
# Outside a rotated image there is air, HU; images without negative values get their least.
OUTSIDE = -1024.0
# Slices farther apart than this are divided when they are resampled, mm: one interpolation between
# them, at the places that the working grid will have, in place of two.
FINE = 1.0
# The two neighbours on either side of a place, from the one just before it.
SIDES = (-1, 0, 1, 2)
# A place this near to a voxel's centre, in voxels, is that voxel.
SAME = 1e-6
# Axes farther from a right angle than this are reported as sheared, degrees.
SHEARED = 0.06


def on_axes(
    values: NDArray[Any], affine: Floats, name: str
) -> tuple[ImageData, tuple[Finding, ...]]:
    """The image of voxels with their map to LPS, on axes of the patient; a finding if resampled."""
    image = aligned(values, affine)
    if image is not None:
        return image, ()
    image, shear = upright(values, affine, name), shear_of(affine)
    if shear <= SHEARED:
        what = f"the image's axes are turned by {turn_of(affine):.1f}° from the patient's; it was "
        what += "resampled"
        return image, (Finding("image-oblique", what, severity="note", where=name),)
    what = (
        f"the image's axes are {shear:.1f}° from right angles, as in a CT with a tilted gantry; it "
        "was resampled by its stated axes"
    )
    why = "a program that assumes perpendicular axes would show the head sheared"
    fix = "compare the skin with the scan visually"
    found = Finding("image-oblique", what, severity="warning", where=name, why=why, fix=fix)
    return image, (found,)


def aligned(values: NDArray[Any], affine: NDArray[np.float64]) -> ImageData | None:
    """Voxels whose axes run along the patient's, in their order and direction; None if obliquely.

    values: (n, m, k) array. values[i, j, k] lies at affine · (i, j, k, 1), (3, 4) mm.
    """
    directions = affine[:, :3] / np.linalg.norm(affine[:, :3], axis=0)
    order = np.argmax(np.abs(directions), axis=1)
    if len(set(order.tolist())) < 3:
        return None
    turned = directions[:, order]
    signs = np.sign(np.diag(turned))
    if float(np.abs(turned - np.diag(signs)).max()) > OBLIQUE:
        return None
    first = np.where(signs[np.argsort(order)] < 0.0, np.array(values.shape) - 1, 0)
    origin = affine @ np.append(first, 1.0)
    flips = tuple(slice(None, None, -1 if s < 0.0 else 1) for s in signs)
    spacing = np.linalg.norm(affine[:, :3], axis=0)[order]
    return ImageData(np.transpose(values, order)[flips], spacing, origin)


def turn_of(affine: NDArray[np.float64]) -> float:
    """The angle between the image's axes and the patient's, degrees: of the least turn."""
    directions = affine[:, :3] / np.linalg.norm(affine[:, :3], axis=0)
    u, _, v = np.linalg.svd(directions)
    rotation = u @ v
    order = np.argmax(np.abs(rotation), axis=1)
    if len(set(order.tolist())) < 3:
        order = np.arange(3)
    turned = rotation[:, order]
    turned = turned * np.sign(np.diag(turned))
    # The axial vector has the sine, the trace the cosine: exact for small angles and large ones.
    sine = 0.5 * math.sqrt(
        (turned[2, 1] - turned[1, 2]) ** 2
        + (turned[0, 2] - turned[2, 0]) ** 2
        + (turned[1, 0] - turned[0, 1]) ** 2
    )
    return math.degrees(math.atan2(sine, 0.5 * (float(np.trace(turned)) - 1.0)))


def shear_of(affine: NDArray[np.float64]) -> float:
    """The largest departure of two axes from a right angle, degrees."""
    largest = 0.0
    for a, b in ((0, 1), (0, 2), (1, 2)):
        one, other = affine[:, a], affine[:, b]
        across = float(np.linalg.norm(np.cross(one, other)))
        largest = max(largest, math.atan2(abs(float(one @ other)), across))
    return math.degrees(largest)


def upright(values: NDArray[Any], affine: NDArray[np.float64], name: str) -> ImageData:
    """Voxels on oblique or sheared axes, linearly on the least grid in LPS that holds them."""
    itk = third_party("SimpleITK", "oblique images are resampled", "imaging", ImageError)
    image = itk.GetImageFromArray(values.T)
    last = np.array(values.shape) - 1.0
    corners = np.array(
        [affine @ [*(last * [(c >> a) & 1 for a in range(3)]), 1.0] for c in range(8)]
    )
    lengths = np.linalg.norm(affine[:, :3], axis=0)
    # Each new axis takes the spacing of the old axis nearest to it.
    spacing = lengths[np.argmax(np.abs(affine[:, :3] / lengths), axis=1)]
    low, count = _grid(corners, spacing, name)
    back = np.linalg.inv(affine[:, :3])
    to_index = itk.AffineTransform(3)
    to_index.SetMatrix(back.ravel().tolist())
    to_index.SetTranslation((-back @ affine[:, 3]).tolist())
    resampler = itk.ResampleImageFilter()
    resampler.SetSize([int(n) for n in count])
    resampler.SetOutputSpacing([float(s) for s in spacing])
    resampler.SetOutputOrigin([float(o) for o in low])
    resampler.SetTransform(to_index)
    resampler.SetInterpolator(itk.sitkLinear)
    resampler.SetDefaultPixelValue(_outside(values))
    if values.dtype.kind in "iu":
        # ITK would cut whole numbers off, not round them.
        resampler.SetOutputPixelType(itk.sitkFloat32)
    made = itk.GetArrayFromImage(resampler.Execute(image)).T
    if values.dtype.kind in "iu":
        made = np.rint(made, out=made).astype(values.dtype)
    return ImageData(made, spacing, low)


def of_slices(
    values: NDArray[Any],
    positions: NDArray[np.float64],
    axes: NDArray[np.float64],
    spacing: tuple[float, float],
    name: str,
) -> ImageData:
    """Parallel slices, each at its own place, on a grid in LPS that holds them all.

    Between two slices the value is interpolated along their normal, from both and the two beyond at
    that place; so slices along the patient's axes keep their values wherever the grid meets their
    pixels. It is cubic (E. Catmull and R. Rom, 1974), also within slices whose rows run along the
    patient's first axis, as a gantry tilts them; and limited to what lies between the nearest
    pixels, so that nothing rings at bone, metal and air. Next to the first and the last slice, and
    where one of the four does not hold the place, it is linear between slices.

    positions: (slices, 3), mm, of the first pixel of each slice, ascending along the normal.
    axes: (2, 3). Unit vectors along a row (from column to column) and along a column.
    spacing: mm, between columns and between rows.
    """
    values, positions, axes = _rows_to_left(values, positions, axes, spacing[0])
    along_row, along_column = axes
    normal = np.cross(along_row, along_column)
    heights = positions @ normal
    ends = np.array([values.shape[2] - 1.0, values.shape[1] - 1.0]) * spacing
    corners = np.concatenate(
        [positions + a * ends[0] * along_row + b * ends[1] * along_column
         for a in (0, 1) for b in (0, 1)]
    )  # fmt: skip
    gap = float(np.median(np.diff(heights)))
    steps = np.array([*spacing, gap / math.ceil(gap / max(FINE, *spacing) - SAME)])
    nearest = np.argmax(np.abs(np.array([along_row, along_column, normal])), axis=0)
    low, count = _grid(corners, steps[nearest], name)
    grid = steps[nearest]
    x, y, z = (low[a] + grid[a] * np.arange(count[a]) for a in range(3))
    outside, slack = _outside(values), SAME * gap
    made = np.empty((count[2], count[1], count[0]), dtype=values.dtype)
    starts = positions @ np.array([along_row, along_column]).T
    # Slices that do not exist, so that every slice has a neighbour; nothing is read of them.
    ends = np.concatenate([[heights[0] - gap], heights, [heights[-1] + gap]])
    # Rows along the patient's first axis, as a gantry tilts: the grid has their pixels.
    by_rows = float(np.abs(along_row - [1.0, 0.0, 0.0]).max()) <= SAME
    by_rows &= float(np.ptp(starts[:, 0])) <= SAME * spacing[0]
    vectors = (along_row, along_column, normal)
    plane = [y * v[1] if by_rows else np.add.outer(y * v[1], x * v[0]) for v in vectors]
    for number, height in enumerate(z):
        across, down, up = (p + v[2] * height for p, v in zip(plane, vectors, strict=True))
        place = np.interp(up, heights, np.arange(len(heights)))
        below, part = _between(place, len(heights) - 2)
        slices = [np.clip(below + side, 0, len(heights) - 1) for side in SIDES]
        v = [(down - starts[k, 1]) / spacing[1] for k in slices]
        gaps = [ends[below + side + 1] - ends[below + side] for side in range(3)]
        weights = _cubic(part, gaps[0] / gaps[1], gaps[2] / gaps[1])
        if by_rows:
            inside = [(w > -SAME) & (w < values.shape[1] - 1 + SAME) for w in v]
        else:
            u = [(across - starts[k, 0]) / spacing[0] for k in slices]
            inside = [_is_in_slice(values, *w) for w in zip(u, v, strict=True)]
        four = np.logical_and.reduce([*inside, below > 0, below < len(heights) - 2])
        straight = [0.0 * part, 1.0 - part, part, 0.0 * part]
        weights = [np.where(four, c, w) for c, w in zip(weights, straight, strict=True)]
        if by_rows:
            layer = _from_rows(values, slices, v, weights, inside, outside=outside)
        else:
            found = [
                np.where(i, _in_slice(values, k, a, b), outside)
                for i, k, a, b in zip(inside, slices, u, v, strict=True)
            ]
            total = np.sum([w * f for w, f in zip(weights, found, strict=True)], axis=0)
            layer = _limited(total, found[1:3])
        layer[(up < heights[0] - slack) | (up > heights[-1] + slack)] = outside
        made[number] = np.rint(layer) if values.dtype.kind in "iu" else layer
    return ImageData(made.T, grid, low)


def _between(place: Floats, last: int) -> tuple[NDArray[np.intp], Floats]:
    """The slice below each place, at most the one given, and how far it is to the next, 0 to 1."""
    below = np.minimum(place.astype(np.intp), last)
    part = place - below
    # A slice that the place belongs to wholly decides alone.
    return below, np.where(part <= SAME, 0.0, np.where(part >= 1.0 - SAME, 1.0, part))


def _rows_to_left(
    values: NDArray[Any], positions: Floats, axes: Floats, spacing: float
) -> tuple[NDArray[Any], Floats, Floats]:
    """The same slices with rows that run to the patient's left, in ascending order again."""
    if axes[0, 0] >= 0.0:
        return values, positions, axes
    last = (values.shape[2] - 1) * spacing * axes[0]
    turned = np.array([-axes[0], axes[1]])
    return np.ascontiguousarray(values[::-1, :, ::-1]), (positions + last)[::-1], turned


def _cubic(part: Floats, before: Floats | float = 1.0, after: Floats | float = 1.0) -> list[Floats]:
    """Weights of four values at a part of the way from the second to the third.

    Hermite's cubic with the slopes of parabolas through three neighbours; `before` and `after` are
    the distances from the first to the second and from the third to the fourth, over that of the
    second from the third. Equal distances make it Catmull and Rom's.
    """
    rest = 1.0 - part
    start, end, third = part * rest**2, -(part**2) * rest, part**2 * (3.0 - 2.0 * part)
    first, fourth = -1.0 / (before * (1.0 + before)), 1.0 / (after * (1.0 + after))
    ahead, behind = before / (1.0 + before), -after / (1.0 + after)
    return [
        start * first,
        1.0 - third - start * (first + ahead) + end * behind,
        third + start * ahead - end * (behind + fourth),
        end * fourth,
    ]


def _limited(total: Floats, nearest: Sequence[NDArray[Any]]) -> Floats:
    """Interpolated values, no farther than the nearest that they lie between."""
    low, high = np.minimum.reduce(nearest), np.maximum.reduce(nearest)
    return np.clip(total, low, high, out=total)


def _from_rows(
    values: NDArray[Any],
    slices: Sequence[NDArray[np.intp]],
    v: Sequence[Floats],
    weights: Sequence[Floats],
    inside: Sequence[NDArray[np.bool_]],
    *,
    outside: float,
) -> Floats:
    """Whole rows, each of four rows (at v) of four slices; the value outside beyond a border."""
    rows = values.shape[1]
    # Single precision holds pixels of 16 bits, and takes half the time.
    real = np.float32 if values.dtype.itemsize <= 2 else np.float64
    total, nearest = np.zeros((len(v[0]), values.shape[2]), dtype=real), []
    for side, k, w, weight, there in zip(SIDES, slices, v, weights, inside, strict=True):
        if not weight.any():
            continue
        place = np.clip(w, 0.0, rows - 1.0)
        j = np.minimum(place.astype(np.intp), max(rows - 2, 0))
        for a, part in zip(SIDES, _cubic(place - j), strict=True):
            row = values[k, np.clip(j + a, 0, rows - 1)]
            row[~there] = outside
            total += np.multiply(row, (weight * part)[:, None], dtype=real, casting="same_kind")
            if side in {0, 1} and a in {0, 1}:
                nearest.append(row)
    return _limited(total, nearest)


def _is_in_slice(values: NDArray[Any], u: Floats, v: Floats) -> NDArray[np.bool_]:
    rows, columns = values.shape[1:]
    inside: NDArray[np.bool_] = (
        (u > -SAME) & (u < columns - 1 + SAME) & (v > -SAME) & (v < rows - 1 + SAME)
    )
    return inside


def _in_slice(values: NDArray[Any], k: NDArray[np.intp], u: Floats, v: Floats) -> Floats:
    """Bilinear values at column u and row v of slice k."""
    rows, columns = values.shape[1:]
    u, v = np.clip(u, 0.0, columns - 1.0), np.clip(v, 0.0, rows - 1.0)
    i = np.minimum(u.astype(np.intp), max(columns - 2, 0))
    j = np.minimum(v.astype(np.intp), max(rows - 2, 0))
    u, v = u - i, v - j
    flat = values.reshape(-1)
    first = (k * rows + j) * columns + i
    upper = flat[first] * (1.0 - u) + flat[first + 1] * u
    lower = flat[first + columns] * (1.0 - u) + flat[first + columns + 1] * u
    found: Floats = upper * (1.0 - v) + lower * v
    return found


def _grid(corners: Floats, spacing: Floats, name: str) -> tuple[Floats, NDArray[np.int64]]:
    """First place and number of voxels of the grid that holds the corners."""
    low, high = corners.min(axis=0), corners.max(axis=0)
    count = np.ceil((high - low) / spacing - SAME).astype(np.int64) + 1
    if math.prod(count.tolist()) > MOST_VOXELS:
        raise ImageInputError(
            f"{name}: on the patient's axes it would need {' × '.join(map(str, count))} voxels: "
            f"at most {MOST_VOXELS} are read"
        )
    return low, count


def _outside(values: NDArray[Any]) -> float:
    return max(float(values.min()), OUTSIDE)
