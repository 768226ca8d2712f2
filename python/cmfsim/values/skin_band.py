"""A band around a predicted skin, calibrated or not, and its options."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CalibrationError
from cmfsim.values.calibration import BandFactor, Calibration, settings_digest
from cmfsim.values.checks import Floats, Frozen

# The region that holds the others: what lies in none of them has its factor.
WHOLE_FACE = "face"


@dataclass(frozen=True)
class BandOptions:
    """The options of a band.

    Attributes
    ----------
    coverage : float
        Share of cases that should lie within it, region by region: above 0, below 1.
    calibration : Calibration or None
        None makes an uncalibrated band.
    group : str or None
        The calibration cases to use; None uses all of them, and an uncalibrated band has none.
    source : str
        Where the calibration comes from, for the report: the name of its file.
    """

    coverage: float = 0.9
    calibration: Calibration | None = None
    group: str | None = None
    source: str = ""

    def __post_init__(self) -> None:
        if not 0.0 < self.coverage < 1.0:
            raise CalibrationError(
                f"coverage is {self.coverage!r}: it must be above 0 and below 1 (90 % is 0.9)"
            )
        if self.group is not None and self.calibration is None:
            raise CalibrationError(
                f"group is {self.group!r}, but there is no calibration with cases to choose: give "
                "one (--calibration, or calibration in [band]), or leave the group out"
            )

    def check(self, models: Sequence[str]) -> None:
        """Refuses, by a `CalibrationError`, a calibration of other models or another coverage."""
        found = self.calibration
        if found is None:
            return
        for model in models:
            if found.model != model:
                raise CalibrationError(
                    f"the calibration is for model {found.model}, but the prediction uses "
                    f"{model}: predict with --model {found.model}, or calibrate with {model}"
                )
        if found.coverage is not None and not math.isclose(found.coverage, self.coverage):
            raise CalibrationError(
                f"the calibration is for a coverage of {found.coverage:g}, but {self.coverage:g} "
                "was requested"
            )


@dataclass(frozen=True, eq=False)
class SkinBand(Frozen):
    """A band around a predicted skin, along its normals.

    Attributes
    ----------
    coverage : float
        Asked for: 0.9 for 90 %.
    sd : (k,) float64, mm
        Standard deviation of the skin along its normal, at each of its vertices.
    parts : mapping of str to (k,) float64, mm
        By source: how far one standard deviation of it moves the skin along its normal.
    regions : mapping of str to (k,) bool
        Of the face; empty where no landmarks place them.
    factors : mapping of str to BandFactor
        By region; empty without a calibration.
    plain_factor : float
        The factor on `sd` without a calibration: that of a normal distribution, at one point. It is
        not verified that it gives the requested coverage.
    settings : mapping of str to plain values
        What the band depends on besides the case: `band_settings`.
    about : mapping of str to plain values
        Sources with priors, what is not covered, the calibration, seconds.
    """

    coverage: float
    sd: Floats
    parts: Mapping[str, Floats]
    regions: Mapping[str, NDArray[np.bool_]]
    factors: Mapping[str, BandFactor]
    plain_factor: float
    settings: Mapping[str, Any]
    about: Mapping[str, Any] = field(default_factory=dict)

    @property
    def calibrated(self) -> bool:
        """Whether the half width is supported by cases with a known outcome."""
        return bool(self.factors)

    @property
    def state(self) -> str:
        """Either "calibrated" or "uncalibrated"."""
        return "calibrated" if self.calibrated else "uncalibrated"

    @cached_property
    def half_width(self) -> Any:
        """Half the width of the band at each vertex, (k,) numpy masked array, mm.

        A vertex has the factor of its region, or that of the face if it is in no region. Outside
        the face it is masked, because no calibration case has data there. Without a calibration,
        the half width is the same multiple of `sd` everywhere.
        """
        if not self.calibrated:
            return np.ma.array(self.plain_factor * self.sd, mask=np.zeros(len(self.sd), dtype=bool))
        factor = np.full(len(self.sd), np.nan)
        for name in sorted(self.factors, key=lambda name: name != WHOLE_FACE):
            factor[self.regions[name]] = self.factors[name].factor
        known = np.isfinite(factor)
        return np.ma.array(np.where(known, factor, 0.0) * self.sd, mask=~known)

    @property
    def array_names(self) -> tuple[str, str]:
        """The names of `sd` and `half_width` in files: unit, coverage and state are in them."""
        percent = f"{100.0 * self.coverage:g}".replace(".", "p")
        end = "" if self.calibrated else "_uncalibrated"
        return f"band_sd_mm{end}", f"band_half_width_{percent}_percent_mm{end}"

    def arrays(self) -> dict[str, Floats]:
        """The standard deviation and the half width by their names; NaN outside of the face."""
        sd, half = self.array_names
        return {sd: self.sd, half: np.ma.filled(self.half_width, np.nan)}

    def as_dict(self) -> dict[str, Any]:
        """Plain values with units in their names, as JSON holds them; no arrays."""
        everywhere = {"skin": np.ones(len(self.sd), dtype=bool)}
        return {
            "state": self.state,
            "coverage": self.coverage,
            "factor_uncalibrated": None if self.calibrated else self.plain_factor,
            "settings_digest": settings_digest(self.settings),
            "settings": dict(self.settings),
            "regions": {
                name: self._of(part, self.factors.get(name))
                for name, part in (self.regions or everywhere).items()
                if part.any() and (not self.calibrated or name in self.factors)
            },
            **self.about,
        }

    def _of(self, part: NDArray[np.bool_], factor: BandFactor | None) -> dict[str, Any]:
        # A region has its own factor everywhere, also where a smaller one has another.
        times = self.plain_factor if factor is None else factor.factor
        half = times * self.sd[part]
        return {
            "half_width_mean_mm": float(half.mean()),
            "half_width_p95_mm": float(np.percentile(half, 95)),
            "half_width_largest_mm": float(half.max()),
            "sd_mean_mm": float(self.sd[part].mean()),
            "calibration": None if factor is None else factor.as_dict(),
            "sources_rms_mm": {
                name: float(np.sqrt(np.mean(np.square(values[part]))))
                for name, values in self.parts.items()
            },
        }
