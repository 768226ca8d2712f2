"""The parts of the error of an evaluation: those of the scans, and those of a model."""

from collections.abc import Mapping
from typing import Any

from cmfsim.report.document import Note, Table, number

Values = Mapping[str, Any]


def not_operated_blocks(evaluation: Values) -> list[Note | Table]:
    """The error where nothing was operated on; that it is not known, where it is not.

    evaluation: What `metrics.json` holds.
    """
    if "not_operated" not in evaluation:
        return []  # of an earlier version
    found = evaluation["not_operated"]
    if found is None:
        return [
            Note(
                "The error where nothing was operated on is not known, so registration, swelling "
                "and weight cannot be separated from the error of a model.",
                "warning",
            )
        ]
    whole = found["regions"]["whole"]
    return [
        Note(
            f"Where nothing was operated on, the two scans differ by {whole['mean_mm']:.2f} mm "
            f"on average ({whole['signed_mean_mm']:+.2f} mm signed; negative: the face before "
            "lies behind the face after). This comes from registration, swelling or weight. No "
            "model can do better, and smaller differences are not evidence about a model."
        ),
        statistics_table(
            found["regions"],
            "Distance of the pre-operative from the post-operative face where nothing was "
            "operated on, mm.",
        ),
    ]


def thickness_blocks(evaluation: Values) -> list[Note | Table]:
    """The mean errors with the fitted change of thickness; nothing where none was fitted."""
    found = evaluation.get("thickness")
    if found is None:
        return []
    means = found["mean_mm"]
    regions = list(dict.fromkeys(region for table in means.values() for region in table))
    rows = tuple(
        (region, *(number(table.get(region)) for table in means.values())) for region in regions
    )
    share, depth = found["share_of_depth"], found["mean_depth_mm"]
    return [
        Note(
            f"One change of thickness, {100 * share:+.1f} % of the depth of the soft tissue "
            f"({share * depth:+.2f} mm on average there), was fitted where nothing was operated "
            f"on: the mean error there falls from {found['mean_before_mm']:.2f} to "
            f"{found['mean_after_mm']:.2f} mm. It is known only after the operation and is not "
            "part of a prediction."
        ),
        Table(("region", *means), rows, "Mean distance with that change applied, mm."),
    ]


def summary_blocks(evaluation: Values) -> list[Note | Table]:
    """The errors of each model over the whole face, and those of no model."""
    entries = {**evaluation["models"], "no change": evaluation["no_change"]}
    whole = {name: entry["regions"]["whole"] for name, entry in entries.items()}
    return [
        *not_operated_blocks(evaluation)[:1],
        statistics_table(whole, "Distance from the post-operative face, mm.", of="model"),
        *thickness_blocks(evaluation),
    ]


def statistics_table(regions: Mapping[str, Values], caption: str, of: str = "region") -> Table:
    """Statistics of signed distances by region.

    regions: `DistanceStatistics.as_dict()` by region, or by what `of` calls it.
    """
    columns = (of, "mean", "SD", "median", "RMS", "90 %", "95 %", "max", "signed", "< 2 mm")
    keys = ("mean_mm", "std_mm", "median_mm", "rms_mm", "p90_mm", "p95_mm", "max_mm")
    rows = tuple(
        (
            name,
            *(number(values[key]) for key in keys),
            f"{values['signed_mean_mm']:+.2f}",
            f"{100 * values['within']['2 mm']:.0f} %",
        )
        for name, values in regions.items()
    )
    return Table(columns, rows, caption)
