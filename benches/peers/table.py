"""Markdown tables from the JSON of `run.py`: `python table.py results.json`."""

from __future__ import annotations

import json
import sys
from math import exp, log
from pathlib import Path
from statistics import linear_regression, median

STAGES = ("set-up", "assembly", "factor", "solve")
"""The stages that make the total."""
HEADINGS = (
    "peer",
    *(f"{stage} s" for stage in STAGES),
    "total s (min–max)",
    "CPU s",
    "ratio",
    "next plan s",
    "peak MB",
    "difference mm",
)
DASH = "–"
DEFAULT = "cmfsim"
"""The row that the times of others are divided by; where it did not run, the reference."""
IDLE = 0.1
"""Cores that others may keep busy on a machine that still counts as idle."""


def total(run: dict, clock: str = "wall") -> float:
    """Seconds from the case in memory to its displacements in memory."""
    return sum(run[clock].get(stage, 0.0) for stage in STAGES)


def seconds(value: float | None) -> str:
    """Three significant digits at most, a dash for nothing."""
    if value is None:
        return DASH
    return f"{value:.3f}" if value < 1 else f"{value:.2f}" if value < 10 else f"{value:.1f}"


def stage_median(runs: list[dict], stage: str) -> float | None:
    """Median seconds of a stage; None where the peer does not tell it apart."""
    values = [run["wall"][stage] for run in runs if stage in run["wall"]]
    return median(values) if values else None


def row(name: str, runs: list[dict], base: list[dict]) -> list[str]:
    """One peer's line of a size's table."""
    good = [run for run in runs if run["status"] == "ok"]
    if not good:
        status = runs[0]["status"] if runs else "not run"
        return [name, status, *[""] * (len(HEADINGS) - 2)]
    totals = [total(run) for run in good]
    # a round's ratio sees the same state of the machine above and below the line
    ratios = [total(a) / total(b) for a, b in zip(good, base, strict=False)]
    differences = [run["difference_mm"] for run in good if "difference_mm" in run]
    return [
        name,
        *(seconds(stage_median(good, stage)) for stage in STAGES),
        f"{seconds(median(totals))} ({seconds(min(totals))}–{seconds(max(totals))})",
        seconds(median(total(run, "cpu") for run in good)),
        f"{median(ratios):.2f}" if ratios else DASH,
        seconds(stage_median(good, "next plan")),
        f"{median(run['peak_mb'] for run in good):.0f}",
        f"{max(differences):.1e}" if differences else DASH,
    ]


def lines(headings: tuple[str, ...], rows: list[list[str]]) -> list[str]:
    """A markdown table."""
    rule = ["---"] + ["---:"] * (len(headings) - 1)
    return ["| " + " | ".join(cells) + " |" for cells in (list(headings), rule, *rows)]


def growth(sizes: list[dict], name: str) -> tuple[float, float, int] | None:
    """Least-squares fit total = c (tets / 100 000)^k: k, c in seconds, and the number of sizes."""
    points = []
    for size in sizes:
        good = [run for run in size["rounds"].get(name, []) if run["status"] == "ok"]
        if good:
            points.append((log(size["mesh"]["tets"] / 1e5), log(median(map(total, good)))))
    if len(points) < 2:
        return None
    fit = linear_regression(*zip(*points, strict=True))
    return fit.slope, exp(fit.intercept), len(points)


def all_runs(study: dict) -> list[tuple[str, dict]]:
    """Every measurement with its peer's name."""
    return [(n, run) for s in study["sizes"] for n, runs in s["rounds"].items() for run in runs]


def markdown(study: dict) -> str:
    """Header, one table for each size, growth over the sizes, versions."""
    machine, runs = study["machine"], all_runs(study)
    rounds = study["repeat"]
    text = [
        f"{machine['cpu']}, {machine['threads']} of {machine['cores']} cores, commit "
        + f"{machine['commit']}, {machine['date']}; "
        + (f"median of {rounds} interleaved runs." if rounds > 1 else "one run, not a median.")
    ]
    others = [run["other_cores"] for _, run in runs if run.get("other_cores") is not None]
    if others:
        text[0] += f" Other processes used {median(others):.2f} cores"
        text[0] += f" (median of the runs; {max(others):.2f} at most)."
        if median(others) > IDLE:
            text += ["", "The machine was not idle: wall times are disturbed, CPU times less so."]
    for size in study["sizes"]:
        mesh, reference = size["mesh"], size["reference"]
        good = {n: [r for r in runs if r["status"] == "ok"] for n, runs in size["rounds"].items()}
        timed = DEFAULT if good.get(DEFAULT) else reference
        base = good.get(timed, [])
        text += [
            "",
            f"### {mesh['tets']} tets, {mesh['nodes']} nodes, {mesh['fixed']} fixed, "
            + f"{mesh['joined']} joined",
            "",
            f"Ratio: total over that of {timed}. Difference: from {reference}."
            if reference
            else "No direct solver ran, so there is no ratio and no difference.",
            "",
            *lines(HEADINGS, [row(n, r, base) for n, r in size["rounds"].items()]),
        ]
    names = list(dict.fromkeys(name for size in study["sizes"] for name in size["rounds"]))
    fits = {name: fit for name in names if (fit := growth(study["sizes"], name))}
    if fits:
        rows = [[n, f"{k:.2f}", seconds(c), str(count)] for n, (k, c, count) in fits.items()]
        headings = ("peer", "exponent k", "c s", "sizes")
        text += ["", "### Growth: total = c (tets / 100 000)^k", "", *lines(headings, rows)]
    versions = {name: run["version"] for name, run in runs if "version" in run}
    if versions:
        text += ["", "Versions: " + "; ".join(f"{n} {v}" for n, v in versions.items()) + "."]
    return "\n".join(text) + "\n"


if __name__ == "__main__":
    print(markdown(json.loads(Path(sys.argv[1]).read_text())), end="")
