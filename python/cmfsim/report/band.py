"""Sections of a report: how far to trust the face, and what causes its errors."""

from collections.abc import Mapping
from typing import Any, TypeAlias

from cmfsim.report.document import Figure, Note, Section
from cmfsim.values.table import NOTHING, Table, number

Values: TypeAlias = Mapping[str, Any]


def not_operated_blocks(evaluation: Values) -> list[Note | Table]:
    """The error where nothing was operated on (of `metrics.json`); or that it is not known."""
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
    """Statistics of signed distances (`DistanceStatistics.as_dict()`) by what `of` says."""
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


# Sources listed by region, those with the largest effect first.
MOST_SOURCES = 12

UNCALIBRATED = (
    "UNCALIBRATED. The half widths are {factor:.2f} standard deviations of the sources that "
    "were considered, for each point separately. They are intended to cover {percent} of faces but "
    "have not been checked on cases with a known outcome, so the true face may be outside more "
    "often. Use a calibration ([band] in the case, or --calibration)."
)
CALIBRATED = (
    "In {percent} of cases like those of the calibration, all of a region is within its band at "
    "the same time: its distance from the predicted skin, along the normal, is at most the half "
    "width everywhere. Calibrated with {file}{note}. Each region is calibrated separately."
)


def band_section(band: Values, figures: list[Figure]) -> Section:
    """The band of one prediction (`SkinBand.as_dict()`), with its picture, where there is one."""
    missing = Note("Not covered by the sources: " + "; ".join(band["not_covered"]) + ".")
    notes = [Note(f"{text}.") for text in band["notes"]]
    statement, widths = band_blocks(band)
    blocks: tuple[Note | Table | Figure, ...] = (
        statement,
        *notes,
        *figures,
        widths,
        _effects(band),
        _priors(band),
        missing,
    )
    return Section(f"How far to trust it ({band['state']})", blocks)


def band_blocks(band: Values) -> tuple[Note, Table]:
    """What the band is worth, and half widths by region, with the calibration of each."""
    percent = f"{100 * band['coverage']:g} %"
    if band["state"] == "uncalibrated":
        text = UNCALIBRATED.format(factor=band["factor_uncalibrated"], percent=percent)
        statement = Note(text, "warning")
    else:
        used = band["calibration"]
        note = f" ({used['note']})" if used["note"] else ""
        statement = Note(CALIBRATED.format(percent=percent, file=used["file"], note=note))
    columns = ("region", "mean", "95 %", "largest", "factor", "n", "holds")
    rows = []
    for name, entry in band["regions"].items():
        cells = [entry[f"half_width_{which}_mm"] for which in ("mean", "p95", "largest")]
        factor = entry["calibration"]
        worth = (NOTHING, NOTHING, "uncalibrated")
        if factor is not None:
            low, high = (100 * factor[f"coverage_{end}_percent"] for end in (5, 95))
            worth = (number(factor["factor"]), str(factor["n"]), f"{low:.0f} to {high:.0f} %")
        rows.append((name, *(number(cell) for cell in cells), *worth))
    caption = (
        "Half the width of the band, mm; the factor on the standard deviation; the number n of "
        "calibration cases; and the share of further cases within the band that n cases can "
        "guarantee (90 % interval)."
    )
    return statement, Table(columns, tuple(rows), caption)


def _effects(band: Values) -> Table:
    """What one standard deviation of each source moves, by region."""
    regions = band["regions"]
    sums: dict[str, float] = {}
    for entry in regions.values():
        for name, size in entry["sources_rms_mm"].items():
            sums[name] = max(sums.get(name, 0.0), size)
    names = sorted(sums, key=lambda name: -sums[name])[:MOST_SOURCES]
    rows = tuple(
        (name, *(number(entry["sources_rms_mm"].get(name)) for entry in regions.values()))
        for name in names
    )
    caption = (
        f"How far one standard deviation of a source moves the skin along its normal, mm (RMS); "
        f"the {len(names)} largest of {len(sums)}."
    )
    return Table(("source", *regions), rows, caption)


def _priors(band: Values) -> Table:
    # Those of a plan are the same for each segment.
    priors = {name.rpartition(": ")[2]: entry for name, entry in band["sources"].items()}
    rows = tuple(
        (name, f"{entry['sd']:g}", entry["unit"], entry["reference"])
        for name, entry in priors.items()
    )
    caption = "Standard deviations assumed for the sources, independent of this patient."
    return Table(("source", "SD", "unit", "from"), rows, caption, numeric=False)
