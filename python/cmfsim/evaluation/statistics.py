"""Figures that sum up signed distances (paper 3.2, Table 3)."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.errors import CaseInputError
from cmfsim.values.checks import Floats, as_floats

# Errors up to which a prediction is usually called strict, good, acceptable and lenient, mm.
LIMITS = (1.0, 1.5, 2.0, 3.0)
# A distance is an outlier of a box plot beyond the upper quartile by this many boxes (Tukey 1977).
WHISKER = 1.5


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
            "mean_mm": self.mean,
            "std_mm": self.std,
            "median_mm": self.median,
            "rms_mm": self.rms,
            "p90_mm": self.p90,
            "p95_mm": self.p95,
            "max_mm": self.max,
            "signed_mean_mm": self.signed_mean,
            "signed_std_mm": self.signed_std,
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
        plain = ("count", "outliers")
        lengths = ("mean", "std", "median", "rms", "p90", "p95", "max", "signed_mean", "signed_std")
        try:
            lower, upper = values["quartiles_mm"]
            within = {float(k.removesuffix(" mm")): v for k, v in values["within"].items()}
            return cls(
                **{name: values[name] for name in plain},
                **{name: values[f"{name}_mm"] for name in lengths},
                within=MappingProxyType(within),
                quartiles=(lower, upper),
            )
        except KeyError as error:
            raise CaseInputError(f"figures of distances lack {error.args[0]!r}") from error


def distance_statistics(
    signed: ArrayLike, *, weights: ArrayLike | None = None, limits: tuple[float, ...] = LIMITS
) -> DistanceStatistics:
    """The figures of signed distances.

    Parameters
    ----------
    signed : (k,) float64, mm
    weights : (k,) float64, optional
        Weight of each distance, above 0, such as an area. Equal weights change nothing.
    limits : tuple of float, mm
        For the shares within.

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
            {float(limit): mean_of((sizes <= limit).astype(np.float64)) for limit in limits}
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
