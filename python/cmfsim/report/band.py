"""The section of a report that states how far to trust the face."""

from collections.abc import Mapping
from typing import Any

from cmfsim.report.document import NOTHING, Figure, Note, Section, Table, number

Values = Mapping[str, Any]
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
    """The band of one prediction.

    band: `SkinBand.as_dict()`.
    figures: Its picture, where there is one.
    """
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
