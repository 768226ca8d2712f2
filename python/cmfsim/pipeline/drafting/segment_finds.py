"""Segments of a segmentation as surfaces, in LPS mm."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cmfsim.io.segmentations import Segmentation, read_segmentation
from cmfsim.pipeline.drafting.finds import SurfaceFind
from cmfsim.pipeline.drafting.roles import name_role
from cmfsim.surfaces.levels import surface_of_level
from cmfsim.values.image_data import ImageData
from cmfsim.values.surface_data import SurfaceData

__all__ = ["segment_finds"]


def segment_finds(path: Path, label: str) -> list[SurfaceFind]:
    """The segments of a file that may be skin or bone, each as a surface.

    Raises
    ------
    ImageError
        (also `ValueError`) As `read_segmentation`.
    """
    read = read_segmentation(path)
    found = []
    for segment in read.segments:
        role, mask = name_role(segment.name), read.mask(segment)
        if role.part == "other" or not mask.any():
            continue
        surface = _surface(segment.name, mask, read)
        shown = f"{label} / {segment.name}"
        found.append(SurfaceFind(shown, role, path, surface, "LPS", is_closed=True, is_made=True))
    return found


def _surface(name: str, mask: NDArray[np.bool_], read: Segmentation) -> SurfaceData:
    """The border of a mask, half a voxel outside its voxels' centres, in LPS mm."""
    lengths = np.linalg.norm(read.affine[:, :3], axis=0)
    level = ImageData(mask.astype(np.float32) - 0.5, lengths)
    surface = surface_of_level(name, level)
    turn = read.affine[:, :3] / lengths
    vertices = surface.vertices @ turn.T + read.affine[:, 3]
    triangles = surface.triangles
    # A grid of left-handed axes turns surfaces inside out.
    mirrored = bool(np.linalg.det(turn) < 0.0)
    return SurfaceData(vertices, triangles[:, ::-1] if mirrored else triangles)
