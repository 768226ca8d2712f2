"""The coverage of the bands of methods, as text: covered patients, and the expected number."""

from collections.abc import Sequence

import numpy as np

from cmfsim.evaluation import cases_needed, covered_interval
from cmfsim.lab.benchmark.bands import COVERAGE
from cmfsim.lab.benchmark.results import REGIONS, MethodResult
from cmfsim.lab.benchmark.tables.markdown import DASH, cell, table

ABOUT = (
    "Number of patients whose true skin lies within the band at all vertices of a region; in "
    "brackets, the range of this number that a band of this calibration has with a probability "
    "of 90 %."
)


def band_sections(results: Sequence[MethodResult], far: Sequence[str]) -> list[str]:
    """Sections for methods with a band; none where no method has one."""
    banded = [result for result in results if result.figures("face", "covered")]
    found = []
    if banded:
        found = [
            f"## Bands of {COVERAGE:.0%}",
            ABOUT,
            table(("", *REGIONS), [row for result in banded for row in _rows(result, far)]),
        ]
    for result in results:
        if result.band is not None and not result.band.factors:
            found.append(
                f"**{result.method}** states standard deviations, but {len(result.band.cases)} "
                f"calibration patients are too few for a band: {cases_needed(COVERAGE)} are "
                "needed."
            )
        elif result.band is not None and result.band.missing:
            names = ", ".join(result.band.missing)
            found.append(f"The band of **{result.method}** is calibrated without {names}.")
    return found


def _rows(result: MethodResult, far: Sequence[str]) -> list[tuple[str, ...]]:
    """Covered patients, those of them far from the models, half-widths and factors."""
    among = [name for name in far if name in result.scores]
    titles = {name: f"{result.method}: {name}" for name in ("covered", "half-width, mm")}
    rows = [
        (titles["covered"], *(_covered(result, region, list(result.scores)) for region in REGIONS))
    ]
    if among:
        title = f"{result.method}: of the {len(among)} farthest from the models"
        rows.append((title, *(_covered(result, region, among) for region in REGIONS)))
    widths = (cell(result.mean(region, "half_width"), "{:.2f}") for region in REGIONS)
    rows.append((titles["half-width, mm"], *widths))
    if result.band is not None:
        factors = [result.band.factors.get(region) for region in REGIONS]
        cells = (DASH if f is None else f"{f.factor:.2f} (n = {f.n})" for f in factors)
        rows.append((f"{result.method}: standard deviations", *cells))
    return rows


def _covered(result: MethodResult, region: str, names: Sequence[str]) -> str:
    """How many of some patients are covered, and how many were to be expected."""
    found = [result.scores[name][region].covered for name in names]
    known = [value for value in found if value is not None]
    if not known:
        return DASH
    text = f"{int(np.count_nonzero(known))} of {len(known)}"
    factor = result.band.factors.get(region) if result.band is not None else None
    if factor is None:
        return text
    low, high = covered_interval(factor, len(known))
    return f"{text} ({low}–{high})"
