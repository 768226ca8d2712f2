"""Metal of fillings, crowns and plates, and its streaks taken out of a CT."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
    sizes_of,
)
from cmfsim.imaging.options import METAL, SegmentOptions
from cmfsim.imaging.working import Working
from cmfsim.values.finding import Finding

__all__ = ["Metal", "find_metal", "metal_within", "without_streaks"]

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

    Attributes
    ----------
    mask : (nx, ny, nz) bool or None
    layers : slice
        The slices with streaks.
    hu : (nx, ny, nz) float32
        The image with the median across streaks in those slices; itself where there is no metal.
    findings : tuple of Finding
    """

    mask: Mask | None
    layers: slice
    hu: Volume
    findings: tuple[Finding, ...]


def metal_within(metal: Metal, box: Block) -> Metal:
    """The metal in a block of the grid."""
    layers = box[2]
    low, high = (
        min(max(place - layers.start, 0), layers.stop - layers.start)
        for place in (metal.layers.start, metal.layers.stop)
    )
    mask = None if metal.mask is None or low == high else np.asfortranarray(metal.mask[box])
    return Metal(mask, slice(low, high), np.asfortranarray(metal.hu[box]), metal.findings)


def find_metal(work: Working, options: SegmentOptions) -> Metal:
    """The metal of a head, and the image without its streaks."""
    threshold, noticed = _threshold(work, options)
    bright = work.hu > threshold
    volume = float(np.prod(work.spacing))
    nothing = Metal(None, slice(0, 0), work.hu, noticed)
    if np.count_nonzero(bright) * volume < LEAST_METAL:
        return nothing
    labels, count = label(bright, corners=True)
    large = sizes_of(labels, count) * volume >= LEAST_METAL
    if not large.any():
        return nothing
    mask: Mask = large[labels]
    layers = np.flatnonzero(mask.any(axis=(0, 1)))
    more = int(np.ceil(STREAK_REACH / work.spacing[2]))
    zone = slice(max(int(layers[0]) - more, 0), min(int(layers[-1]) + more + 1, mask.shape[2]))
    hu = work.hu.copy(order="F")
    part = hu[:, :, zone]
    hu[:, :, zone] = np.where(mask[:, :, zone], part, _median(part, work.spacing))
    low, high = (work.origin[2] + work.spacing[2] * layers[i] for i in (0, -1))
    finding = Finding.warning(
        "metal",
        f"{int(np.count_nonzero(large))} pieces of metal, "
        f"{np.count_nonzero(mask) * volume / 1000.0:.1f} cm³ above {threshold:.0f} HU, between "
        f"z = {low:.0f} and {high:.0f} mm",
        where="image",
        why="streaks hide skin and bone at that height; they were smoothed and spikes removed",
        fix="check lips, cheeks and tooth rows by eye",
    )
    return Metal(mask, zone, hu, (*noticed, finding))


def _threshold(work: Working, options: SegmentOptions) -> tuple[float, tuple[Finding, ...]]:
    """The value above which is metal, and a finding where the image is cut off below the usual."""
    if options.metal_threshold is not None:
        return options.metal_threshold, ()
    cut = SATURATED_PART * work.saturation
    if cut >= METAL:
        return METAL, ()
    sees = cut >= LEAST_SATURATION
    finding = Finding(
        severity="warning" if cut >= LEAST_WINDOW else "note",
        code="ct-saturated",
        what=f"the image is cut off at {work.saturation:.0f} HU, and metal is told by {METAL:g} HU"
        + (f"; what reaches {cut:.0f} HU was taken for metal" if sees else ": none was looked for"),
        where="image",
        why="metal, enamel and dense bone have one value there"
        + ("" if sees else ", so that streaks of metal may stay in skin and bone"),
        fix="export the CT with its whole range of values, or set metal_threshold in [image]",
    )
    return (cut if sees else np.inf), (finding,)


def _median(part: Volume, spacing: NDArray[np.float64]) -> Volume:
    across = [max(1, round(STREAK_WIDTH / s)) for s in spacing[:2]]
    image = simpleitk().Median(as_itk(np.asfortranarray(part), spacing), [*across, 0])
    median: Volume = as_array(image)
    return median


def without_streaks(
    mask: Mask,
    metal: Metal,
    spacing: NDArray[np.float64],
    *,
    bone: bool = False,
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
    labels, count = label(rest, corners=True)
    farthest = np.zeros(count + 1)
    np.maximum.at(farthest, labels[rest], -around[rest])
    cleaned[:, :, metal.layers] &= ~((farthest > reach)[labels] & rest)
    return cleaned
