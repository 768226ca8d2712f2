"""The data of a band in a planning page, as plain values and arrays."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.planning.replanning import PlanBand


def band_content(band: PlanBand | None) -> tuple[dict[str, Any] | None, dict[str, NDArray[Any]]]:
    """Values and arrays of a band; none where the page has no band.

    Rates in half precision change a half-width by 0.01 mm at most.
    """
    if band is None:
        return None, {}
    known = band.at_reference
    factor = band.factor
    regions = [
        {
            "name": name,
            "factor": known.factors[name].factor if name in known.factors else known.plain_factor,
            "cases": known.factors[name].n if name in known.factors else None,
        }
        for name in known.regions
    ]
    arrays: dict[str, NDArray[Any]] = {
        "band_still": band.still.astype(np.float32),
        "band_shift": band.shift.astype(np.float32),
        "band_rates": band.rates.astype(np.float16),
        # 0 outside of the face, where no band is stated.
        "band_factor": np.nan_to_num(factor, nan=0.0).astype(np.float32),
    }
    for index, part in enumerate(known.regions.values()):
        arrays[f"band_region_{index}"] = np.flatnonzero(part).astype(np.uint32)
    calibration = known.about.get("calibration") or {}
    values = {
        "state": known.state,
        "coverage": known.coverage,
        "regions": regions,
        "note": str(calibration.get("note") or ""),
    }
    return values, arrays
