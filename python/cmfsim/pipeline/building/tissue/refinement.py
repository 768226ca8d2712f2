"""Refinement of a mesh: where tissue is thin, and at the mouth."""

import numpy as np
from numpy.typing import NDArray

from cmfsim._core import Surface, distance_image
from cmfsim.meshing import near_skin
from cmfsim.meshing.lips import LipSeam
from cmfsim.values.anatomy import Anatomy
from cmfsim.values.image_data import ImageData

Counts = NDArray[np.uint8]

# Depth below the skin to which thin tissue is refined, mm: lips, nose and lids, not the walls of
# the nasal cavity.
THIN_DEPTH = 12.0
# Halvings of the edge at gaps between skin and skin: lips a millimetre apart stay two.
GAP_REFINEMENTS = 2
# The mouth is where the distances from the upper jaw and from the mandible come to less, mm: the
# lips over the crowns of the teeth. What the jaws' motions differ by is sheared over this width.
MOUTH_WIDTH = 24.0
# How far below the skin it reaches, mm: lips and the muscle in them, not the tongue.
MOUTH_DEPTH = 15.0
# How far behind its foremost tissue, mm: the corners of the mouth and what is beside them. The arch
# of the cheekbone and the mandible's processes, as near to each other, lie farther back.
MOUTH_LENGTH = 35.0
# Tets from the skin of a lip to the teeth at least; and how far about the seam, mm.
TETS_IN_LIP = 3.0
SEAM_REACH = 4.0


def allowed_halvings(anatomy: Anatomy) -> Counts:
    """How often the edge may be halved for what is thin: (nx, ny, nz) on the anatomy's grid."""
    allowed: Counts = near_skin(anatomy, THIN_DEPTH).astype(np.uint8)
    allowed[anatomy.skin.values <= 0.0] = GAP_REFINEMENTS
    return allowed


def needed_halvings(level: ImageData, anatomy: Anatomy) -> Counts:
    """How often the edge is halved at least: once at the mouth, if the anatomy has a "mandible".

    A tet holds one mixture of fat and muscle: one half as large as a lip is thick smears the lip's
    muscle over it, where the motions of the jaws differ most. No landmark is asked for, nor that
    the image show the lips apart.

    Parameters
    ----------
    level : ImageData
        Of the tissue, on the anatomy's grid.
    anatomy : Anatomy

    Returns
    -------
    (nx, ny, nz) uint8
    """
    tissue = level.values > 0.0
    upper = np.zeros(tissue.shape, dtype=bool)
    lower = np.zeros(tissue.shape, dtype=bool)
    for name, bone in anatomy.bones.items():
        jaw = lower if name == "mandible" else upper
        jaw |= bone.values > 0.0
    sx, sy, sz = (float(s) for s in level.spacing)
    width = np.zeros(tissue.shape, dtype=np.float32)
    for jaw in (upper, lower):
        width += distance_image(jaw, (sx, sy, sz), within=MOUTH_WIDTH)
    mouth = tissue & (width < MOUTH_WIDTH) & near_skin(anatomy, MOUTH_DEPTH)
    rows = np.flatnonzero(mouth.any(axis=(0, 2)))
    if len(rows):
        # The second axis of the grid runs from front to back.
        mouth[:, rows[0] + int(MOUTH_LENGTH / sy) + 1 :] = False
    return mouth.astype(np.uint8)


def lip_halvings(level: ImageData, seam: LipSeam, edge_length: float) -> Counts:
    """How often the edge is halved at least along the seam between the lips, where these are thin.

    Parameters
    ----------
    level : ImageData
        Of the tissue.
    seam : LipSeam
        With a surface.
    edge_length : float, mm

    Returns
    -------
    (nx, ny, nz) uint8
    """
    values = level.values
    needed = np.zeros(values.shape, dtype=np.uint8)
    if seam.surface is None:
        return needed
    thickness = float(seam.summary.get("thickness", np.inf))
    wanted = int(np.ceil(np.log2(max(TETS_IN_LIP * edge_length / max(thickness, 1e-3), 1.0))))
    vertices, spacing = seam.surface.vertices, level.spacing
    low = np.floor((vertices.min(axis=0) - SEAM_REACH - level.lowest) / spacing).astype(int)
    high = np.ceil((vertices.max(axis=0) + SEAM_REACH - level.lowest) / spacing).astype(int) + 1
    low, high = np.maximum(low, 0), np.clip(high, 0, values.shape)
    if wanted < 1 or (high <= low).any():
        return needed
    crop = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    index = np.argwhere(values[crop] > 0.0) + low
    points = level.lowest + index * spacing
    closest, _, _ = Surface(vertices, seam.surface.triangles).closest(points)
    near = index[np.linalg.norm(closest - points, axis=1) <= SEAM_REACH]
    needed[tuple(near.T)] = min(wanted, GAP_REFINEMENTS)
    return needed
