"""The values of air, soft tissue and bone, whether they are those of a CT, and their HU."""

from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import ImageInputError
from cmfsim.imaging.morphology import (
    Mask,
    Volume,
    closed,
    depth,
    filled,
    largest,
    opened,
    shown_region,
)
from cmfsim.values.finding import Finding
from cmfsim.values.shown_region import ShownRegion

# Bone is brighter than this above soft tissue, HU.
BRIGHT = 250.0
# The layer below the skin that holds fat but little bone, and where depth begins, mm.
BELOW_SKIN = (1.0, 4.0)
DEEP = 7.0
# How many times as much of the layer as of what lies deeper is bright: in CTs 1.0 at most, in an MR
# image weighted by T1 1.6.
MOST_BRIGHT = 1.3
# The part of what lies deeper that is as dark as air: sinuses and airways measure up to 0.04, and
# compact bone of an MR image is dark as well, 0.12.
MOST_DARK = 0.07
# Openings of airways that are closed, and sheets and tubes that are no head, mm.
CLOSING, OPENING = 12.0, 3.0

# Air by definition, and muscle and brain as scanners show them (25 to 60), HU.
AIR = -1000.0
SOFT = 40.0
# Values are HU, or HU with a usual offset, where air lies this near to its nominal value, and soft
# tissue in this range (fat is at −110), HU; where it is known to be muscle, in the second one.
AIR_TOLERANCE = 60.0
ANY_SOFT, MUSCLE = (-140.0, 85.0), (-20.0, 85.0)
# Air at −1000 is that of a CT: soft tissue so near to its nominal value may be plastic's, HU.
SOFT_TOLERANCE = 170.0
# Offsets with which scanners store unsigned values; none counts as one.
OFFSETS = (0.0, 1000.0, 1024.0, 2000.0, 2048.0, 8192.0, 32768.0)
# A CT has most of its tissue within this of the soft peak (fat −110 … muscle 60), HU; an MR image
# spreads it over its whole range.
SOFT_SPREAD = 190.0
LEAST_SOFT_PART = 0.45
# Of the tissue of a head at least and at most this is bone; an MR image shows bone dark.
LEAST_BONE_PART = 0.01
MOST_BONE_PART = 0.45
HISTOGRAM_BINS = 400
# As many voxels and mm³ at the largest value, and more than in this range below it (HU), were cut
# off there.
LEAST_PLATEAU = 8
LEAST_SATURATED = 15.0
BELOW_SATURATED = 100.0
# Expected errors at the surface of bone, HU: of an offset that scanners use, at least; and which
# are clear.
OFFSET_ERROR, CLEAR = 10.0, 40.0
# Fat (−110 HU) lies in this part of the way from air to muscle; where the image shows both peaks,
# or so little (of the peak) where muscle would lie above fat, neither is taken for the other. Half
# of their distance is the error otherwise, carried to bone.
FAT_PART, ABOVE_FAT, LEAST_MUSCLE = (0.82, 0.91), (1.12, 1.22), 0.2
BOTH_ERROR, ONE_ERROR = 40.0, 110.0
# With a stated scale, air lies within this of −1000 HU.
STATED_TOLERANCE = 250.0
# What to do where the histogram misleads.
STATE_IT = (
    "If it is a CT, state how its values convert to HU, so that cmfsim need not guess: rescale "
    "= [1, 0] in [image] for HU, [1, -1024] for values that are 1024 too large"
)
# About as many voxels as a histogram needs.
SAMPLE = 500_000
# Edge, in voxels, of the blocks whose means a histogram counts: cone-beam scanners show noise of
# 100 to 200 HU, which smears the peaks of single voxels and hardly those of 27.
BLOCK = 3


@dataclass(frozen=True)
class Calibration:
    """The conversion to HU, `slope`·value + `offset`, with findings.

    `error` is that expected at the surface of bone, HU; 0 where the values are HU or stated.
    `has_air` tells whether air lies at −1000 in the values as they are: no MR image has that.
    """

    slope: float
    offset: float
    findings: tuple[Finding, ...] = ()
    error: float = 0.0
    has_air: bool = False

    @property
    def is_clear(self) -> bool:
        """Whether nobody needs to be asked: bone's surface moves by a twentieth of a voxel."""
        return self.error <= CLEAR


def calibration(values: NDArray[Any], stated: tuple[float, float] | None = None) -> Calibration:
    """The calibration of an image, padding left out, as `calibration_within` gives it."""
    return calibration_within(values, shown_region(values), stated)


def calibration_within(
    values: NDArray[Any], shown: ShownRegion | None, stated: tuple[float, float] | None
) -> Calibration:
    """The calibration of an image: as stated, or judged by its histogram.

    Padding does not count.

    Errors
    ------
    ImageError
        (also `ValueError`) One value throughout, no air and soft tissue to be told, or the spread
        of an MR image; no air where a stated scale puts it.
    """
    sample = _means(values, shown)
    low, high = np.percentile(sample, (0.05, 99.95))
    if not high > low:
        raise ImageInputError(
            f"the image is {low:g} nearly throughout: a CT has air, soft tissue and bone"
        )
    if stated is not None:
        return _stated(sample, *stated)
    padded = sample < AIR - 400.0
    # Padding outside a field of view has one value (−2000, −3024), and is no air of its own.
    if padded.any() and np.mean(sample[padded] == sample.min()) > 0.5:
        within = sample[~padded]
        if within.size and (result := _judged(within)).has_air and not result.findings:
            return result
    return _judged(sample)


def _judged(sample: NDArray[np.float64]) -> Calibration:
    low, high = np.percentile(sample, (0.05, 99.95))
    air, soft, is_muscle = _peaks(sample, low, high)
    offset = -min(OFFSETS, key=lambda o: abs(air - o - AIR))
    least, most = MUSCLE if is_muscle else ANY_SOFT
    is_near = abs(air + offset - AIR) <= AIR_TOLERANCE
    has_air = is_near and offset == 0.0
    slope = (SOFT - AIR) / (soft - air)
    # What the two peaks say of bone beside what the values do, where they are HU but for an offset.
    apart = abs((slope - 1.0) * (BRIGHT - AIR))
    if is_near and least <= soft + offset <= most:
        error = max(OFFSET_ERROR, 0.5 * apart * is_muscle) if offset else 0.0
        result = Calibration(1.0, offset, error=error)
    elif has_air and abs(soft - SOFT) <= SOFT_TOLERANCE:
        # Plastic, or another scale about air.
        result = Calibration(1.0, 0.0, error=apart)
    else:
        error = BOTH_ERROR if is_muscle else ONE_ERROR
        result = Calibration(slope, AIR - slope * air, error=error)
    if (result.slope, result.offset) != (1.0, 0.0):
        result = replace(result, findings=(_not_hu(air, soft, result),))
    odd = _odd_spread(sample * result.slope + result.offset, air, soft)
    if not odd and has_air and result.error:
        odd = f"its soft tissue is at {soft:.0f} HU, so bone may be {result.error:.0f} HU off"
    if odd and not has_air:
        raise ImageInputError(
            f"the image does not look like a CT: {odd}. An MR image cannot be used: give the CT "
            f"series. {STATE_IT}"
        )
    unusual = (_unusual(odd),) if odd else ()
    return replace(result, findings=(*result.findings, *unusual), has_air=has_air)


def _means(values: NDArray[Any], shown: ShownRegion | None) -> NDArray[np.float64]:
    """The means of blocks throughout what an image shows, or of voxels where it is thinner."""
    edges = [min(BLOCK, n) for n in values.shape]
    step = max(1, int(np.cbrt(values.size / SAMPLE)))
    starts = [range(0, n - e + 1, step) for n, e in zip(values.shape, edges, strict=True)]
    # In the order of the values, so that they are passed in that of memory.
    firsts = tuple(slice(s.start, s.stop, step) for s in starts)
    total = np.zeros_like(values[firsts], dtype=np.float64)
    for shift in product(*(range(e) for e in edges)):
        places = (
            slice(first, n - e + first + 1, step)
            for first, n, e in zip(shift, values.shape, edges, strict=True)
        )
        total += values[tuple(places)]
    if shown is not None:
        blocks = np.stack(np.meshgrid(*starts, indexing="ij"), axis=-1).reshape(-1, 3)
        total = total.ravel()[shown.depth(blocks.astype(np.float64)) > 2.0 * BLOCK]
    means: NDArray[np.float64] = total.ravel() / np.prod(edges)
    return means


def _stated(sample: NDArray[np.float64], slope: float, intercept: float) -> Calibration:
    """A scale that the case states, where it puts the darkest voxels near air."""
    hu = slope * sample + intercept
    # Padding lies below air.
    air = float(np.median(hu[hu <= np.percentile(hu, 10.0)]))
    if air > AIR + STATED_TOLERANCE or float(hu.max()) < SOFT:
        raise ImageInputError(
            f"with the stated rescale ({slope:g}·value {intercept:+g}) the image has HU from "
            f"{hu.min():.0f} to {hu.max():.0f}, and its darkest tenth lies at {air:.0f}: a CT of a "
            "head has air at −1000 and bone above 250; correct rescale in [image]"
        )
    return Calibration(slope, intercept)


def saturation_of(values: NDArray[Any], voxel: float, scale: Calibration) -> float:
    """The value at which the brightest voxels were cut off, HU; infinite where they were not.

    values: Of the image as read: averages would hide a common value.
    voxel: mm³.
    """
    top = values.max()
    count = int(np.count_nonzero(values == top))
    if count < LEAST_PLATEAU or count * voxel < LEAST_SATURATED:
        return np.inf
    below = float(top) - BELOW_SATURATED / scale.slope
    near = int(np.count_nonzero(values > below)) - count
    return scale.slope * float(top) + scale.offset if count > near else np.inf


def _peaks(sample: NDArray[np.float64], low: float, high: float) -> tuple[float, float, bool]:
    """The values at the peaks of air and soft tissue, and whether that is known to be muscle."""
    counts, edges = np.histogram(np.clip(sample, low, high), bins=HISTOGRAM_BINS)
    centres = 0.5 * (edges[1:] + edges[:-1])
    kernel = np.hanning(9)
    smooth = np.convolve(counts, kernel / kernel.sum(), mode="same")
    inner = np.r_[0.0, smooth, 0.0]
    tops = np.flatnonzero((inner[1:-1] >= inner[:-2]) & (inner[1:-1] > inner[2:]))
    # The clipped tail of metal and bone at the very top is no peak.
    tops = tops[(smooth[tops] > 0.01 * smooth.max()) & (tops < HISTOGRAM_BINS - 5)]
    if len(tops) < 2:
        raise ImageInputError(
            "the image has no separate peaks of air and soft tissue in its histogram (values "
            f"{low:g} to {high:g}): a CT of a head with air around it is needed. {STATE_IT}"
        )
    air = tops[0]
    # Air's own peak may be double (padding beside air); soft tissue lies well above it.
    above = tops[centres[tops] > centres[air] + 0.08 * (high - low)]
    if not len(above):
        raise ImageInputError(
            f"the image has only one peak, at {centres[air]:g}, in its histogram: a CT of a head "
            f"with air around it is needed. {STATE_IT}"
        )
    best = above[np.argmax(smooth[above])]
    # Fat has the larger peak in some heads; muscle and brain lie a tenth of the way above it.
    reach = centres[best] + 0.2 * (centres[best] - centres[air])
    near = above[(above > best) & (centres[above] <= reach) & (smooth[above] > 0.4 * smooth[best])]
    soft = near[-1] if len(near) else best
    part = (centres - centres[air]) / (centres[soft] - centres[air])
    least = LEAST_MUSCLE * smooth[soft]
    has_fat = (part[above] > FAT_PART[0]) & (part[above] < FAT_PART[1]) & (smooth[above] > least)
    is_alone = (smooth[(part > ABOVE_FAT[0]) & (part < ABOVE_FAT[1])] < least).all()
    return float(centres[air]), float(centres[soft]), bool(has_fat.any() or is_alone)


def _not_hu(air: float, soft: float, scale: Calibration) -> Finding:
    sign = "+" if scale.offset >= 0.0 else "−"
    return Finding(
        "ct-not-hu",
        f"the image is not in HU: air is at {air:.4g}, soft tissue at {soft:.4g}; converted as "
        f"HU = {scale.slope:.4g}·value {sign} {abs(scale.offset):.4g}, to within "
        f"{scale.error:.0f} HU at the surface of bone",
        where="image",
        why="thresholds of skin and bone are in HU; an error in the guessed scale moves the "
        "surface of the bone",
        fix="state the scale in the case file (rescale = [slope, intercept] in [image]), or "
        "export the CT with its scale; check skin and bone visually",
    )


def _odd_spread(hu: NDArray[np.float64], air: float, soft: float) -> str:
    """What is unlike a CT of a head in the values of its tissue; empty if nothing is."""
    tissue = hu[hu > 0.5 * (AIR + SOFT)]
    near = float(np.mean(np.abs(tissue - SOFT + 30.0) < SOFT_SPREAD))
    bright = float(np.mean(tissue > SOFT + 250.0))
    if near >= LEAST_SOFT_PART and LEAST_BONE_PART <= bright <= MOST_BONE_PART:
        return ""
    return (
        f"with air at {air:.4g} and soft tissue at {soft:.4g}, {100 * near:.0f} % of the tissue is "
        f"within {SOFT_SPREAD:g} HU of soft tissue (at least {100 * LEAST_SOFT_PART:.0f} % "
        f"expected) and {100 * bright:.1f} % as bright as bone ({100 * LEAST_BONE_PART:.0f} to "
        f"{100 * MOST_BONE_PART:.0f} %)"
    )


def _unusual(odd: str) -> Finding:
    return Finding(
        "ct-unusual",
        f"the image has air as a CT does, but not the tissue of a living head: {odd}",
        where="image",
    )


def noise_of(hu: Volume) -> float:
    """The noise's standard deviation, HU, from second differences along x in soft tissue."""
    part = hu[:, ::2, ::2]
    middle = part[1:-1]
    soft = np.abs(middle - SOFT) < 200.0
    if np.count_nonzero(soft) < 1000:
        return 0.0
    # The variance of a − 2b + c is 6 times that of independent voxels; the median rejects edges.
    second = np.abs(part[:-2] - 2.0 * middle + part[2:])[soft]
    return float(1.4826 * np.median(second) / np.sqrt(6.0))


def weak_bone(hu: Volume, threshold: float) -> tuple[Finding, ...]:
    """A finding with another threshold where the scan's compact bone is hardly above this one."""
    bright = hu[hu > 0.4 * threshold + 0.6 * SOFT]
    if bright.size < 1000:
        return ()
    compact = float(np.percentile(bright, 90.0))
    half = 0.5 * (SOFT + compact)
    if half >= 0.9 * threshold:
        return ()
    return (
        Finding(
            "bone-weak",
            f"compact bone reaches only {compact:.0f} HU, so a threshold of {threshold:g} HU "
            "misses much of it",
            where="image",
            facts={"threshold": round(half, -1)},
        ),
    )


def check_is_ct(hu: Volume, spacing: NDArray[np.float64]) -> None:
    """Refuses an MR image: bright below the skin rather than deeper, and dark where bone is.

    hu: (nx, ny, nz) float32. As calibrated, on voxels of some 2 mm.
    spacing: (3,), mm.
    """
    tissue: Mask = np.asfortranarray(hu > 0.5 * (AIR + SOFT))
    thick = opened(tissue, OPENING, spacing)
    if not thick.any():
        return
    inwards = depth(filled(largest(closed(thick, CLOSING, spacing))), spacing)
    low, high = BELOW_SKIN
    shell, inside = (inwards > low) & (inwards < high), inwards >= DEEP
    if not (shell.any() and inside.any()):
        return
    bright = [float((hu[part] > SOFT + BRIGHT).mean()) for part in (shell, inside)]
    dark = float((hu[inside] < 0.5 * (AIR + SOFT)).mean())
    if bright[0] > MOST_BRIGHT * bright[1] and dark > MOST_DARK:
        raise ImageInputError(
            f"the image does not look like a CT: {100 * bright[0]:.0f} % of the layer below the "
            f"skin is as bright as bone, {100 * bright[1]:.0f} % of what lies deeper, and "
            f"{100 * dark:.0f} % of that is as dark as air. An MR image cannot be used: give the "
            f"CT series. {STATE_IT}"
        )
