"""A bone divided where it was actually cut: along the points equally near to two of its pieces."""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from cmfsim._core import Surface
from cmfsim.bones.cuts.cutting import SURFACES_AT_ONCE
from cmfsim.bones.segment_checks import check_segments
from cmfsim.errors import CaseInputError
from cmfsim.surfaces.levels import surface_of_level
from cmfsim.values.anatomy import BoneSegment
from cmfsim.values.image_data import ImageData
from cmfsim.values.surface_data import SurfaceData

# Beyond this distance from the box round a smaller piece, mm, bone belongs to the largest: the
# hollows of a jaw reach no further over its surface.
BESIDE = 15.0
# A piece with less bone than this, mm³, has no tissue attached to it alone.
LEAST_VOLUME = 100.0


def part_segment(
    segment: BoneSegment, pieces: Mapping[str, SurfaceData]
) -> tuple[BoneSegment, ...]:
    """The pieces of a segment: each has the bone that lies nearest to its surface.

    Parameters
    ----------
    segment : BoneSegment
    pieces : mapping of str to SurfaceData
        Parts of the segment's own surface by name, the largest first; they need not be closed.

    Returns
    -------
    tuple of BoneSegment
        Without pieces that hold less than 100 mm³ of the segment.

    Raises
    ------
    CaseError
        (also `ValueError`) No piece holds as much.
    """
    level = segment.level
    values = level.single
    limit = max(float(values.max()), -float(values.min()))
    surfaces = [Surface(s.vertices, s.triangles) for s in pieces.values()]
    low = np.min([s.vertices.min(axis=0) for s in surfaces[1:]] or [level.highest], axis=0)
    high = np.max([s.vertices.max(axis=0) for s in surfaces[1:]] or [level.lowest], axis=0)
    spacing = level.spacing
    index = np.argwhere(values > -limit)
    points = level.lowest + index * spacing
    beside = ((points >= low - BESIDE) & (points <= high + BESIDE)).all(axis=1)
    index, points = index[beside], points[beside]
    distances = np.array([_distance(surface, points) for surface in surfaces])
    # Scaled as a cut by planes is: linear in the cells that it crosses.
    steep = limit / float(np.linalg.norm(spacing))
    voxel = float(np.prod(spacing))
    parted: dict[str, ImageData] = {}
    place = tuple(index.T)
    for number, name in enumerate(pieces):
        others = np.delete(distances, number, axis=0)
        nearest = others.min(axis=0) if len(others) else np.full(len(points), np.inf)
        depth = np.clip(0.5 * (nearest - distances[number]) * steep, -limit, limit)
        region = np.full(values.shape, np.float32(-limit if number else limit))
        region[place] = depth
        piece = np.minimum(values, region)
        if np.count_nonzero(piece > 0.0) * voxel >= LEAST_VOLUME:
            parted[name] = level.with_values(piece)
    if not parted:
        raise CaseInputError(
            f"none of the {len(pieces)} moved pieces lies in bone {segment.name!r}: give the "
            "surfaces of this bone before and after, both in the frame and unit of the case"
        )
    with ThreadPoolExecutor(SURFACES_AT_ONCE) as pool:
        made = pool.map(lambda name: surface_of_level(name, parted[name]), parted)
        segments = tuple(
            BoneSegment(name, parted[name], surface)
            for name, surface in zip(parted, made, strict=True)
        )
    check_segments(segments)
    return segments


def _distance(surface: Surface, points: NDArray[np.float64]) -> NDArray[np.float64]:
    if not len(points):
        return np.zeros(0)
    size: NDArray[np.float64] = np.linalg.norm(surface.closest(points)[0] - points, axis=1)
    return size
