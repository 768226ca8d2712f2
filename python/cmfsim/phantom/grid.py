"""Levels on grids and as triangles: bricks of voxels, marching cubes, and the way to the surface."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from cmfsim.checks import Floats
from cmfsim.errors import CaseInputError
from cmfsim.phantom.shapes import Level
from cmfsim.scene import SurfaceData

__all__ = ["Field", "gradient_at", "level_grid", "level_surface", "to_surface"]

Field = Callable[[Level, Level, Level], Level]

# Voxels along each edge of a brick: small enough for the cache and to be skipped whole.
BRICK = 20
# No level of the phantom changes faster than this per mm; measured 1.6 at most, at engravings.
STEEPEST = 2.0
# Step of the central difference, mm: its error is the curvature times 1e-6.
DIFFERENCE = 1e-3
# A projected point counts as on the surface below this level, mm.
ON_SURFACE = 1e-6


def level_grid(field: Field, axes: Sequence[Floats], clip: float) -> NDArray[np.float32]:
    """The level at the points of a grid, clipped to ±clip, float32.

    A brick whose middle lies deeper in or further out than the level can change within the brick
    takes the clipped value of its middle.
    """
    x, y, z = (np.asarray(axis, dtype=np.float32) for axis in axes)
    values = np.empty((len(x), len(y), len(z)), dtype=np.float32)
    for i in range(0, len(x), BRICK):
        for j in range(0, len(y), BRICK):
            for k in range(0, len(z), BRICK):
                u, v, w = x[i : i + BRICK], y[j : j + BRICK], z[k : k + BRICK]
                middle = [np.array([[[0.5 * (a[0] + a[-1])]]], dtype=np.float32) for a in (u, v, w)]
                half = 0.5 * float(np.linalg.norm([a[-1] - a[0] for a in (u, v, w)]))
                at_middle = float(field(*middle)[0, 0, 0])
                brick = values[i : i + BRICK, j : j + BRICK, k : k + BRICK]
                if abs(at_middle) > STEEPEST * half + clip:
                    brick[...] = np.clip(at_middle, -clip, clip)
                else:
                    level = field(u[:, None, None], v[None, :, None], w[None, None, :])
                    np.clip(level, -clip, clip, out=brick)
    return values


def gradient_at(field: Field, points: Floats) -> Floats:
    """The gradient of the level at points, (n, 3), by central differences."""
    columns = []
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = DIFFERENCE
        ahead, behind = (points + step).T, (points - step).T
        columns.append((field(*ahead) - field(*behind)) / (2.0 * DIFFERENCE))
    return np.column_stack(columns)


def to_surface(field: Field, points: Floats, rounds: int = 8, longest: float = 2.0) -> Floats:
    """Points moved along the gradient onto the surface, by Newton's method, (n, 3) mm.

    Each step is at most `longest` mm, so that a point at a crease does not leap to another part.
    """
    place = np.array(points, dtype=np.float64)
    for _ in range(rounds):
        level = field(*place.T)
        if np.abs(level).max(initial=0.0) < ON_SURFACE:
            break
        gradient = gradient_at(field, place)
        size = np.maximum((gradient**2).sum(axis=1), 0.04)
        step = -(level / size)[:, None] * gradient
        length = np.linalg.norm(step, axis=1)
        step *= np.minimum(1.0, longest / np.maximum(length, 1e-12))[:, None]
        place += step
    return place


def level_surface(
    field: Field, low: Floats, high: Floats, spacing: float, rounds: int = 3
) -> SurfaceData:
    """The closed zero surface of a level within a box, normals outward.

    Raises
    ------
    CaseError
        (also `ValueError`) The spacing is too coarse: no point of the grid lies inside.
    ImportError
        scikit-image is not installed.
    """
    try:
        from skimage.measure import marching_cubes  # noqa: PLC0415
    except ImportError as error:
        raise ImportError(
            "surfaces of the phantom need scikit-image: pip install 'cmfsim[imaging]'"
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
    corners, triangles, _, _ = marching_cubes(
        values, 0.0, spacing=(spacing,) * 3, gradient_direction="ascent"
    )
    start = np.array([axis[0] for axis in axes])
    vertices = corners.astype(np.float64) + start
    moved = to_surface(field, vertices, rounds, longest=0.3 * spacing)
    # A vertex far from its place has left its own sheet: it stays where marching cubes had it.
    far = np.linalg.norm(moved - vertices, axis=1) > 0.5 * spacing
    moved[far] = vertices[far]
    return SurfaceData(moved, triangles.astype(np.uint32))
