"""Split conformal calibration: how many standard deviations hold a whole region of the face.

The score of a case is its largest |error| over the standard deviation in a region. If the cases are
exchangeable, the score of the next one is at most the k-th smallest of n with probability
k/(n + 1), whatever the distribution (Vovk, Gammerman and Shafer 2005; Lei et al. 2018): with
k = ⌈(n + 1) c⌉ the band factor · sd holds the whole region in at least a share c of cases. It is
simultaneous because the score is a maximum over the region (Diquigiovanni, Fontana and Vantini
2025). Given the calibration cases, the coverage of all further ones follows the beta distribution
with parameters k and n + 1 − k (Vovk 2012).
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.errors import CalibrationError, third_party
from cmfsim.values.calibration import BandFactor
from cmfsim.values.checks import as_floats, as_number

# (n + 1) c of decimal fractions that is a whole number by this margin is one.
ROUNDING = 1e-9
# Share of the distribution of the coverage between the ends of its interval.
INTERVAL = 0.9


def calibrate(scores: ArrayLike, coverage: float) -> BandFactor:
    """The factor on the standard deviation for which the band covers a share of further cases.

    Parameters
    ----------
    scores : (n,) float64
        One for each calibration case, never one for each vertex: the cases are exchangeable.
    coverage : float
        The share of cases that should lie within the band, above 0 and below 1.

    Raises
    ------
    CalibrationError
        (also `ValueError`) Too few scores for the coverage; one that is not finite or below 0.

    Examples
    --------
    >>> import cmfsim
    >>> found = cmfsim.calibrate([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0], 0.9)
    >>> found.factor, found.rank
    (9.0, 9)
    """
    share = _share(coverage)
    values = np.sort(as_floats("scores", scores).ravel())
    n, needed = len(values), cases_needed(share)
    if n < needed:
        raise CalibrationError(
            f"a coverage of {share:.4g} needs at least {needed} calibration cases, and there are "
            f"{n}: add cases, or request at most {n / (n + 1):.4g}"
        )
    if not np.isfinite(values).all() or values[0] < 0.0:
        bad = int(np.flatnonzero(~(np.isfinite(values) & (values >= 0.0)))[0])
        raise CalibrationError(f"score {values[bad]!r} is not a finite number from 0 on")
    rank = math.ceil((n + 1) * share - ROUNDING)
    ends = (0.5 * (1.0 - INTERVAL), 0.5 * (1.0 + INTERVAL))
    special = third_party("scipy.special", "bands are calibrated", "report")
    low, high = special.betaincinv(rank, n + 1 - rank, ends).tolist()
    return BandFactor(float(values[rank - 1]), n, rank, share, (low, high))


def cases_needed(coverage: float) -> int:
    """The smallest number of calibration cases for a coverage: 9 for 90 %, 19 for 95 %.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.cases_needed(0.9), cmfsim.cases_needed(0.95)
    (9, 19)
    """
    share = _share(coverage)
    return max(1, math.ceil(share / (1.0 - share) - ROUNDING))


def covered_interval(factor: BandFactor, tests: int) -> tuple[int, int]:
    """The range of the number of further cases inside the band, with at least 90 % probability.

    The number is beta-binomial: binomial with a p from the beta distribution of the coverage.

    Parameters
    ----------
    factor : BandFactor
    tests : int
        Further cases like those of the calibration.

    Returns
    -------
    (int, int)
        The 5 % and the 95 % quantile.

    Examples
    --------
    >>> import cmfsim
    >>> found = cmfsim.calibrate(list(range(1, 101)), 0.9)
    >>> fewest, most = cmfsim.covered_interval(found, 100)
    >>> fewest < 90 < most
    True
    """
    stats = third_party("scipy.stats", "coverage is compared", "report")
    number = stats.betabinom(tests, factor.rank, factor.n + 1 - factor.rank)
    low, high = number.ppf([0.5 * (1.0 - INTERVAL), 0.5 * (1.0 + INTERVAL)])
    return int(low), int(high)


def region_scores(
    errors: ArrayLike, sd: ArrayLike, regions: Mapping[str, ArrayLike]
) -> dict[str, float]:
    """The score of each region of one case: its largest |error| over the standard deviation.

    Parameters
    ----------
    errors : (k,) float64 or masked array, mm
        Predicted face against the true one, along the normal, at each vertex of the skin; masked
        where it was not measured.
    sd : (k,) float64, mm
        `SkinBand.sd` of the same vertices, above 0.
    regions : mapping of str to (k,) bool or (r,) indices

    Returns
    -------
    dict of str to float
        Regions without a measured vertex are omitted.

    Raises
    ------
    CalibrationError
        (also `ValueError`) Arrays that do not fit, NaN, a standard deviation that is not above 0.

    Examples
    --------
    >>> import cmfsim
    >>> regions = {"chin": [True, True, False]}
    >>> cmfsim.region_scores([0.5, -2.0, 9.0], [1.0, 0.5, 1.0], regions)
    {'chin': 4.0}
    """
    masked: Any = np.ma.asarray(errors)
    known = ~np.ma.getmaskarray(masked)
    values: NDArray[np.float64] = np.ma.filled(masked.astype(np.float64), 0.0)
    deviation = np.asarray(sd, dtype=np.float64)
    if values.ndim != 1 or values.shape != deviation.shape:
        raise CalibrationError(
            f"errors have shape {values.shape} and sd {deviation.shape}: one value is needed for "
            "each vertex of the same skin"
        )
    if not np.isfinite(values).all():
        at = int(np.flatnonzero(~np.isfinite(values))[0])
        raise CalibrationError(f"errors[{at}] is {values[at]!r}: mask what was not measured")
    if not (np.isfinite(deviation) & (deviation > 0.0)).all():
        at = int(np.flatnonzero(~(np.isfinite(deviation) & (deviation > 0.0)))[0])
        raise CalibrationError(f"sd[{at}] is {deviation[at]!r}: a length above 0 mm is needed")
    size = np.abs(values) / deviation
    found = {}
    for name, part in regions.items():
        inside = np.zeros(len(size), dtype=bool)
        inside[np.asarray(part)] = True
        inside &= known
        if inside.any():
            found[name] = float(size[inside].max())
    return found


def _share(coverage: float) -> float:
    share = as_number("coverage", coverage)
    if not 0.0 < share < 1.0:
        raise CalibrationError(
            f"coverage is {share!r}: it must be above 0 and below 1 (90 % is 0.9)"
        )
    return share
