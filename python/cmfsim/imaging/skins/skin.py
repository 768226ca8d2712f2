"""The outer surface of the head: what lies with it taken away, what opens into it closed."""

from concurrent.futures import Executor, Future
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import ImageInputError
from cmfsim.imaging.bones.metal import Metal, cropped, without_streaks
from cmfsim.imaging.intensities.intensity import AIR, SOFT
from cmfsim.imaging.intensities.levels import level_of
from cmfsim.imaging.morphology import (
    Block,
    Mask,
    Volume,
    box_of,
    closed,
    depth,
    filled,
    label,
    largest,
    ndimage,
    opened,
    reached,
    resampled_to,
    shrunk,
)
from cmfsim.imaging.options import SegmentOptions
from cmfsim.imaging.working_grid import Working, coarse_of
from cmfsim.values.finding import Finding

# Full range of the skin's level, HU: half of the step from air to fat.
SKIN_SCALE = 400.0
# What is darker than this, such as foam or hair, is no tissue, HU.
LEAST_TISSUE = -750.0
# Tissue around a place within this distance, its noise smoothed, mm. What is lost at a fixed level
# is thicker than twice the third, mm, and worth a finding from the fourth on, mm³.
AROUND, AROUND_SIGMA, THICK, LEAST_WEAK = 6.0, 1.0, 2.6, 500.0
# A ball of this radius fits into head and neck, but not into a couch's shell, a head-rest or an
# ear, mm.
CORE_RADIUS = 20.0
# Behind this distance from the middle of the head nothing stands out from it, mm: ears end there.
BEHIND = 32.0
# Layers less than these below the vertex hold no ears, and no muscle of the neck, mm.
ABOVE_EARS = 85.0
ABOVE_NAPE = 115.0
# Scalp with hair pressed on it, mm.
THICKEST_SCALP = 15.0
# Dark streaks as wide as twice this do not part the head, mm.
STREAK_GAP = 5.0
# An ear is no larger than this: what is, and lies beside the head, is a holder; mm³ and mm.
LARGEST_EAR = 25_000.0
FARTHEST_EAR = 45.0
# What stands out behind the head by more than these is a rest, not the nape; mm³ and mm.
REST = 6_000.0
REST_REACH = 12.0
# A couch is wider than this, and its middle farther behind the head's, mm.
COUCH_WIDTH = 60.0
COUCH_BEHIND = 40.0
# Part of the slices in which something fixed to the scanner shows.
IN_ALL_SLICES = 0.9
# Nostrils, ear canals and open lips narrower than twice this are closed, mm.
OPENING = 7.0
# A hollow reaching deeper than this behind the closed surface is airway, not a fold; the closed
# surface is drawn in by the second, so that lips and nostrils keep their edge; mm.
DEEP = 9.0
DRAWN_IN = 3.0
# Hollows behind narrow openings are found on voxels of about this size, mm.
HOLLOW_STEP = 1.6
# Skin beyond these in a straight cut is said to be cut off, mm².
CUT_AREA = 150.0
# Layers of air left round the head, and the multiple of voxels at which its block begins, so that
# coarser voxels made of it are those of the whole grid; voxels.
RIM = 4
ALIGNED = 12
# Heads are this large from vertex to chin at least, mm; lower parts do not count for the middle.
HEAD_HEIGHT = 220.0


@dataclass(frozen=True, eq=False)
class Skin:
    """The head's inside, hollows included, on the block of the working grid that holds it.

    box: The block; outside it nothing is head.
    level_to_come: future of (nx, ny, nz) float32. Computed while other things are found by the
        mask.
    mask: (nx, ny, nz) bool.
    hollow: (nx, ny, nz) bool. Inside and below the skin's threshold.
    """

    box: Block
    level_to_come: "Future[Volume]"
    mask: Mask
    hollow: Mask
    findings: tuple[Finding, ...]

    @property
    def level(self) -> Volume:
        """The level, (nx, ny, nz) float32, once it is there."""
        return self.level_to_come.result()


def find_skin(work: Working, metal: Metal, options: SegmentOptions, beside: Executor) -> Skin:
    """The skin of the head on the working grid; its level is left to the executor.

    Errors
    ------
    ImageError
        (also `ValueError`) Nothing as large as a head.
    """
    coarse, steps, shift = coarse_of(metal.hu, work.spacing)
    weak = weak_tissue(coarse, steps, options.skin_threshold)
    findings = []
    if weak is not None:
        findings.append(_weak(weak))
        coarse = coarse + weak
        raised = resampled_to(weak, steps, shift, work.hu.shape, work.spacing)
        metal = replace(metal, hu=metal.hu + raised)
    tissue = np.asfortranarray(coarse > options.skin_threshold)
    if metal.mask is not None:
        # Dark streaks would cut the head in two.
        tissue = closed(tissue, STREAK_GAP, steps)
    tissue = _filled_in_layers(tissue)
    free, removed = _without_couch(tissue, steps)
    bone = largest(free & (coarse > options.least_bone))
    head, more = _without_rests(free, bone, steps)
    # Off the coarse grid the head is known to a voxel: the threshold places its surface.
    margin = 1.2 * float(steps.max())
    around = depth(head, steps)
    box = _box(around > -margin - float(steps.max()), steps, shift, work)
    work, metal = cropped(work, metal, box)
    shift = shift - work.spacing * np.array([b.start for b in box])
    near = resampled_to(around, steps, shift, work.hu.shape, work.spacing)
    near += np.float32(margin)
    above = without_streaks(metal.hu > options.skin_threshold, metal, work.spacing)
    solid = largest(above & (near > 0.0))
    if not solid.any():
        raise ImageInputError("the image contains no head above the skin's threshold")
    mask, hollow = _with_hollows(solid, work)
    level = beside.submit(_level, metal.hu, options.skin_threshold, near, mask, hollow)
    table = np.count_nonzero(removed | more) * float(np.prod(steps))
    if table > LARGEST_EAR / 5.0:
        findings.append(_rest_removed(table))
    return Skin(box, level, mask, hollow, tuple(findings))


def weak_tissue(hu: Volume, spacing: NDArray[np.float64], threshold: float) -> Volume | None:
    """What is to be added to HU where tissue of the face is too dark; None if none is.

    Cone beams whose field of view ends near the nose show tissue there hundreds of HU below fat.
    Where the fixed level loses tissue by that, the skin lies half-way between air and the densest
    tissue around; everywhere else nothing is added.

    hu: (nx, ny, nz) float32, on voxels of some 2.5 mm.
    spacing: (3,), mm.
    threshold: HU.
    """
    tissue = hu > threshold
    if not tissue.any():
        return None
    rows = tissue.sum(axis=(0, 2))
    middle = int(np.average(np.arange(len(rows)), weights=rows))
    front = np.asfortranarray(hu[:, : middle + 1])
    size = [2 * max(1, round(AROUND / s)) + 1 for s in spacing]
    # Noise of voxels is not what the densest tissue is.
    smooth = ndimage().gaussian_filter(front, AROUND_SIGMA / spacing)
    top = np.minimum(ndimage().maximum_filter(smooth, size=size), SOFT)
    half = 0.5 * (AIR + top)
    # At an ordinary skin voxels between both levels are a shell, which no ball fits into; what is
    # as dark on its own, such as foam, is not attached to a brighter face.
    gained = opened((front > half) & (front <= threshold) & (top > LEAST_TISSUE), THICK, spacing)
    above = tissue[:, : middle + 1]
    gained &= reached(gained | above, above)
    if np.count_nonzero(gained) * float(np.prod(spacing)) < LEAST_WEAK:
        return None
    added = np.where(ndimage().maximum_filter(gained, size=size), threshold - half, 0.0)
    added = np.clip(added, 0.0, threshold - AIR)
    whole = np.zeros(hu.shape, dtype=np.float32, order="F")
    whole[:, : middle + 1] = ndimage().gaussian_filter(added, 0.5 * AROUND / spacing)
    return whole


def _weak(added: Volume) -> Finding:
    return Finding(
        "skin-weak",
        f"tissue at the front of the face is up to {added.max():.0f} HU too dark for a fixed level "
        "of the skin, which was lowered there",
        where="image",
    )


def _level(hu: Volume, threshold: float, near: Volume, mask: Mask, hollow: Mask) -> Volume:
    """The level of the skin: by the image, or by the distance where a rest was cut off."""
    level = level_of(hu, threshold, SKIN_SCALE, mask)
    # Where a rest was cut off in contact, the surface is that of the distance.
    rim = ~hollow & ~shrunk(mask)
    np.minimum(level, np.clip(near, -1.0, 1.0), out=level, where=rim)
    return level


def _box(
    head: Mask, steps: NDArray[np.float64], shift: NDArray[np.float64], work: Working
) -> Block:
    """The block of the working grid that holds the voxels of a coarser one."""
    box = []
    for axis, coarse in enumerate(box_of(head)):
        low, high = shift[axis] + steps[axis] * (np.array([coarse.start, coarse.stop]) - 0.5)
        start = max(int(low / work.spacing[axis]) - RIM, 0) // ALIGNED * ALIGNED
        stop = min(int(high / work.spacing[axis]) + 1 + RIM, work.hu.shape[axis])
        box.append(slice(start, stop))
    return tuple(box)


def _rest_removed(volume: float) -> Finding:
    return Finding(
        "rest-removed",
        f"{volume / 1000.0:.0f} cm³ of couch, pillow or head-rest was removed",
        where="behind or beside the head",
    )


def _filled_in_layers(tissue: Mask) -> Mask:
    """The mask with what each layer encloses: the windpipe would part the throat from the neck."""
    filled = tissue.copy(order="F")
    for k in range(tissue.shape[2]):
        filled[:, :, k] = ndimage().binary_fill_holes(tissue[:, :, k])
    return filled


def _without_couch(tissue: Mask, spacing: NDArray[np.float64]) -> tuple[Mask, Mask]:
    """The mask without the parts that are the same in all slices, and these parts."""
    part = tissue.mean(axis=2)
    always = part > IN_ALL_SLICES
    # The head changes from slice to slice: what shows in some slices tells where it is.
    some = (part > 0.2) & ~always
    labels, count = ndimage().label(always)
    if not count or not some.any():
        return tissue, np.zeros_like(tissue)
    middle = np.nonzero(some)[1].mean()
    couch, in_front = np.zeros_like(always), np.zeros_like(always)
    for i, box in enumerate(ndimage().find_objects(labels)):
        piece = labels == i + 1
        width = (box[0].stop - box[0].start) * spacing[0]
        behind = (np.nonzero(piece)[1].mean() - middle) * spacing[1]
        if behind > COUCH_BEHIND and width > COUCH_WIDTH:
            couch |= piece
        elif -behind > COUCH_BEHIND and width > COUCH_WIDTH:
            in_front |= piece
    # All that lies behind the couch's top belongs to it; patients who lie prone have it in front.
    beyond = np.maximum.accumulate(couch, axis=1)
    beyond |= np.maximum.accumulate(in_front[:, ::-1], axis=1)[:, ::-1]
    gone = tissue & beyond[:, :, None]
    return tissue & ~gone, gone


def _without_rests(tissue: Mask, bone: Mask, spacing: NDArray[np.float64]) -> tuple[Mask, Mask]:
    """The head without pillow and head-holder, and these."""
    head = _core(tissue, spacing)
    column = np.flatnonzero(head.any(axis=(0, 1)))
    low = max(column[0], column[-1] - int(HEAD_HEIGHT / spacing[2]))
    weights = head[:, :, low : column[-1] + 1].sum(axis=(0, 2))
    middle = float(np.average(np.arange(len(weights)), weights=weights))
    y = (np.arange(tissue.shape[1]) - middle) * spacing[1]
    free = tissue & ~_beyond_scalp(tissue, bone, y, spacing)
    head = _core(free, spacing)
    around = depth(head, spacing)
    # The opened head, a voxel wider, is the head; ears, nose and chin stand out from it.
    near = around > -float(spacing.max())
    behind = (y > BEHIND)[None, :, None]
    rest = free & ~near & behind
    out = _standing_out(rest, around, spacing, REST, REST_REACH)
    # At the bottom border the nape widens into the back, and is no rest.
    nape = reached(rest, _bottom(rest))
    nape &= ~_standing_out(nape, around, spacing, np.inf, FARTHEST_EAR)
    kept = free & ~(out & ~nape)
    kept = reached(kept, head)
    beside = kept & ~near & (y > -BEHIND)[None, :, None]
    kept &= ~_standing_out(beside, around, spacing, LARGEST_EAR, FARTHEST_EAR)
    kept = reached(kept, head)
    return kept, tissue & ~kept


def _core(tissue: Mask, spacing: NDArray[np.float64]) -> Mask:
    """The thick part of head and neck."""
    radius = min(CORE_RADIUS, 0.6 * float(depth(tissue, spacing).max()))
    core = opened(tissue, radius, spacing)
    if not core.any():
        raise ImageInputError("the image contains nothing as thick as a head")
    return largest(core)


def _beyond_scalp(
    tissue: Mask, bone: Mask, y: NDArray[np.float64], spacing: NDArray[np.float64]
) -> Mask:
    """The parts behind or next to the skull's vault, farther away than the scalp is thick."""
    nothing = np.zeros_like(tissue)
    layers = np.flatnonzero(bone.any(axis=(0, 1)))
    if not len(layers) or bone[:, :, -1].any():
        # Without the vertex nobody knows which layer lies above the ears.
        return nothing
    down = (layers[-1] - np.arange(bone.shape[2])) * spacing[2]
    beside = (down < ABOVE_EARS)[None, None, :] & (y > 0.0)[None, :, None]
    behind = (down < ABOVE_NAPE)[None, None, :] & (y > BEHIND)[None, :, None]
    # The vault with what it encloses: the skull is a ring in each layer there, which the front
    # closes where the fissures of the orbits open it.
    vault = ndimage().binary_closing(bone, iterations=2) | bone
    for k in np.flatnonzero(down < ABOVE_NAPE):
        ring = vault[:, :, k] | (y <= 0.0)[None, :]
        vault[:, :, k] |= ndimage().binary_fill_holes(ring) & (y > 0.0)[None, :]
    away = -depth(np.asfortranarray(vault), spacing)
    # In front of the ears nothing lies on the scalp, so its thickness is known there.
    skin = tissue & ~ndimage().binary_erosion(tissue)
    skin &= (down < ABOVE_EARS)[None, None, :] & (y < 0.0)[None, :, None]
    thickness = away[skin & (away > 0.0)]
    if not thickness.size:
        return nothing
    scalp = min(float(np.percentile(thickness, 60.0)) + float(spacing.max()), THICKEST_SCALP)
    gone: Mask = (beside | behind) & (away > scalp)
    return tissue & gone


def _bottom(mask: Mask) -> Mask:
    """The voxels of the lowest layer."""
    layer = np.zeros_like(mask)
    layer[:, :, 0] = mask[:, :, 0]
    return layer


def _standing_out(
    rest: Mask, around: Volume, spacing: NDArray[np.float64], volume: float, reach: float
) -> Mask:
    """The pieces above a volume (mm³) or farther out than a reach (mm)."""
    labels, sizes = label(rest)
    if len(sizes) == 1:
        return rest
    large = sizes * float(np.prod(spacing)) > volume
    numbers = labels.T[rest.T]
    farthest = np.full(len(sizes), -np.inf)
    np.maximum.at(farthest, numbers, -around.T[rest.T])
    large |= farthest > reach
    large[0] = False
    gone: Mask = large[labels]
    return gone


def _with_hollows(solid: Mask, work: Working) -> tuple[Mask, Mask]:
    """The head with airway and other hollows, and these."""
    # Hollows behind narrow openings, judged on coarser voxels.
    factors = tuple(max(1, round(HOLLOW_STEP / s)) for s in work.spacing)
    blocks = tuple(slice(f // 2, None, f) for f in factors)
    small = np.asfortranarray(solid[blocks])
    steps = work.spacing * np.array(factors)
    shift = work.spacing * (np.array(factors) // 2)
    sealed = filled(closed(small, OPENING, steps))
    within = depth(sealed, steps)
    inside = resampled_to(within, steps, shift, solid.shape, work.spacing)
    candidate = ~solid & (inside > DRAWN_IN)
    hollow = reached(candidate, candidate & (inside > DEEP))
    mask = solid | hollow
    whole = filled(mask)
    return whole, whole & ~solid
