"""Statistics of distances, and tests of whether models differ (paper 3.2)."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.errors import CaseInputError, third_party
from cmfsim.values.checks import Floats, Plain, as_floats, check_one_of, in_files, plain

PAIRED_BY = ("vertex", "patient")
CAVEATS = {
    "vertex": (
        "neighbouring vertices move together and are not independent samples: p describes this "
        "one face, says nothing about the next patient, and falls with every refinement of the "
        "mesh"
    ),
    "patient": "",
}
# Two-sided 5 %, the level that the caveat of few patients speaks of.
LEVEL = 0.05
# Fewest patients that differ for which the test can reach that level: p is at least 2^(1-n).
LEAST_PAIRS = 6
# Errors up to which a prediction is usually called strict, good, acceptable and lenient, mm.
LIMITS = (1.0, 1.5, 2.0, 3.0)
# A distance is an outlier of a box plot beyond the upper quartile by this many boxes (Tukey 1977).
WHISKER = 1.5
# The figures of distances that are in mm.
LENGTHS = ("mean", "std", "median", "rms", "p90", "p95", "max", "signed_mean", "signed_std")


@dataclass(frozen=True)
class PairedTest(Plain):
    """The outcome of a Wilcoxon signed-rank test (Wilcoxon 1945).

    Attributes
    ----------
    by : str
        What was paired: "vertex" or "patient".
    n : int
        Pairs.
    n_equal : int
        Pairs without a difference, which the test excludes.
    statistic : float
        The smaller sum of ranks.
    p : float
        Two-sided.
    median_difference : float, mm
        Of first minus second: negative, the first has the smaller errors.
    effect : float
        Rank-biserial correlation, −1 (the first is larger in each pair) to 1 (smaller in each).
    caveat : str
        The limits of p; to be printed with it.
    """

    by: str
    n: int
    n_equal: int
    statistic: float
    p: float
    median_difference: float = field(metadata=in_files("median_difference_mm"))
    effect: float
    caveat: str

    def as_dict(self) -> dict[str, Any]:
        """Plain values with their unit in the name, as JSON holds them."""
        return {"test": "Wilcoxon signed-rank, two-sided", **super().as_dict()}


def wilcoxon_test(first: ArrayLike, second: ArrayLike, *, by: str = "vertex") -> PairedTest:
    """The signed-rank test of two sets of errors in pairs.

    Parameters
    ----------
    first, second : (n,) float64, mm
        Errors of two models at the same vertices, or mean errors of the same patients.
    by : str
        "vertex" or "patient": decides the caveat of the outcome.

    Returns
    -------
    PairedTest
        With p = 1 where no pair differs.

    Raises
    ------
    CaseError
        (also `ValueError`) Sets of different length, fewer than one pair, NaN; scipy is missing.

    Notes
    -----
    Wilcoxon (1945), by scipy: exact below 51 pairs without ties, else normal with correction for
    ties. Pairs without a difference are dropped, as Wilcoxon did.

    Examples
    --------
    >>> import cmfsim
    >>> found = cmfsim.wilcoxon_test([1.0, 2.0, 1.5, 2.5], [1.2, 2.3, 1.9, 3.0], by="patient")
    >>> found.p, found.effect
    (0.125, 1.0)
    >>> found.caveat
    '4 pairs cannot give p below 0.125, regardless of the models'
    """
    check_one_of("by", by, PAIRED_BY)
    a, b = as_floats("first errors", first), as_floats("second errors", second)
    if a.ndim != 1 or a.shape != b.shape or not len(a):
        raise CaseInputError(
            f"errors have shapes {a.shape} and {b.shape}: both must be (n,), in pairs, with n "
            "above 0"
        )
    difference = a - b
    n_used = int(np.count_nonzero(difference))
    caveat = CAVEATS[by]
    least = 2.0 ** (1 - n_used)
    if by == "patient" and least > LEVEL:
        caveat = f"{n_used} pairs cannot give p below {min(least, 1.0):g}, regardless of the models"
    statistic, p, effect = 0.0, 1.0, 0.0
    if n_used:
        stats = third_party("scipy.stats", "the signed-rank test is made", "report")
        used = difference[difference != 0.0]
        found = stats.wilcoxon(used, alternative="two-sided", method="auto")
        statistic, p = float(found.statistic), float(found.pvalue)
        ranks = stats.rankdata(np.abs(used))
        effect = float((ranks[used < 0.0].sum() - ranks[used > 0.0].sum()) / ranks.sum())
    if not math.isfinite(p):
        raise CaseInputError(f"the test gave p = {p} for {n_used} pairs: too few to rank")
    return PairedTest(
        by, len(a), len(a) - n_used, statistic, p, float(np.median(difference)), effect, caveat
    )


@dataclass(frozen=True)
class PairedChange:
    """The change of patients' mean errors from one setting to another.

    Attributes
    ----------
    n : int
        Patients who have both.
    first, second : float, mm
        Means of their mean errors, each patient with the same weight.
    interval : (float, float) or None, mm
        95 % confidence interval of the mean change by Student's t; None for one patient.
    n_better : int
        Patients whose error became smaller.
    test : PairedTest or None
        None for fewer than `LEAST_PAIRS` patients whose error changed.
    """

    n: int
    first: float
    second: float
    interval: tuple[float, float] | None
    n_better: int
    test: PairedTest | None

    @property
    def change(self) -> float:
        """Second minus first, mm: negative, the second setting has the smaller errors."""
        return self.second - self.first

    def as_dict(self) -> dict[str, Any]:
        """Plain values with their unit in the name, as JSON holds them."""
        return {
            "n": self.n,
            "first_mm": self.first,
            "second_mm": self.second,
            "change_mm": self.change,
            "interval_mm": plain(self.interval),
            "n_better": self.n_better,
            "test": plain(self.test),
        }


def paired_change(first: ArrayLike, second: ArrayLike) -> PairedChange:
    """The change of mean errors of the same patients from one setting to another.

    Parameters
    ----------
    first, second : (n,) float64, mm
        Mean error of each patient.

    Raises
    ------
    CaseError
        (also `ValueError`) As `wilcoxon_test`.

    Examples
    --------
    >>> import cmfsim
    >>> found = cmfsim.paired_change([1.0, 2.0, 1.5], [0.8, 1.7, 1.1])
    >>> round(found.change, 3), [round(end, 3) for end in found.interval], found.n_better
    (-0.3, [-0.548, -0.052], 3)
    >>> found.test is None
    True
    """
    test = wilcoxon_test(second, first, by="patient")
    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    n, interval = test.n, None
    if n > 1:
        stats = third_party("scipy.stats", "a confidence interval is found", "report")
        half = float(stats.t.ppf(1.0 - 0.5 * LEVEL, n - 1) * np.std(b - a, ddof=1) / math.sqrt(n))
        middle = float((b - a).mean())
        interval = (middle - half, middle + half)
    enough = n - test.n_equal >= LEAST_PAIRS
    better = int(np.count_nonzero(b < a))
    return PairedChange(
        n, float(a.mean()), float(b.mean()), interval, better, test if enough else None
    )


@dataclass(frozen=True)
class DistanceStatistics:
    """Statistics of signed distances; all except the signed figures are of their absolute values.

    Attributes
    ----------
    count : int
    mean, std, median, rms, p90, p95, max : float, mm
        Of |distance|; std about the mean, divided by the count.
    signed_mean, signed_std : float, mm
        Negative: the prediction lies behind the post-operative skin.
    within : mapping of float to float
        Share of |distance| up to each limit, mm.
    quartiles : (float, float), mm
        Of |distance|.
    outliers : int
        Sizes above the upper quartile by more than 1.5 times the distance of the quartiles, as a
        box plot has it (Tukey 1977). They are counted and kept.
    """

    count: int
    mean: float
    std: float
    median: float
    rms: float
    p90: float
    p95: float
    max: float
    signed_mean: float
    signed_std: float
    within: Mapping[float, float]
    quartiles: tuple[float, float]
    outliers: int

    def as_dict(self) -> dict[str, Any]:
        """Plain values with their unit in the name, as JSON holds them."""
        return {
            "count": self.count,
            **{f"{name}_mm": getattr(self, name) for name in LENGTHS},
            "quartiles_mm": list(self.quartiles),
            "outliers": self.outliers,
            "within": {f"{limit:g} mm": share for limit, share in self.within.items()},
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "DistanceStatistics":
        """The statistics from the values that `as_dict` returned.

        Raises
        ------
        CaseError
            (also `ValueError`) A figure is missing.
        """
        try:
            lower, upper = values["quartiles_mm"]
            within = {float(k.removesuffix(" mm")): v for k, v in values["within"].items()}
            return cls(
                **{name: values[name] for name in ("count", "outliers")},
                **{name: values[f"{name}_mm"] for name in LENGTHS},
                within=MappingProxyType(within),
                quartiles=(lower, upper),
            )
        except KeyError as error:
            raise CaseInputError(f"figures of distances lack {error.args[0]!r}") from error


def distance_statistics(
    signed: ArrayLike, *, weights: ArrayLike | None = None
) -> DistanceStatistics:
    """The figures of signed distances.

    Parameters
    ----------
    signed : (k,) float64, mm
    weights : (k,) float64, optional
        Weight of each distance, above 0, such as an area. Equal weights change nothing.

    Raises
    ------
    CaseError
        (also `ValueError`) No distance, NaN, another number of weights, a weight not above 0.

    Notes
    -----
    Quantiles interpolate linearly between the sorted sizes, each placed in the middle of its
    weight; with equal weights this is numpy's default (Hyndman & Fan 1996, type 7).

    Examples
    --------
    >>> import cmfsim
    >>> figures = cmfsim.distance_statistics([-2.0, 0.0, 1.0, 1.0])
    >>> figures.mean, figures.signed_mean, figures.within[1.0], figures.max
    (1.0, 0.0, 0.75, 2.0)
    """
    values = as_floats("signed distances", signed)
    if values.ndim != 1 or not len(values):
        raise CaseInputError(
            f"signed distances have shape {values.shape}: (k,) with at least one is needed"
        )
    weight = _weights(weights, len(values))
    total = float(weight.sum())

    def mean_of(entries: Floats) -> float:
        return float((weight * entries).sum()) / total

    sizes = np.abs(values)
    mean, signed_mean = mean_of(sizes), mean_of(values)
    lower, median, upper, p90, p95 = _quantiles(sizes, weight, (0.25, 0.5, 0.75, 0.9, 0.95))
    return DistanceStatistics(
        count=len(values),
        mean=mean,
        std=math.sqrt(mean_of((sizes - mean) ** 2)),
        median=median,
        rms=math.sqrt(mean_of(sizes**2)),
        p90=p90,
        p95=p95,
        max=float(sizes.max()),
        signed_mean=signed_mean,
        signed_std=math.sqrt(mean_of((values - signed_mean) ** 2)),
        within=MappingProxyType(
            {float(limit): mean_of((sizes <= limit).astype(np.float64)) for limit in LIMITS}
        ),
        quartiles=(lower, upper),
        outliers=int(np.count_nonzero(sizes > upper + WHISKER * (upper - lower))),
    )


def _weights(weights: ArrayLike | None, count: int) -> Floats:
    if weights is None:
        return np.ones(count)
    given = as_floats("weights", weights)
    if given.shape != (count,):
        raise CaseInputError(f"weights have shape {given.shape}: one for each of {count} distances")
    if (given <= 0.0).any():
        index = int(np.flatnonzero(given <= 0.0)[0])
        raise CaseInputError(f"weights[{index}] is {given[index]:g}: must be above 0")
    return given


def _quantiles(sizes: Floats, weight: Floats, wanted: tuple[float, ...]) -> NDArray[Any]:
    order = np.argsort(sizes, kind="stable")
    part = weight[order]
    middle = np.cumsum(part) - 0.5 * part
    span = middle[-1] - middle[0]
    place = (middle - middle[0]) / span if span > 0.0 else np.zeros(len(part))
    return np.array([float(q) for q in np.interp(wanted, place, sizes[order])])
