"""Things on the face that are no part of it: tubes, holders, tape. They are reported, not removed.

Whatever protrudes from the head and is thin is checked: it belongs to the face if it has a mirror
image on the other side, as ears, nose and lips have, is less dense than plastic and protrudes no
further than a nose. What is thick is checked by its density. What lies flat on the face has a step
all round (`find_plates`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.imaging.bones.bone import Bone
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
    smoothed,
)
from cmfsim.imaging.skins.plates import STEP as PLATE_STEP
from cmfsim.imaging.skins.plates import find_plates
from cmfsim.imaging.skins.skin import Skin
from cmfsim.imaging.working_grid import Working, coarse_of
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding

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
# Muscle, the densest soft tissue near the skin, has 40 to 70 HU, and 80 with contrast agent: what
# is denser all through, and than the rest of the skin by the second, is no tissue. It is looked for
# so deep under the skin, mm, where nothing is mixed with air, by the means and deviations of a
# Gaussian, mm: of a normal spread 95 % lie above the third, in deviations. Streaks spread widely.
MUSCLE, DENSER, EVEN = 80.0, 40.0, 1.64
UNDER_SKIN, AMONG = (2.0, 6.0), 4.0
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
LEFT_OUT_TEXT = (
    "a shell too thin for a head and left out of it, which may touch the skin at its rim"
)
ONE_SIDED_TEXT = "with no counterpart on the other side"
FLAT_TEXT = "flat, with a step all round that no part of a face has"
# A flat thing whose middle lies within the box of another one, wider by this, is the same, mm.
SAME = 10.0
# A nose stands out farther than this from what larger balls, of the second radius, sweep in the
# head; a pad does not, mm.
FLAT, BROAD = 13.0, 20.0
# Points of the face that its plane of symmetry is fitted to.
SAMPLES = 4000


@dataclass(frozen=True, eq=False)
class _Head:
    """The inside of the head in voxels of about `STEP`.

    mask: (nx, ny, nz) bool.
    spacing, origin: (3,), mm.
    """

    mask: Mask
    spacing: NDArray[np.float64]
    origin: NDArray[np.float64]

    @cached_property
    def core(self) -> Mask:
        """What balls can sweep in the head with its airway."""
        return opened(self.mask | _airway(self.mask, self.spacing), WIDEST, self.spacing)

    @cached_property
    def away(self) -> Volume:
        """The distance from that, mm; negative in it."""
        return -depth(self.core, self.spacing)

    @cached_property
    def away_broadly(self) -> Volume:
        """The distance from what larger balls can sweep, mm; negative in it."""
        return -depth(opened(self.mask, BROAD, self.spacing), self.spacing)


@dataclass(frozen=True, eq=False)
class Attached:
    """What is on the face.

    middle: (3,), mm. The mean of its voxels.
    box: (2, 3), mm. The lowest and the highest corner of what it takes up.
    volume: mm³. Not known of what lies flat: 0.
    """

    middle: Floats
    box: Floats
    volume: float
    kind: str

    @property
    def size(self) -> Floats:
        """Its extents, (3,) mm."""
        extents: Floats = self.box[1] - self.box[0]
        return extents

    @property
    def finding(self) -> Finding:
        """What is reported of it."""
        size = " × ".join(f"{length:.0f}" for length in self.size)
        volume = f", {self.volume / 1000.0:.1f} cm³" if self.volume else ""
        x, y, z = self.middle
        return Finding(
            "skin-attachment",
            f"something protrudes from the face, {self.kind}: {size} mm{volume}",
            where=f"skin at ({x:.0f}, {y:.0f}, {z:.0f}) mm",
        )


def find_attached(work: Working, skin: Skin, bone: Bone, threshold: float) -> list[Attached]:
    """Each thing on the face: one-sided, dense as plastic, or flat with a rim.

    threshold: Of the skin, HU.
    """
    inside, spacing, shift = coarse_of(skin.mask.astype(np.float32), work.spacing, STEP)
    head = _Head(np.asfortranarray(inside > 0.5), spacing, work.origin + shift)
    things = [*_protruding(head, work, bone), *_left_out(work, skin, threshold)]
    for flat in _flat(head, work, skin):
        near = [np.abs(flat.middle - thing.middle) < 0.5 * thing.size + SAME for thing in things]
        if not any(inside.all() for inside in near):
            things.append(flat)
    return things


def _flat(head: _Head, work: Working, skin: Skin) -> list[Attached]:
    """What lies flat on the face."""
    level, spacing, shift = coarse_of(skin.level, work.spacing, PLATE_STEP)
    things = []
    for voxels in find_plates(level, spacing, _behind(box_of(level > 0.0)[1])):
        places = work.origin + shift + voxels * spacing
        index = np.rint((places - head.origin) / head.spacing).astype(np.intp)
        index = np.clip(index, 0, np.array(head.mask.shape) - 1)
        if head.away_broadly[tuple(index.T)].max() <= FLAT:
            box = [places.min(axis=0), places.max(axis=0)] + spacing * [[-0.5], [0.5]]
            things.append(Attached(places.mean(axis=0), box, 0.0, FLAT_TEXT))
    return things


def _behind(rows: slice) -> int:
    """The first layer along y behind the face, of those that hold the head."""
    return int(rows.start + int(FACE_PART * (rows.stop - rows.start)))


def _protruding(head: _Head, work: Working, bone: Bone) -> list[Attached]:
    """What protrudes, and is one-sided, has the density of plastic, or reaches too far."""
    spacing = head.spacing
    hu = coarse_of(work.hu, work.spacing, STEP)[0]
    own, bare = (
        coarse_of(part.astype(np.float32), work.spacing, STEP)[0] > 0.25
        for part in (bone.solid, bone.bare)
    )
    behind = _behind(box_of(head.mask)[1])
    around = depth(head.mask, spacing)
    out = head.mask & ~head.core
    out[:, behind:] = False
    far = reached(out & (head.away > STANDING_OUT), head.away > FARTHEST)
    off_bone = depth(np.asfortranarray(own), spacing) < -OWN_BONE
    dense = out & (hu > PLASTIC) & (around < WIDEST) & off_bone
    # What is too thick to stand out.
    dense[:, :behind] |= bare[:, :behind]
    mirrored = _mirrored(around, spacing, behind, out)
    alone = reached(out & (mirrored < -NEARLY_ONE_SIDED), mirrored < -ONE_SIDED)
    face = off_bone.copy(order="F")
    face[:, behind:] = False
    lump = _dense_all_through(
        hu, face & (around > UNDER_SKIN[0]) & (around < UNDER_SKIN[1]), spacing
    )
    found: Mask = dense | alone | far | lump
    kinds = (
        (far, "further out than a nose"),
        (dense, "with the density of plastic"),
        (lump, "denser all through than soft tissue"),
        (found, ONE_SIDED_TEXT),
    )
    return _pieces(found, kinds, spacing, head.origin)


def _left_out(work: Working, skin: Skin, threshold: float) -> list[Attached]:
    """What is as dense as skin in front of it: shells of masks, too thin for a head."""
    out = (work.hu > threshold) & ~np.maximum.accumulate(skin.mask, axis=1)
    out[:, _behind(box_of(skin.mask)[1]) :] = False
    return _pieces(np.asfortranarray(out), ((out, LEFT_OUT_TEXT),), work.spacing, work.origin)


def _pieces(
    found: Mask, kinds: Sequence[tuple[Mask, str]], spacing: Floats, origin: Floats
) -> list[Attached]:
    """The pieces that are large enough, each of the first kind that most of it is."""
    labels, sizes = label(found, corners=True)
    blocks = ndimage().find_objects(labels)
    things = []
    for piece in np.flatnonzero(sizes * float(np.prod(spacing)) >= LEAST_VOLUME).tolist():
        block = blocks[piece - 1]
        # Voxels reach half an edge beyond their middles.
        ends = np.array([[b.start for b in block], [b.stop for b in block]])
        box = origin + (ends - 0.5) * spacing
        if float(np.linalg.norm(box[1] - box[0])) < LEAST_LENGTH:
            continue
        here = labels[block] == piece
        first = np.array([b.start for b in block])
        middle = origin + (first + np.argwhere(here).mean(axis=0)) * spacing
        kind = next(text for which, text in kinds if which[block][here].mean() > 0.5)
        things.append(Attached(middle, box, sizes[piece] * float(np.prod(spacing)), kind))
    return things


def _dense_all_through(hu: Volume, layer: Mask, spacing: NDArray[np.float64]) -> Mask:
    """Where a layer under the skin is denser than tissue, and evenly so: rests, gel, bolus."""
    if not layer.any():
        return layer
    weights = layer.astype(np.float32)
    shares = np.maximum(smoothed(weights, AMONG, spacing), np.float32(1e-6))

    def mean(values: Volume) -> Any:
        return smoothed(weights * values, AMONG, spacing) / shares

    middle = mean(hu)
    spread = np.sqrt(np.maximum(mean(hu * hu) - middle * middle, 0.0))
    least = max(MUSCLE, float(np.median(hu[layer])) + DENSER)
    dense: Mask = layer & (middle - EVEN * spread > least)
    return dense


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
    pieces, sizes = label(np.asfortranarray(is_airy[labels]))
    is_deep = (is_airy & (thick >= DEEP * walled))[labels]
    is_airway = [False]
    for piece, block in enumerate(images.find_objects(pieces, len(sizes) - 1), 1):
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
