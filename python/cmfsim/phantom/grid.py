"""Levels on grids and as triangles, and what a scanner makes of them."""

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError
from cmfsim.phantom.shapes import Level
from cmfsim.values.checks import Floats
from cmfsim.values.surface_data import SurfaceData

Field = Callable[[Level, Level, Level], Level]

# Voxels along each edge of a brick: large ones are skipped whole, small ones fit the cache.
BRICK, SMALL_BRICK = 48, 24
# No level of the phantom changes faster than this per mm, over the length of a brick.
STEEPEST = 1.5
# Step of the central difference, mm: its error is the curvature times 1e-6.
DIFFERENCE = 1e-3
# A smaller gradient than this is a crease, where Newton's step would be too long.
LEAST_SLOPE = 0.2
# Vertices are projected cell by cell of this size, mm, so that few shapes matter to each.
CELL = 72.0
# Marching cubes keep vertices this far from grid points, as a share of the spacing.
NEAREST = 0.05
# A projected point counts as on the surface below this level, mm.
ON_SURFACE = 1e-6


def level_grid(field: Field, axes: Sequence[Floats], clip: float) -> NDArray[np.float32]:
    """The level at the points of a grid, clipped to ±clip, float32.

    A brick whose middle lies deeper in or further out than the level can change within the brick
    takes the clipped value of its middle; other bricks are halved until they are small.
    """
    x, y, z = (np.asarray(axis, dtype=np.float32) for axis in axes)
    values = np.empty((len(x), len(y), len(z)), dtype=np.float32)
    waiting = [
        (i, min(i + BRICK, len(x)), j, min(j + BRICK, len(y)), k, min(k + BRICK, len(z)))
        for i in range(0, len(x), BRICK)
        for j in range(0, len(y), BRICK)
        for k in range(0, len(z), BRICK)
    ]
    while waiting:
        i, p, j, q, k, r = waiting.pop()
        u, v, w = x[i:p], y[j:q], z[k:r]
        middle = [np.array([[[0.5 * (a[0] + a[-1])]]], dtype=np.float32) for a in (u, v, w)]
        half = 0.5 * float(np.linalg.norm([a[-1] - a[0] for a in (u, v, w)]))
        at_middle = float(field(*middle)[0, 0, 0])
        if abs(at_middle) > STEEPEST * half + clip:
            values[i:p, j:q, k:r] = np.clip(at_middle, -clip, clip)
        elif max(p - i, q - j, r - k) > SMALL_BRICK:
            a, b, c = (i + p + 1) // 2, (j + q + 1) // 2, (k + r + 1) // 2
            waiting += [
                (*one, *two, *three)
                for one in ((i, a), (a, p))
                for two in ((j, b), (b, q))
                for three in ((k, c), (c, r))
                if one[1] > one[0] and two[1] > two[0] and three[1] > three[0]
            ]
        else:
            level = field(u[:, None, None], v[None, :, None], w[None, None, :])
            np.clip(level, -clip, clip, out=values[i:p, j:q, k:r])
    return values


def gradient_at(field: Field, points: Floats, level: Level | None = None) -> Floats:
    """The gradient of the level, which may be known, at points, (n, 3), by forward differences."""
    here = field(*points.T) if level is None else level
    steps = DIFFERENCE * np.eye(3)
    return np.column_stack([(field(*(points + s).T) - here) / DIFFERENCE for s in steps])


def to_surface(
    field: Field, points: Floats, fresh: int = 3, rounds: int = 10, longest: float = 2.0
) -> Floats:
    """Points moved along the gradient onto the surface, by Newton's method, (n, 3) mm.

    The gradient is renewed in the first `fresh` rounds; after them the points are so close that the
    last one serves. A step is at most `longest` mm, so that a point at a crease does not leap to
    another part of the surface.
    """
    place = np.array(points, dtype=np.float64)
    gradient = np.zeros_like(place)
    for turn in range(rounds):
        level = field(*place.T)
        if np.abs(level).max(initial=0.0) < ON_SURFACE:
            break
        if turn < fresh:
            gradient = gradient_at(field, place, level)
        size = np.maximum((gradient**2).sum(axis=1), LEAST_SLOPE**2)
        step = -(level / size)[:, None] * gradient
        length = np.linalg.norm(step, axis=1)
        step *= np.minimum(1.0, longest / np.maximum(length, 1e-12))[:, None]
        place += step
    return place


def level_surface(field: Field, low: Floats, high: Floats, spacing: float) -> SurfaceData:
    """The closed zero surface of a level within a box, normals outward."""
    try:
        from skimage.measure import marching_cubes  # noqa: PLC0415
    except ImportError as error:
        raise ImportError(
            "surfaces of the phantom need scikit-image: pip install '.[imaging]' in cmfsim's folder"
        ) from error
    axes = [
        a - 2.0 * spacing + spacing * np.arange(int(np.ceil((b - a) / spacing)) + 5)
        for a, b in zip(low, high, strict=True)
    ]
    values = level_grid(field, axes, clip=max(3.0, 2.0 * spacing))
    # The border is outside, so that the surface closes even where the box is too small.
    for axis in range(3):
        for end in (0, -1):
            index: list[slice | int] = [slice(None)] * 3
            index[axis] = end
            values[tuple(index)] = np.minimum(values[tuple(index)], -1e-3)
    if not (values > 0.0).any():
        raise CaseInputError(
            f"spacing is {spacing:g} mm: no grid point lies inside the part; use a smaller spacing"
        )
    # A surface through a grid point would give triangles without area.
    least = NEAREST * spacing
    values = np.where(np.abs(values) < least, np.copysign(least, values), values)
    corners, triangles, _, _ = marching_cubes(
        values, 0.0, spacing=(spacing,) * 3, gradient_direction="ascent"
    )
    start = np.array([axis[0] for axis in axes])
    vertices = corners.astype(np.float64) + start
    moved = vertices.copy()
    cells = np.unique(np.floor(vertices / CELL), axis=0, return_inverse=True)[1].ravel()
    order = np.argsort(cells, kind="stable")
    for batch in np.split(order, np.flatnonzero(np.diff(cells[order])) + 1):
        moved[batch] = to_surface(field, vertices[batch], fresh=1, rounds=3, longest=0.3 * spacing)
    # A vertex far from its place has left its own sheet: it stays where marching cubes had it.
    far = np.linalg.norm(moved - vertices, axis=1) > 0.5 * spacing
    moved[far] = vertices[far]
    return SurfaceData(moved, triangles.astype(np.uint32))


# Mean HU of each tissue at about 120 kV; round figures of the textbooks (Hounsfield 1973; Bushberg
# 2012).
HOUNSFIELD: Mapping[str, float] = MappingProxyType({
    "air": -1000.0, "skin": 40.0, "fat": -90.0, "muscle": 55.0, "brain": 35.0, "cortical": 1150.0,
    "cancellous": 450.0, "tooth": 2100.0,
})  # fmt: skip
# What an image can hold, HU: 12 bits with an offset of 1024.
LOWEST, HIGHEST = -1024, 3071


def mixed(
    image: NDArray[np.float32], value: float, level: NDArray[np.float32], width: float
) -> None:
    """Paints a tissue into an image: each voxel by the share of it that lies inside.

    `width` is the size of a voxel in mm: a surface through the middle of one fills half.
    """
    share = np.clip(0.5 + level / width, 0.0, 1.0)
    image += share * (value - image)


def noisy(image: NDArray[np.float32], noise: float, seed: int) -> NDArray[np.int16]:
    """The image with Gaussian noise of `noise` HU, rounded and clipped to what a file holds."""
    if noise > 0.0:
        generator = np.random.default_rng(seed)
        image = image + noise * generator.standard_normal(image.shape, dtype=np.float32)
    return np.clip(np.rint(image), LOWEST, HIGHEST).astype(np.int16)
