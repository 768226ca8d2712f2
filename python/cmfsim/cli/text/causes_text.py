"""Terminal text on errors that do not come from any model."""

from collections.abc import Mapping
from typing import Any


def not_operated_line(found: Mapping[str, Any] | None) -> str:
    """The error where nothing was operated on.

    Parameters
    ----------
    found : mapping or None
        "not_operated" of `metrics.json`.
    """
    if found is None:
        return "where nothing was operated on: unknown, because not both scans show these regions"
    whole = found["regions"]["whole"]
    return (
        f"where nothing was operated on: {whole['mean_mm']:.2f} mm on average, "
        f"{whole['signed_mean_mm']:+.2f} signed (registration, swelling, weight; no model)"
    )


def thickness_lines(found: Mapping[str, Any] | None) -> list[str]:
    """The change of thickness that was fitted there, and the errors with it.

    Parameters
    ----------
    found : mapping or None
        "thickness" of `metrics.json`.
    """
    if found is None:
        return []
    share = found["share_of_depth"]
    means = ", ".join(f"{name} {table['whole']:.2f}" for name, table in found["mean_mm"].items())
    change = f"{100 * share:+.1f} % of the depth ({share * found['mean_depth_mm']:+.2f} mm)"
    return [f"  thickness fitted there: {change}; mean errors with it: {means}"]
