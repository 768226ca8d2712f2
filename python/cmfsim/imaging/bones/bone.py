"""Bone with the hollows that it encloses, teeth and metal, and its surface between voxels.

A voxel that bone fills by half shows the mean of both. One threshold for all bone lies below that
for compact bone, and makes it thicker all round by a third of a voxel. Half the height of the step
is where the surface is, whatever the blur (Spoor, Zonneveld & Macho 1993).
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import ImageInputError
from cmfsim.imaging.bones.metal import Metal, without_streaks
from cmfsim.imaging.bones.vessels import without_vessels
from cmfsim.imaging.intensities.intensity import SOFT
from cmfsim.imaging.intensities.levels import level_of
from cmfsim.imaging.morphology import (
    Mask,
    Volume,
    chosen,
    closed,
    depth,
    grown,
    label,
    ndimage,
    resampled_to,
    shrunk,
    watershed,
)
from cmfsim.imaging.options import SegmentOptions
from cmfsim.imaging.skins.skin import Skin
from cmfsim.imaging.working_grid import Working, coarse_of
from cmfsim.values.finding import Finding

# The blur of a step from soft tissue to bone is over within this, voxels of the scan.
BLUR = 2.0
# Half of the step to compact bone; enamel, three times as dense, would draw the bone beside it in.
HIGHEST = 0.5 * (SOFT + 1400.0)
# Values are looked up this far apart along a line, voxels.
SAMPLE = 0.5
# Number of distances that are looked up at a time.
THREADS = 2

# Teeth are denser than compact bone, HU; smaller groups of such voxels are none, mm³.
ENAMEL = 1400.0
LEAST_TEETH = 200.0
# Enamel lies within this of the occlusal plane at the incisors, mm.
OCCLUSAL_REACH = 30.0
# Full range of the bone's level, HU: soft tissue is near −1 then.
BONE_SCALE = 250.0
# The cavity of the skull is what a ball of this radius fits into, once the way through the great
# foramen (some 36 × 30 mm) is left out, mm.
CAVITY_RADIUS = 19.0
# Ways that a ball of this radius passes join lobes of one brain, mm.
JOINED_RADIUS = 16.0
# A cranial cavity is at least this large, mm³: a third of a child's.
LEAST_CAVITY = 300_000.0
# The part of its surface that is bone; what soft tissue and the image's borders enclose is none. A
# skull that is cut at the brows has 0.92, the mouth in a round field of view 0.78.
LEAST_BOUNDED = 0.85
# Bone partly in a voxel seals a hollow from this part of the way between soft tissue and bone on.
SEAL_PART = 0.6


@dataclass(frozen=True, eq=False)
class Bone:
    """Bone on the working grid.

    hu: (nx, ny, nz) float32. What bone was found in: streaks of metal and vessels are taken out.
    surface: (nx, ny, nz) float32. HU whose surface of bone lies at the threshold: see
        `at_half_height`.
    mask: (nx, ny, nz) bool. Bone and the hollows in it.
    solid: (nx, ny, nz) bool. Bone alone.
    bare: (nx, ny, nz) bool. Pieces as dense as bone that are none: no tissue covers them.
    cavity: (nx, ny, nz) bool or None, where the brain is; None where no skull encloses it in the
        image.
    vessels: (nx, ny, nz) bool or None. Where contrast agent was taken out.
    """

    hu: Volume
    surface: Volume
    mask: Mask
    solid: Mask
    bare: Mask
    cavity: Mask | None
    vessels: Mask | None
    findings: tuple[Finding, ...]


def find_bone(work: Working, metal: Metal, skin: Skin, options: SegmentOptions) -> Bone:
    """The bone of a head.

    Errors
    ------
    ImageError
        (also `ValueError`) No bone at this threshold.
    """
    threshold = options.least_bone
    thin = options.least_skin + float(work.spacing.max())
    under = depth(skin.mask, work.spacing, max(2.0 * options.least_skin, thin))
    hu = metal.hu
    solid = without_streaks(hu > threshold, metal, work.spacing, bone=True)
    solid &= under > options.least_skin
    hu, solid, vessels, noticed = without_vessels(hu, solid, work.spacing)
    solid, bare, islands = _without_islands(solid, under < thin, work, options)
    with ThreadPoolExecutor(1) as beside:
        walls = beside.submit(_walls, hu, solid, under, work, options)
        cavity = _cranial_cavity(solid, skin, work)
        mask = _enclosed(walls.result(), solid, cavity, under, work=work, options=options)
    surface = hu
    if options.bone_threshold is None:
        surface, mask = at_half_height(hu, mask, threshold, BONE_SCALE, work.spacing)
    findings = (*noticed, *islands)
    return Bone(hu, surface, mask, solid & mask, bare, cavity, vessels, findings)


def bone_level(bone: Bone, options: SegmentOptions) -> Volume:
    """The level of all bone."""
    return level_of(bone.surface, options.least_bone, BONE_SCALE, bone.mask)


def _without_islands(
    solid: Mask, outermost: Mask, work: Working, options: SegmentOptions
) -> tuple[Mask, Mask, list[Finding]]:
    """Bone without small pieces and bare ones, and the bare ones."""
    labels, sizes = label(solid, corners=True)
    if len(sizes) == 1:
        raise ImageInputError(
            f"no bone above {options.least_bone:g} HU inside the skin: check that this is a CT "
            "in HU; if it is not, set bone_threshold"
        )
    volumes = sizes * float(np.prod(work.spacing))
    kept = volumes > min(options.island, float(volumes.max()) - 1e-9)
    dropped = float(volumes[~kept].sum())
    # Plastic on the face has air over most of its surface, bone has not: unless none has any tissue
    # over it, as in a dry skull.
    rim = solid & ~shrunk(solid)
    surface, open_to_air = (
        np.bincount(labels[part], minlength=len(sizes)) for part in (rim, rim & outermost)
    )
    is_bare = kept & (2 * open_to_air > surface)
    is_bare &= not is_bare[np.argmax(sizes)]
    kept_mask, bare = chosen(kept & ~is_bare, labels), chosen(is_bare, labels)
    findings = []
    if dropped > options.island:
        findings.append(
            Finding(
                "bone-islands",
                f"{len(sizes) - 1 - np.count_nonzero(kept)} pieces of bone below "
                f"{options.island:g} mm³ each, {dropped / 1000.0:.1f} cm³ together, were dropped",
                where="bone",
            )
        )
    return kept_mask, bare, findings


def _cranial_cavity(solid: Mask, skin: Skin, work: Working) -> Mask | None:
    """The room of the brain, found as a large room with narrow ways out; None if there is none."""
    coarse, steps, shift = coarse_of(solid.astype(np.float32), work.spacing)
    inside, _, _ = coarse_of(skin.mask.astype(np.float32), work.spacing)
    wall: Mask = np.asfortranarray(coarse > 0.25)
    # Where the image cuts the skull, its border is the wall: one more layer all round.
    wide = np.asfortranarray(np.pad(wall, 1, mode="constant", constant_values=False))
    head = np.pad(inside > 0.5, 1, mode="edge")
    rim = np.ones_like(wide)
    rim[1:-1, 1:-1, 1:-1] = False
    sealed = closed(wide, 4.0, steps) | (rim & head)
    room = depth(np.asfortranarray(~sealed), steps)
    labels, sizes = label(room > CAVITY_RADIUS)
    if len(sizes) < 3:
        return None
    outer = np.unique(labels[~head & (labels > 0)])
    sizes[outer] = 0
    brain = int(np.argmax(sizes))
    if not sizes[brain] or not len(outer):
        return None
    # Lobes that more than the great foramen joins are one room.
    wide_rooms, _ = label(room > JOINED_RADIUS)
    joined = wide_rooms == wide_rooms[labels == brain][0]
    if (joined & np.isin(labels, outer)).any():
        joined = labels == brain
    seeds = np.where(joined, 1, np.where(labels > 0, 2, 0))
    # Rooms part where the way between them is narrowest.
    basins = watershed(-room, seeds, ~sealed)
    cavity = (basins == 1)[1:-1, 1:-1, 1:-1]
    if np.count_nonzero(cavity) * float(np.prod(steps)) < LEAST_CAVITY:
        return None
    if not _enclosed_by_skull(cavity, wall):
        return None
    fine = resampled_to(cavity.astype(np.float32), steps, shift, solid.shape, work.spacing)
    return fine > 0.5


def _enclosed_by_skull(cavity: Mask, wall: Mask) -> bool:
    """Whether a room is the brain's: so is the mouth where an image cuts the head."""
    rim = grown(cavity) & ~cavity
    bounded = int(np.count_nonzero(rim & grown(wall)))
    return bounded >= LEAST_BOUNDED * int(np.count_nonzero(rim))


def _walls(hu: Volume, solid: Mask, under: Volume, work: Working, options: SegmentOptions) -> Mask:
    """Bone and what is partly bone, closed: the walls of hollows."""
    seal = options.least_bone - (1.0 - SEAL_PART) * (options.least_bone - SOFT)
    walls = solid | ((hu > seal) & (under > 2.0 * options.least_skin))
    return closed(walls, options.closing, work.spacing)


def _enclosed(
    walls: Mask,
    solid: Mask,
    cavity: Mask | None,
    under: Volume,
    *,
    work: Working,
    options: SegmentOptions,
) -> Mask:
    """Bone with marrow, sinuses and the cranial cavity."""
    if cavity is not None:
        walls = walls | cavity
    labels, sizes = label(~walls)
    outer = np.zeros(len(sizes), dtype=bool)
    outer[labels.T[under.T < 0.0]] = True
    if not outer[1:].any():
        outer[np.argmax(sizes)] = True
    outer[0] = False
    hollows = ~walls & ~chosen(outer, labels)
    if cavity is not None:
        hollows |= cavity
    # Of the closed walls only what bounds a hollow belongs to bone; the rest are outer grooves.
    reach = options.closing + float(work.spacing.max())
    added = walls & (depth(hollows, work.spacing, reach) > -reach)
    mask = solid | hollows | added
    mask &= under > options.least_skin
    return mask


def teeth_level(bone: Bone, work: Working, occlusal_height: float | None) -> Volume | None:
    """The level of what is as dense as enamel near the tooth rows; None if that is little."""
    if occlusal_height is None:
        return None
    z = work.origin[2] + work.spacing[2] * np.arange(work.hu.shape[2])
    near = np.abs(z - occlusal_height) < OCCLUSAL_REACH
    mask = bone.mask & (bone.hu > ENAMEL) & near[None, None, :]
    if np.count_nonzero(mask) * float(np.prod(work.spacing)) < LEAST_TEETH:
        return None
    return level_of(bone.hu, ENAMEL, BONE_SCALE, mask)


def at_half_height(
    hu: Volume, mask: Mask, threshold: float, scale: float, spacing: NDArray[np.float64]
) -> tuple[Volume, Mask]:
    """HU whose surface of bone lies at the threshold, and the mask without what lies outside it.

    Near the surface values are lowered by what half the step exceeds the threshold; the step ends
    at the densest value behind the surface along its normal. Bone less dense than twice the
    threshold stays as it is, as do values farther than `scale` from any such half: no level shows
    a difference there.
    """
    reach = BLUR * float(spacing.max())
    near = np.abs(depth(mask, spacing, reach)) < reach
    near &= (hu > threshold - scale) & (hu < HIGHEST + scale)
    # Borders of the image have no other side.
    for axis in range(3):
        np.moveaxis(near, axis, 0)[[0, -1]] = False
    # By their numbers in the order of memory, which is that of z, y, x.
    voxels, values = np.flatnonzero(near.T), hu.T.reshape(-1)
    index = np.stack(np.unravel_index(voxels, hu.T.shape)[::-1])
    steps = np.cumprod([1, *hu.shape[:2]])
    gradient = np.stack(
        [
            (values[voxels + step] - values[voxels - step]) / (2.0 * width)
            for step, width in zip(steps, spacing, strict=True)
        ]
    )
    inwards = gradient / np.maximum(np.linalg.norm(gradient, axis=0), 1e-6)
    own = values[voxels]
    densest = own.copy()
    sampled = ndimage().map_coordinates

    def values_at(far: float) -> NDArray[np.float32]:
        places = index + inwards * (far * spacing.max() / spacing)[:, None]
        found: NDArray[np.float32] = sampled(hu, places, order=1, mode="nearest")
        return found

    with ThreadPoolExecutor(THREADS) as pool:
        for found in pool.map(values_at, np.arange(SAMPLE, BLUR + 0.5 * SAMPLE, SAMPLE)):
            np.maximum(densest, found, out=densest)
    half = np.clip(0.5 * (SOFT + densest), threshold, max(HIGHEST, threshold))
    lowered = hu.copy(order="F")
    lowered.T.reshape(-1)[voxels] = own - (half - np.float32(threshold)).astype(np.float32)
    # Marrow behind compact bone is low as well: only what is open to the outside is cut.
    low = near & mask & (lowered <= threshold)
    cut = np.zeros_like(mask)
    for _ in range(int(BLUR)):
        cut = low & (hu > threshold) & grown(~mask | cut)
    kept = mask & ~cut
    np.copyto(lowered, hu, where=low & kept)
    return lowered, kept
