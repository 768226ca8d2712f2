"""Things on the face that are no part of it: tubes, holders, tape. They are reported, not removed.

Whatever protrudes from the head and is thin is checked: it belongs to the face if it has a mirror
image on the other side, as ears, nose and lips have, is less dense than plastic and protrudes no
further than a nose.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.imaging.bone import Bone
from cmfsim.imaging.morphology import (
    Mask,
    Volume,
    box_of,
    chosen,
    depth,
    label,
    ndimage,
    opened,
    reached,
    simplex,
)
from cmfsim.imaging.skin import Skin
from cmfsim.imaging.working import Working, coarse_of
from cmfsim.values.finding import Finding

__all__ = ["attached_findings"]

# Voxels that things on the face are told apart on, mm.
STEP = 2.0
# What a ball of this radius does not fit into stands out from the head, mm: tubes for the airway
# measure up to 15 mm across.
WIDEST = 8.0
# A part without its mirror image within the first is one-sided, with all that joins it and has none
# within the second, mm: noses and lips deviate less.
ONE_SIDED = 5.0
NEARLY_ONE_SIDED = 3.0
# Plastic is denser than this, skin and cartilage are not, HU; bone this near is the head's own, mm.
PLASTIC = 130.0
OWN_BONE = 4.0
# Noses, lips and chins stand out from the opened head by 6 mm at most; plates of chin rests by far
# more. What is farther out than the first is no face's, with all that joins it beyond the second,
# mm.
FARTHEST = 15.0
STANDING_OUT = 8.0
# A throat has up to 400 mm² across, a windpipe 300 mm².
AIRWAY_AREA = 900.0
# It lies deep in the head for this length, mm, with thick tissue on so much of its sides, and under
# the skin of the neck, which is thin, on so much at least. Hollow things are thin all around.
AIRWAY_LENGTH, DEEP, SHALLOW = 20.0, 0.8, 0.3
# Smaller and shorter things are folds, swellings and noise, mm³ and mm.
LEAST_VOLUME = 600.0
LEAST_LENGTH = 18.0
# The face lies in front of this part of the head's depth: ears, folded or not, lie behind.
FACE_PART = 0.45
ONE_SIDED_TEXT = "with no counterpart on the other side"
# Points of the face that its plane of symmetry is fitted to.
SAMPLES = 4000


def attached_findings(work: Working, skin: Skin, bone: Bone) -> list[Finding]:
    """A finding for each thing on the face that is one-sided or with the density of plastic."""
    inside, spacing, shift = coarse_of(skin.mask.astype(np.float32), work.spacing, STEP)
    mask: Mask = np.asfortranarray(inside > 0.5)
    hu = coarse_of(work.hu, work.spacing, STEP)[0]
    own = coarse_of(bone.solid.astype(np.float32), work.spacing, STEP)[0] > 0.25
    box = box_of(mask)
    rows = box[1]
    behind = rows.start + int(FACE_PART * (rows.stop - rows.start))
    around = depth(mask, spacing)
    core = opened(mask | _airway(mask, spacing), WIDEST, spacing)
    out = mask & ~core
    out[:, behind:] = False
    away = -depth(core, spacing)
    far = reached(out & (away > STANDING_OUT), away > FARTHEST)
    dense = out & (hu > PLASTIC) & (around < WIDEST)
    dense &= depth(np.asfortranarray(own), spacing) < -OWN_BONE
    mirrored = _mirrored(around, spacing, behind, out)
    alone = reached(out & (mirrored < -NEARLY_ONE_SIDED), mirrored < -ONE_SIDED)
    found: Mask = dense | alone | far
    labels, count = label(found, corners=True)
    findings = []
    for piece in range(1, count + 1):
        voxels = np.argwhere(labels == piece)
        volume = len(voxels) * float(np.prod(spacing))
        size = (np.ptp(voxels, axis=0) + 1) * spacing
        if volume < LEAST_VOLUME or float(np.linalg.norm(size)) < LEAST_LENGTH:
            continue
        middle = work.origin + shift + voxels.mean(axis=0) * spacing
        kinds = ((far, "further out than a nose"), (dense, "with the density of plastic"))
        here = labels == piece
        kind = next((text for which, text in kinds if which[here].mean() > 0.5), ONE_SIDED_TEXT)
        findings.append(_finding(middle, size, volume, kind))
    return findings


def _airway(mask: Mask, spacing: NDArray[np.float64]) -> Mask:
    """The air in throat and windpipe: closed in by tissue in each slice, narrow, deep somewhere.

    The skin in front of a windpipe is thin and stands free of the rest of the neck, as a thing on
    the face does. Air in or behind such a thing is nowhere deep in the head.
    """
    images = ndimage()
    across = np.zeros((3, 3, 3), dtype=bool)
    across[:, :, 1] = images.generate_binary_structure(2, 1)
    # Filled in each slice alone: the airway is open at nose, mouth and the end of the image.
    closed_in = images.binary_fill_holes(mask, structure=across) & ~mask
    labels, count = images.label(closed_in, structure=across)
    areas = np.bincount(labels.ravel(), minlength=count + 1) * spacing[0] * spacing[1]
    around = images.grey_dilation(labels, footprint=across)
    walls = mask & (around > 0)
    walled = np.bincount(around[walls], minlength=count + 1)
    thick = np.bincount(around[walls & _thick(mask, spacing)], minlength=count + 1)
    is_airy = (areas <= AIRWAY_AREA) & (thick >= SHALLOW * walled)
    is_airy[0] = False
    pieces, pieces_count = label(np.asfortranarray(is_airy[labels]))
    is_deep = (is_airy & (thick >= DEEP * walled))[labels]
    is_airway = [False]
    for piece, block in enumerate(images.find_objects(pieces, pieces_count), 1):
        levels = (is_deep[block] & (pieces[block] == piece)).any(axis=(0, 1))
        is_airway.append(bool(np.count_nonzero(levels) * spacing[2] >= AIRWAY_LENGTH))
    return chosen(np.array(is_airway), pieces)


def _thick(mask: Mask, spacing: NDArray[np.float64]) -> Mask:
    """Where a ball fits into the head, as if its lowest slice went on below the image."""
    low = box_of(mask)[2].start
    below = int(np.ceil(WIDEST / spacing[2])) + 1
    lowest = np.repeat(mask[:, :, low : low + 1], below, axis=2)
    longer = np.asfortranarray(np.concatenate([lowest, mask[:, :, low:]], axis=2))
    thick = np.zeros_like(mask)
    thick[:, :, low:] = opened(longer, WIDEST, spacing)[:, :, below:]
    return thick


def _finding(
    middle: NDArray[np.float64], size: NDArray[np.float64], volume: float, kind: str
) -> Finding:
    return Finding.warning(
        "skin-attachment",
        f"something protrudes from the face, {kind}: {size[0]:.0f} × {size[1]:.0f} × {size[2]:.0f} "
        f"mm, {volume / 1000.0:.1f} cm³",
        where=f"skin at ({middle[0]:.0f}, {middle[1]:.0f}, {middle[2]:.0f}) mm",
        why="a tube, a holder or tape on the face is taken for skin, and is moved and compared as "
        "skin",
        fix="look at it in the image; erase it there (air, −1000 HU), or leave that part of the "
        "face out of the evaluation",
    )


def _mirrored(around: Volume, spacing: NDArray[np.float64], behind: int, out: Mask) -> Volume:
    """The depth inside the head of each voxel's mirror image, mm; infinite where not asked for."""
    face = np.argwhere(np.abs(around[:, :behind]) < float(spacing.max())) * spacing
    if not len(face) or not out.any():
        return np.full(around.shape, np.float32(np.inf))
    face = face[:: max(1, len(face) // SAMPLES)]
    middle = face.mean(axis=0)

    def reflected(points: Any, plane: Any) -> Any:
        offset, yaw, roll = plane
        normal = np.array([1.0, yaw, roll])
        normal /= np.linalg.norm(normal)
        away = (points - middle) @ normal - offset
        return points - 2.0 * away[:, None] * normal

    def at(points: Any) -> Any:
        index = np.rint(points / spacing).astype(np.intp)
        last = np.array(around.shape) - 1
        index = np.clip(index, 0, last)
        return around[tuple(index.T)]

    def cost(plane: Any) -> float:
        # What is far off counts no more than this: a tube may not turn the plane.
        return float(np.minimum(np.abs(at(reflected(face, plane))), 3.0 * ONE_SIDED).mean())

    steps = np.array([8.0, 0.1, 0.1])
    plane = simplex(cost, np.zeros(3), steps)
    deep = np.full(around.shape, np.float32(np.inf))
    voxels = np.argwhere(out)
    deep[tuple(voxels.T)] = at(reflected(voxels * spacing, plane))
    return deep
