"""Metal of fillings, crowns and plates, and its streaks taken out of a CT."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmfsim.imaging.bones.inpainting import deviations, without_metal
from cmfsim.imaging.morphology import (
    Block,
    Mask,
    Volume,
    as_array,
    as_itk,
    closed,
    depth,
    label,
    opened,
    simpleitk,
)
from cmfsim.imaging.options import METAL, SegmentOptions
from cmfsim.imaging.working_grid import Working
from cmfsim.values.finding import Finding

# Averaging leaves this part of a cut-off value in voxels that hold nothing else.
SATURATED_PART = 0.97
# Images cut off below this show dense bone as bright as metal, HU.
LEAST_SATURATION = 1700.0
# Cut off below this an image shows no teeth either, as synthetic heads do, HU.
LEAST_WINDOW = 1000.0
# Metal of less than this is a point of noise or dense enamel, mm³.
LEAST_METAL = 15.0
# Farther from metal than this, streaks are weaker than bone, and thin bone (the vault) is kept, mm.
FAR_FROM_METAL = 35.0
# Metal shows this much wider than it is, mm.
SPREAD = 1.5
# Streaks that add less than this to the deviation of soft tissue from one value are left, HU.
LEAST_STREAKS = 50.0
# A correction that leaves more than this part of the deviation is not worth its blur.
MOST_LEFT = 0.8
# A head is wider than this where streaks are narrow, mm; voxels left around it.
LEAST_ACROSS = 15.0
RIM = 5
# Air lies below this, tissue above, HU.
TISSUE = -300.0
# Streaks lie in the slices of the metal, and this far above and below, mm.
STREAK_REACH = 3.0
# Streaks are narrow: across them the median over this half width, mm, is what was there.
STREAK_WIDTH = 2.0
# Bone within this of metal is not judged by its width, mm: roots and alveolar walls are thin.
NEAR_METAL = 3.0
# What stands out farther than the second from what a ball of the first can sweep, is a spike; gaps
# up to twice the third are dark streaks; mm.
SKIN_WIDTHS = (3.0, 4.0, 3.0)
BONE_WIDTHS = (1.4, 3.0, 1.5)


@dataclass(frozen=True, eq=False)
class Metal:
    """Metal in an image.

    mask: (nx, ny, nz) bool or None.
    layers: The slices with streaks.
    hu: (nx, ny, nz) float32. The image with streaks reduced in those slices; itself where there are
        none.
    """

    mask: Mask | None
    layers: slice
    hu: Volume
    findings: tuple[Finding, ...]


def cropped(work: Working, metal: Metal, box: Block) -> tuple[Working, Metal]:
    """The image and the metal in a block of the grid."""
    layers = box[2]
    low, high = (
        min(max(place - layers.start, 0), layers.stop - layers.start)
        for place in (metal.layers.start, metal.layers.stop)
    )
    mask = None if metal.mask is None or low == high else np.asfortranarray(metal.mask[box])
    part = work.part(box)
    hu = part.hu if metal.hu is work.hu else np.asfortranarray(metal.hu[box])
    return part, Metal(mask, slice(low, high), hu, metal.findings)


def find_metal(work: Working, options: SegmentOptions) -> Metal:
    """The metal of a head, and the image without its streaks."""
    threshold, noticed = _threshold(work, options)
    bright = work.hu > threshold
    volume = float(np.prod(work.spacing))
    nothing = Metal(None, slice(0, 0), work.hu, noticed)
    if np.count_nonzero(bright) * volume < LEAST_METAL:
        return nothing
    labels, sizes = label(bright, corners=True)
    large = sizes * volume >= LEAST_METAL
    if not large.any():
        return nothing
    mask: Mask = large[labels]
    layers = np.flatnonzero(mask.any(axis=(0, 1)))
    hu, streaked = _corrected(work, mask, layers)
    low, high = (work.origin[2] + work.spacing[2] * layers[i] for i in (0, -1))
    finding = Finding(
        "metal",
        f"{int(np.count_nonzero(large))} pieces of metal, "
        f"{np.count_nonzero(mask) * volume / 1000.0:.1f} cm³ above {threshold:.0f} HU, between "
        f"z = {low:.0f} and {high:.0f} mm; " + _streaks_text(work, streaked),
        where="image",
    )
    return Metal(mask, streaked, hu, (*noticed, finding))


def _streaks_text(work: Working, streaked: slice) -> str:
    if streaked.start == streaked.stop:
        return "it causes no streaks that need correction"
    low, high = (work.origin[2] + work.spacing[2] * k for k in (streaked.start, streaked.stop - 1))
    return (
        f"streaks between z = {low:.0f} and {high:.0f} mm were reduced, and spikes of skin and "
        "bone there were removed"
    )


def _corrected(work: Working, mask: Mask, layers: NDArray[np.intp]) -> tuple[Volume, slice]:
    """The image with streaks reduced, and the slices that had any."""
    box = (*_head_in(work, layers), slice(int(layers[0]), int(layers[-1]) + 1))
    part, own = np.asfortranarray(work.hu[box]), np.asfortranarray(mask[box])
    wide = depth(own, work.spacing, SPREAD) > -SPREAD
    usual = _usual(work, box)
    clean, before, after = without_metal(part, wide, work.spacing, usual)
    bad = (before > np.hypot(usual, LEAST_STREAKS)) & (after < MOST_LEFT * before)
    if not bad.any():
        return work.hu, slice(0, 0)
    hu = work.hu.copy(order="F")
    hu[box] = np.where(bad & ~own, clean, part)
    found = np.flatnonzero(bad) + box[2].start
    more = int(np.ceil(STREAK_REACH / work.spacing[2]))
    zone = slice(max(int(found[0]) - more, 0), min(int(found[-1]) + more + 1, mask.shape[2]))
    part = hu[:, :, zone]
    hu[:, :, zone] = np.where(mask[:, :, zone], part, _median(part, work.spacing))
    return hu, zone


def _head_in(work: Working, layers: NDArray[np.intp]) -> tuple[slice, slice]:
    """Where along x and y the slices show more than streaks."""
    tissue = work.hu[:, :, layers] > TISSUE
    box = []
    for axis in (0, 1):
        step = float(work.spacing[1 - axis])
        found = np.flatnonzero((tissue.sum(axis=1 - axis) * step > LEAST_ACROSS).any(axis=1))
        low, high = (int(found[i]) for i in (0, -1)) if len(found) else (0, tissue.shape[axis])
        box.append(slice(max(low - RIM, 0), high + RIM + 1))
    return box[0], box[1]


def _usual(work: Working, box: Block) -> float:
    """How far soft tissue deviates from one value in slices near the metal, but without it, HU."""
    apart = int(np.ceil(2.0 * STREAK_REACH / work.spacing[2]))
    layers = box[2]
    low = range(layers.start - apart, layers.start - 3 * apart, -1)
    high = range(layers.stop - 1 + apart, layers.stop - 1 + 3 * apart)
    others = [k for k in (*low, *high) if 0 <= k < work.hu.shape[2]]
    if not others:
        return 0.0
    return float(np.median(deviations(work.hu[:, :, others][box[:2]], work.spacing)))


def _threshold(work: Working, options: SegmentOptions) -> tuple[float, tuple[Finding, ...]]:
    """The value above which is metal, and a finding where the image is cut off below the usual."""
    if options.metal_threshold is not None:
        return options.metal_threshold, ()
    cut = SATURATED_PART * work.saturation
    if cut >= METAL:
        return METAL, ()
    sees = cut >= LEAST_SATURATION
    finding = Finding(
        "ct-saturated",
        f"the image is cut off at {work.saturation:.0f} HU, but metal is recognised by "
        f"{METAL:g} HU"
        + (
            f"; voxels from {cut:.0f} HU on were taken for metal"
            if sees
            else ": metal was not searched for"
        ),
        severity="warning" if cut >= LEAST_WINDOW else "note",
        where="image",
        why="metal, enamel and dense bone have the same value there"
        + ("" if sees else ", so metal streaks may remain in skin and bone"),
    )
    return (cut if sees else np.inf), (finding,)


def _median(part: Volume, spacing: NDArray[np.float64]) -> Volume:
    across = [max(1, round(STREAK_WIDTH / s)) for s in spacing[:2]]
    image = simpleitk().Median(as_itk(np.asfortranarray(part), spacing), [*across, 0])
    median: Volume = as_array(image)
    return median


def without_streaks(
    mask: Mask, metal: Metal, spacing: NDArray[np.float64], *, bone: bool = False
) -> Mask:
    """The mask without thin pieces that stand far out from it in the slices of the metal.

    Notches that dark streaks cut into it there are closed.
    """
    if metal.mask is None:
        return mask
    cleaned = mask.copy(order="F")
    radius, reach, notch = BONE_WIDTHS if bone else SKIN_WIDTHS
    part = closed(np.asfortranarray(mask[:, :, metal.layers]), notch, spacing)
    cleaned[:, :, metal.layers] = part
    thick = opened(part, radius, spacing)
    if not thick.any():
        return cleaned
    around = depth(thick, spacing)
    rest = part & (around < -0.5 * float(spacing.max()))
    if bone:
        near = depth(np.asfortranarray(metal.mask[:, :, metal.layers]), spacing)
        rest &= (near < -NEAR_METAL) & (near > -FAR_FROM_METAL)
    labels, sizes = label(rest, corners=True)
    farthest = np.zeros(len(sizes))
    np.maximum.at(farthest, labels[rest], -around[rest])
    cleaned[:, :, metal.layers] &= ~((farthest > reach)[labels] & rest)
    return cleaned
