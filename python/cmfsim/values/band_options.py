"""The options of a band around a prediction."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from cmfsim.errors import CalibrationError
from cmfsim.values.calibration import Calibration


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
        The calibration cases to use; None uses all of them.
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

    def check(self, models: Sequence[str]) -> None:
        """Refuses a calibration that is not for these models or this coverage.

        Raises
        ------
        CalibrationError
            (also `ValueError`)
        """
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
