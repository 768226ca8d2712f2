"""Which numbers of a CT are air, soft tissue and bone, and the way from them to HU."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.case import Finding
from cmfsim.errors import ImageInputError
from cmfsim.imaging.morphology import Volume

__all__ = ["Calibration", "calibration", "noise_of", "weak_bone"]

# Air by definition, and muscle and brain as scanners show them (25 to 60), HU.
AIR = -1000.0
SOFT = 40.0
# Peaks this near to their nominal value, HU, are those of a CT in HU: scanners differ by 30 in air;
# the soft peak is fat's (−110) in some heads.
AIR_TOLERANCE = 130.0
SOFT_TOLERANCE = 170.0
# Offsets with which scanners store unsigned values.
OFFSETS = (1000.0, 1024.0, 2000.0, 2048.0, 8192.0, 32768.0)
OFFSET_TOLERANCE = 70.0
# Air to soft tissue is 1040 HU, 890 to fat: a distance in this range is that of steps of 1 HU.
UNIT_STEP = (840.0, 1140.0)
# A CT has most of its tissue within this of the soft peak (fat −110 … muscle 60), HU; an MR image
# spreads it over its whole range.
SOFT_SPREAD = 190.0
LEAST_SOFT_PART = 0.45
# More of the tissue than this is bone in no head.
MOST_BONE_PART = 0.45
HISTOGRAM_BINS = 400
# About as many voxels as a histogram needs.
SAMPLE = 2_000_000


@dataclass(frozen=True)
class Calibration:
    """The way to HU: `slope`·value + `offset`, and what was found out on it."""

    slope: float
    offset: float
    findings: tuple[Finding, ...] = ()


def calibration(values: NDArray[Any]) -> Calibration:
    """The calibration of an image, judged by its histogram.

    Errors
    ------
    ImageError
        (also `ValueError`) One value throughout, no air and soft tissue to be told, or the spread
        of an MR image.
    """
    step = max(1, int(np.cbrt(values.size / SAMPLE)))
    sample = values[::step, ::step, ::step].astype(np.float64, copy=False).ravel(order="K")
    low, high = np.percentile(sample, (0.05, 99.95))
    if not high > low:
        raise ImageInputError(
            f"the image is {low:g} nearly throughout: a CT has air, soft tissue and bone"
        )
    if low < AIR - 400.0:
        # Padding outside a round field of view (−2000, −3024) is no air of its own.
        padded = sample < AIR - 400.0
        if padded.any() and not padded.all() and (np.abs(sample - AIR) < AIR_TOLERANCE).any():
            sample = np.maximum(sample, AIR - 100.0)
            low, high = np.percentile(sample, (0.05, 99.95))
    air, soft = _peaks(sample, low, high)
    if abs(air - AIR) <= AIR_TOLERANCE and abs(soft - SOFT) <= SOFT_TOLERANCE:
        result = Calibration(1.0, 0.0)
    elif UNIT_STEP[0] <= soft - air <= UNIT_STEP[1]:
        offset = AIR - air
        usual = min(OFFSETS, key=lambda o: abs(o + offset))
        if abs(usual + offset) <= OFFSET_TOLERANCE:
            offset = -usual
        result = Calibration(1.0, offset, (_not_hu(air, soft, 1.0, offset),))
    else:
        slope = (SOFT - AIR) / (soft - air)
        offset = AIR - slope * air
        result = Calibration(slope, offset, (_not_hu(air, soft, slope, offset),))
    _check_spread(sample * result.slope + result.offset, air, soft)
    return result


def _peaks(sample: NDArray[np.float64], low: float, high: float) -> tuple[float, float]:
    """The values at the peaks of air and of soft tissue."""
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
            f"{low:g} to {high:g}): is it a CT of a head with air around it?"
        )
    air = tops[0]
    # Air's own peak may be double (padding beside air); soft tissue lies well above it.
    above = tops[centres[tops] > centres[air] + 0.08 * (high - low)]
    if not len(above):
        raise ImageInputError(
            f"the image has one peak only, at {centres[air]:g}, in its histogram: is it a CT of a "
            "head with air around it?"
        )
    best = above[np.argmax(smooth[above])]
    # Fat has the larger peak in some heads; muscle and brain lie a tenth of the way above it.
    reach = centres[best] + 0.2 * (centres[best] - centres[air])
    near = above[(above > best) & (centres[above] <= reach) & (smooth[above] > 0.4 * smooth[best])]
    return float(centres[air]), float(centres[near[-1] if len(near) else best])


def _not_hu(air: float, soft: float, slope: float, offset: float) -> Finding:
    return Finding(
        "warning",
        "ct-not-hu",
        f"the image is not in HU: air is at {air:.4g}, soft tissue at {soft:.4g}; taken as HU = "
        f"{slope:.4g}·value {'+' if offset >= 0.0 else '−'} {abs(offset):.4g}",
        where="image",
        why="thresholds of skin and bone are in HU; a guessed scale moves the bone's surface",
        mend="export the CT with its rescale slope and intercept, or check skin and bone by eye",
    )


def _check_spread(hu: NDArray[np.float64], air: float, soft: float) -> None:
    tissue = hu[hu > 0.5 * (AIR + SOFT)]
    near = float(np.mean(np.abs(tissue - SOFT + 30.0) < SOFT_SPREAD))
    bright = float(np.mean(tissue > SOFT + 250.0))
    if near < LEAST_SOFT_PART or bright > MOST_BONE_PART:
        raise ImageInputError(
            f"the image is not like a CT: with air at {air:.4g} and soft tissue at {soft:.4g}, "
            f"{100 * near:.0f} % of the tissue is within {SOFT_SPREAD:g} HU of soft tissue (at "
            f"least {100 * LEAST_SOFT_PART:.0f} % expected) and {100 * bright:.0f} % as bright as "
            f"bone (at most {100 * MOST_BONE_PART:.0f} %). MR images cannot be segmented so"
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
            "warning",
            "bone-weak",
            f"compact bone reaches {compact:.0f} HU only, so that {threshold:g} HU misses much",
            where="image",
            why="thin bone is lost and the skull gets holes",
            mend=f"try bone_threshold = {round(half, -1):.0f}",
        ),
    )
