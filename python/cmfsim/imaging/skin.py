"""The outer surface of the head: what lies with it taken away, what opens into it closed."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmfsim.case import Finding
from cmfsim.errors import ImageInputError
from cmfsim.imaging.levels import level_of
from cmfsim.imaging.morphology import (
    Mask,
    Volume,
    closed,
    depth,
    label,
    largest,
    ndimage,
    opened,
    reached,
    resampled_to,
    sizes_of,
)
from cmfsim.imaging.options import SegmentOptions
from cmfsim.imaging.working import Working, coarse_of

__all__ = ["Skin", "find_skin"]

# Full range of the skin's level, HU: half of the step from air to fat.
SKIN_SCALE = 400.0
# A ball of this radius fits into head and neck, but not into a couch's shell, a head-rest or an
# ear, mm.
CORE_RADIUS = 20.0
# Behind this distance from the middle of the head nothing stands out from it, mm: ears end there.
BEHIND = 32.0
# An ear is no larger than this: what is, and lies beside the head, is a holder; mm³ and mm.
LARGEST_EAR = 25_000.0
FARTHEST_EAR = 45.0
# Part of the slices in which something fixed to the scanner shows.
IN_ALL_SLICES = 0.9
# Nostrils, ear canals and open lips narrower than twice this are closed, mm.
OPENING = 5.0
# A hollow reaching deeper than this behind the closed surface is airway, not a fold; the closed
# surface is drawn in by the second, so that lips and nostrils keep their edge; mm.
DEEP = 7.0
DRAWN_IN = 3.0
# Skin beyond these in a straight cut is said to be cut off, mm².
CUT_AREA = 150.0
# Heads are this large from vertex to chin at least, mm; lower parts do not count for the middle.
HEAD_HEIGHT = 220.0


@dataclass(frozen=True, eq=False)
class Skin:
    """The head's inside, hollows included.

    Attributes
    ----------
    level : (nx, ny, nz) float32
    mask : (nx, ny, nz) bool
    hollow : (nx, ny, nz) bool
        Inside and below the skin's threshold.
    findings : tuple of Finding
    """

    level: Volume
    mask: Mask
    hollow: Mask
    findings: tuple[Finding, ...]


def find_skin(work: Working, options: SegmentOptions) -> Skin:
    """The skin of the head on the working grid.

    Errors
    ------
    ImageError
        (also `ValueError`) Nothing as large as a head.
    """
    coarse, steps, shift = coarse_of(work.hu, work.spacing)
    tissue: Mask = coarse > options.skin_threshold
    free, removed = _without_couch(tissue, steps)
    head, more = _without_rests(free, steps)
    # Off the coarse grid the head is known to a voxel: the threshold places its surface.
    margin = 1.2 * float(steps.max())
    near = resampled_to(depth(head, steps), steps, shift, work.hu.shape, work.spacing)
    near += np.float32(margin)
    above = work.hu > options.skin_threshold
    solid = largest(above & (near > 0.0))
    if not solid.any():
        raise ImageInputError("the image holds no head above the skin's threshold")
    mask, hollow = _with_hollows(solid, work)
    level = level_of(work.hu, options.skin_threshold, SKIN_SCALE, mask)
    # Where a rest was cut off in contact, the surface is that of the distance.
    np.minimum(level, near, out=level, where=~hollow)
    findings = []
    table = np.count_nonzero(removed | more) * float(np.prod(steps))
    if table > LARGEST_EAR / 5.0:
        findings.append(_rest_removed(table))
    return Skin(level, mask, hollow, tuple(findings))


def _rest_removed(volume: float) -> Finding:
    return Finding(
        "note",
        "rest-removed",
        f"{volume / 1000.0:.0f} cm³ of couch, pillow or head-rest was taken away",
        where="behind or beside the head",
        why="where it touched, the skin is drawn from the head's shape, not from the image",
        mend="check the back of the head by eye if it matters",
    )


def _without_couch(tissue: Mask, spacing: NDArray[np.float64]) -> tuple[Mask, Mask]:
    """What is left without that which shows alike in all slices behind the head; and that."""
    nothing = np.zeros_like(tissue)
    always = tissue.mean(axis=2) > IN_ALL_SLICES
    labels, count = ndimage().label(always)
    if count < 2:
        return tissue, nothing
    thickness = ndimage().distance_transform_edt(
        np.pad(always, 1, mode="edge"), sampling=spacing[:2]
    )[1:-1, 1:-1]
    numbers = np.arange(1, count + 1)
    thickest = ndimage().maximum(thickness, labels, numbers)
    places = ndimage().center_of_mass(always, labels, numbers)
    widths = [
        (box[0].stop - box[0].start) * spacing[0] for box in ndimage().find_objects(labels)
    ]
    # Neck and head show in all slices too: they are the foremost thing that is thick.
    thick = [i for i in range(count) if thickest[i] > CORE_RADIUS]
    if not thick:
        return tissue, nothing
    neck = min(thick, key=lambda i: places[i][1])
    behind = [
        i for i in range(count) if i != neck and places[i][1] > places[neck][1] and widths[i] > 60.0
    ]
    if not behind:
        return tissue, nothing
    couch = np.isin(labels, [i + 1 for i in behind])
    couch = ndimage().binary_dilation(couch) & ~(labels == neck + 1)
    # All that lies behind the couch's top belongs to it.
    from_top = np.maximum.accumulate(couch, axis=1)
    gone = tissue & from_top[:, :, None]
    return tissue & ~gone, gone


def _without_rests(tissue: Mask, spacing: NDArray[np.float64]) -> tuple[Mask, Mask]:
    """The head without pillow and head-holder, and these."""
    inside = depth(tissue, spacing)
    radius = min(CORE_RADIUS, 0.6 * float(inside.max()))
    core = opened(tissue, radius, spacing)
    labels, count = label(core)
    if not count:
        raise ImageInputError("the image holds nothing as thick as a head")
    head = labels == np.argmax(sizes_of(labels, count))
    column = np.flatnonzero(head.any(axis=(0, 1)))
    low = max(column[0], column[-1] - int(HEAD_HEIGHT / spacing[2]))
    upper = head[:, :, low : column[-1] + 1]
    weights = upper.sum(axis=(0, 2))
    middle = float(np.average(np.arange(len(weights)), weights=weights))
    y = (np.arange(tissue.shape[1]) - middle) * spacing[1]
    around = depth(head, spacing)
    step = float(spacing.max())
    # Nothing stands out behind: the opened head, a voxel wider, is the head there.
    allowed = (around > -step) | (y < BEHIND)[None, :, None]
    kept = reached(tissue & allowed, head)
    rest = kept & ~(around > -step)
    labels, count = label(rest)
    boxes = ndimage().find_objects(labels.T)
    sizes = sizes_of(labels, count) * float(np.prod(spacing))
    drop = np.zeros(count + 1, dtype=bool)
    reaches = -ndimage().minimum(around.T, labels.T, np.arange(1, count + 1)) if count else []
    for i in range(count):
        begin, end = boxes[i][1].start, boxes[i][1].stop
        in_front = y[begin] < -BEHIND and y[end - 1] < 0.0
        behind = y[end - 1] > BEHIND - 1.5 * step
        large = sizes[i + 1] > LARGEST_EAR or reaches[i] > FARTHEST_EAR
        drop[i + 1] = not in_front and large and (behind or reaches[i] > FARTHEST_EAR)
    kept &= ~drop[labels]
    return kept, tissue & ~kept


def _with_hollows(solid: Mask, work: Working) -> tuple[Mask, Mask]:
    """The head with airway and other hollows, and these."""
    # Hollows behind narrow openings, judged on voxels of about 1.6 mm.
    factors = tuple(max(1, int(1.6 / s)) for s in work.spacing)
    blocks = tuple(slice(f // 2, None, f) for f in factors)
    small = np.asfortranarray(solid[blocks])
    steps = work.spacing * np.array(factors)
    shift = work.spacing * (np.array(factors) // 2)
    sealed = _filled(closed(small, OPENING, steps))
    within = depth(sealed, steps)
    inside = resampled_to(within, steps, shift, solid.shape, work.spacing)
    candidate = ~solid & (inside > DRAWN_IN)
    hollow = reached(candidate, candidate & (inside > DEEP))
    mask = solid | hollow
    filled = _filled(mask)
    return filled, filled & ~solid


def _filled(mask: Mask) -> Mask:
    """The mask with every hollow that does not reach the front, back or sides of the image.

    The bottom and the top are no way out: trachea and neck are cut there.
    """
    labels, count = label(~mask)
    outside = np.zeros(count + 1, dtype=bool)
    for face in (labels[0], labels[-1], labels[:, 0], labels[:, -1]):
        outside[np.unique(face)] = True
    outside[0] = False
    return ~outside[labels]
