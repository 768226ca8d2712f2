"""The band of a prediction as the terminal states it."""

from collections.abc import Mapping
from typing import Any

from cmfsim.cli.text.terminal import escaped


def band_lines(band: Mapping[str, Any] | None) -> list[str]:
    """The band of a prediction and its reliability; no lines if there is no band.

    Parameters
    ----------
    band : mapping or None
        `SkinBand.as_dict()`.
    """
    if band is None:
        return []
    percent = f"{100 * band['coverage']:g} %"
    if band["state"] == "uncalibrated":
        times = f"{band['factor_uncalibrated']:.2f} standard deviations"
        lines = [f"  band        UNCALIBRATED: {times}; no case shows that these cover {percent}"]
    else:
        by = band["calibration"]
        note = f" ({escaped(by['note'])})" if by["note"] else ""
        lines = [f"  band        {percent} by region, calibrated with {escaped(by['file'])}{note}"]
    for name, entry in band["regions"].items():
        factor = entry["calibration"]
        worth = ""
        if factor is not None:
            low, high = (100 * factor[f"coverage_{end}_percent"] for end in (5, 95))
            worth = f"; n = {factor['n']}, covers {low:.0f} to {high:.0f} % of further cases"
        lines.append(
            f"    {name:<12} ± {entry['half_width_mean_mm']:.2f} mm on average, "
            f"{entry['half_width_largest_mm']:.2f} at most{worth}"
        )
    return lines
