"""Closed, lightly smoothed surfaces of levels, of a size that contact can be searched on."""

import logging
from concurrent.futures import Future
from dataclasses import dataclass
from importlib.util import find_spec
from typing import cast
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from cmfsim import _core
from cmfsim.errors import CaseInputError, third_party
from cmfsim.surfaces.checks import areas_volumes, has_three_corners
from cmfsim.surfaces.topology import loops_of
from cmfsim.values.anatomy import BoneSegment
from cmfsim.values.checks import Floats, Indices, as_number, as_positive
from cmfsim.values.image_data import ImageData
from cmfsim.values.surface_data import SurfaceData, are_among, used_nodes

_log = logging.getLogger(__name__)

# Taubin (1995): a shrinking step and a slightly larger growing one, which keep the volume.
SHRINK, GROW = 0.5, -0.53
# Blur of a contact surface, mm. On two real heads with tets of 4, 5 and 6 mm and two plans of about
# 5 mm, sliding settled in 9 of 12 runs with it, in 4 of 12 on the bare crowns.
CONTACT_RELIEF = 3.0
# Where the blur is cut off, in standard deviations.
BLUR_REACH = 3.0
# The detailed surfaces of levels that are in use.
_MADE: WeakKeyDictionary[ImageData, Future[SurfaceData]] = WeakKeyDictionary()


@dataclass(frozen=True)
class SurfaceOptions:
    """Options of the surface of a level.

    max_triangles: About what finer ones are decimated to, 100 at least (Garland and Heckbert 1997).
    smoothing: Rounds of Taubin smoothing (1995), which take away the steps of the voxels and keep
        the volume, 0 to 100.
    """

    max_triangles: int = 30_000
    smoothing: int = 6

    def __post_init__(self) -> None:
        if as_number("max_triangles", self.max_triangles) < 100:
            raise CaseInputError(f"max_triangles is {self.max_triangles}: at least 100 is needed")
        if not 0 <= as_number("smoothing", self.smoothing) <= 100:
            raise CaseInputError(f"smoothing is {self.smoothing}: 0 to 100 rounds are allowed")


def surface_of_level(
    name: str, level: ImageData, options: SurfaceOptions | None = None
) -> SurfaceData:
    """The zero surface of a level, closed also where the level reaches the image's border.

    Marching cubes (Lewiner 2003, scikit-image), smoothed, and decimated where it is too fine.
    level: Positive inside; normals point outward.
    Raises `CaseError`: A level without an inside; scikit-image is missing.
    """
    options = options or SurfaceOptions()
    values = level.single
    low, high = block_of(values > 0.0)
    if not (high > low).all():
        raise CaseInputError(f"{name!r} has no voxel inside, so its surface would be empty")
    measure = third_party("skimage.measure", "surfaces of levels are made", "imaging")
    # Only the block that holds the piece, with a border of outside, so that the surface closes.
    low = np.maximum(low - 1, 0)
    high = np.minimum(high + 1, values.shape)
    block = values[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]
    outside = -max(float(values.max()), -float(values.min()))
    block = np.pad(block, 1, constant_values=outside)
    spacing = level.spacing
    vertices, triangles, _, _ = measure.marching_cubes(block, 0.0, gradient_direction="descent")
    points = np.asarray(vertices, dtype=np.float64) + (low - 1)
    corners, points = _without_slits(np.asarray(triangles, dtype=np.int64), points)
    points = level.lowest + points * spacing
    points = _core.smoothed(points, corners, [SHRINK, GROW] * options.smoothing)
    if len(corners) > options.max_triangles:
        # Quadric decimation stays within a tenth of a voxel, but here and there it folds a sheet.
        points, corners = _closed(*_core.decimated(points, corners, options.max_triangles))
    return SurfaceData(points, _outward(points, corners))


def detailed_surface(name: str, level: ImageData) -> SurfaceData | None:
    """The surface of a level as `surface_of_level` has it; None where scikit-image is missing.

    It is made once for each level: who asks while it is being made waits for it.
    """
    if find_spec("skimage") is None:
        _log.info("no detailed %s: scikit-image is not installed", name)
        return None
    mine: Future[SurfaceData] = Future()
    made = _MADE.setdefault(level, mine)
    if made is mine:
        try:
            mine.set_result(surface_of_level(name, level))
        except BaseException as error:
            mine.set_exception(error)
            raise
    return made.result()


def contact_surface(segment: BoneSegment, *, relief: float = CONTACT_RELIEF) -> SurfaceData:
    """The surface on which mucosa slides: the bone without relief finer than the tets.

    Tissue does not reach between teeth, and a node that slides over crowns and gaps flips between
    their sides. The signed distance from the bone is therefore blurred (Gaussian) before its
    surface is extracted. Nodes keep their own distance from it if `gap` is "rest".

    Parameters
    ----------
    segment : BoneSegment
    relief : float, mm
        Standard deviation of the blur: half to one edge of the tissue's tets.

    Returns
    -------
    SurfaceData
        Closed, outward normals, mm.

    Raises
    ------
    CaseError
        (also `ValueError`) A relief that is not positive, or a piece so thin that nothing is left
        of it; scipy or scikit-image is missing.

    Examples
    --------
    >>> import cmfsim
    >>> maxilla = next(segment for segment in segments if segment.name == "maxilla")
    >>> surface = cmfsim.contact_surface(maxilla, relief=2.0)
    """
    sigma = as_positive("relief", relief) / segment.level.spacing
    ndimage = third_party("scipy.ndimage", "contact surfaces are smoothed", "imaging")
    inside = segment.level.values > 0.0
    first, past = block_of(inside)
    if not (past > first).all():
        raise CaseInputError(f"{segment.name!r} has no voxel inside, so its surface would be empty")
    # A border that the blur cannot reach across, so that the surface closes within the block.
    rim = np.ceil(BLUR_REACH * sigma).astype(int) + 2
    low, high = first - rim, past + rim
    block = np.zeros(high - low, dtype=bool)
    within = tuple(slice(r, -r) for r in rim)
    bounds = tuple(slice(a, b) for a, b in zip(first, past, strict=True))
    block[within] = inside[bounds]
    spacing = segment.level.spacing.tolist()
    x, y, z = spacing
    # Distances between voxel centres: the surface lies half a voxel from either.
    half = np.float32(0.5 * min(spacing))
    depth = np.where(
        block,
        _core.distance_image(~block, (x, y, z)) - half,
        half - _core.distance_image(block, (x, y, z)),
    )
    depth = ndimage.gaussian_filter(depth, sigma, mode="nearest", truncate=BLUR_REACH)
    origin = segment.level.lowest + low * np.asarray(spacing)
    level = ImageData(depth.astype(np.float32, copy=False), spacing, origin)
    return surface_of_level(f"contact of {segment.name}", level)


def block_of(mask: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The first and the past-the-last voxel of the mask along each axis; equal if it is empty."""
    low, high = np.zeros(3, dtype=np.intp), np.zeros(3, dtype=np.intp)
    columns, sheet = np.any(mask, axis=2), np.any(mask, axis=0)
    for axis, line in enumerate((columns.any(axis=1), columns.any(axis=0), sheet.any(axis=0))):
        found = np.flatnonzero(line)
        if len(found):
            low[axis], high[axis] = found[0], found[-1] + 1
    return low, high


def _without_slits(
    triangles: NDArray[np.int64], points: Floats
) -> tuple[NDArray[np.int64], Floats]:
    """Vertices in the same place made one, triangles that thereby lose a corner dropped.

    A voxel that is hardly inside has all vertices of its surface in its centre: nothing is left.
    """
    # Vertices lie on the edges of voxels' cells: those of two edges meet at a voxel's centre only.
    centred = np.flatnonzero((points == np.rint(points)).all(axis=1))
    _, first, back = np.unique(points[centred], axis=0, return_index=True, return_inverse=True)
    same = np.arange(len(points))
    same[centred] = centred[first[back.reshape(-1)]]
    joined = same[triangles]
    used, left = used_nodes(joined[has_three_corners(joined)])
    return left, points[used]


def simplified_surface(name: str, surface: SurfaceData, max_triangles: int) -> SurfaceData:
    """The surface in as many triangles as wanted or fewer (Garland 1997); borders stay open.

    Raises `CaseError`: Nothing is left of the surface.
    """
    if len(surface.triangles) <= max_triangles:
        return surface
    points, corners = _core.decimated(surface.vertices, surface.triangles, max_triangles)
    if not len(corners):
        raise CaseInputError(f"nothing is left of {name!r} at {max_triangles} triangles")
    return SurfaceData(points, corners)


def _closed(points: Floats, corners: Indices) -> tuple[Floats, NDArray[np.int64]]:
    """The surface with triangles at edges that more than two share removed, and holes filled."""
    triangles = corners.astype(np.int64)
    n = len(points)
    while True:
        # The directed edges: first those of all first corners.
        edges = np.concatenate([triangles[:, [k, (k + 1) % 3]] for k in range(3)])
        keys = np.minimum(*edges.T) * n + np.maximum(*edges.T)
        in_order = np.sort(keys)
        thrice = in_order[2:][in_order[2:] == in_order[:-2]]
        if not len(thrice):
            break
        triangles = triangles[~are_among(keys, thrice).reshape(3, -1).any(axis=0)]
    back = edges[:, 1] * n + edges[:, 0]
    lone = ~are_among(edges[:, 0] * n + edges[:, 1], np.sort(back))
    centres: list[Floats] = []
    fans: list[tuple[int, int, int]] = []
    borders = edges[lone][:, ::-1]
    for loop in loops_of(borders, sorted(borders[:, 0].tolist()))[0]:
        centre = n + len(centres)
        centres.append(points[loop].mean(axis=0))
        fans += [(a, b, centre) for a, b in zip(loop, loop[1:] + loop[:1], strict=True)]
    if not centres:
        return points, triangles
    return np.vstack([points, centres]), np.vstack([triangles, np.array(fans, dtype=np.int64)])


def _outward(points: Floats, triangles: NDArray[np.int64]) -> Indices:
    volume = float(areas_volumes(points, triangles)[1].sum())
    corners = triangles if volume > 0.0 else triangles[:, ::-1]
    return cast("Indices", corners.astype(np.uint32))
