"""How far the plan operator deviates from exact solutions: operator_error.py CASE [CASE …].

For each head and model: the operator about the case's own plan, as it is and corrected by exact
solutions (`cmfsim.corrected_planning`), and plans around it that are solved exactly, every moved
segment by up to 5 mm along each axis and 5° about any axis, every second plan half of that
(`cmfsim.expected_error`); none of these is among those of the correction. Distances over all nodes
of the skin.
"""

import argparse
import os
import platform
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import cmfsim
from benches.scenes.marked import publish
from cmfsim.pipeline.building.stages import BuildOptions
from cmfsim.pipeline.predicting import build_patient
from cmfsim.planning.replanning.corrected import CORRECTIONS

HEAD = (
    "| head | model | tets | skin nodes | operator, s | corrected by, s | plans | exact, s each "
    "| operator alone: mean, worst plan | largest: median plan | 90 % | worst plan "
    "| corrected: mean, worst plan | largest: median plan | 90 % | worst plan |"
)


def row(patient: cmfsim.PatientModel, model: str, options: argparse.Namespace) -> str:
    """The table's row of a head and model."""
    begin = time.perf_counter()
    planning = cmfsim.planning_model(patient, model)
    seconds = time.perf_counter() - begin
    begin = time.perf_counter()
    corrected = cmfsim.corrected_planning(planning, options.corrections)
    spent = time.perf_counter() - begin
    found = [
        cmfsim.expected_error(which, trials=options.plans, seed=options.seed)
        for which in (planning, corrected)
    ]
    solved = [trial for trial in found[0].trials if not trial.failed]
    for alone, with_it in zip(found[0].trials, found[1].trials, strict=True):
        text = alone.failed or (
            f"{alone.distance:.1f} mm away: largest {alone.largest:.3f} mm, "
            f"corrected {with_it.largest:.3f} mm"
        )
        print(f"{patient.name} {model}: {text}", file=sys.stderr, flush=True)
    correction = corrected.correction
    by = "none" if correction is None else f"{len(correction.plans)} plans, {spent:.0f} s"
    return (
        f"| {patient.name} | {model} | {len(np.asarray(planning.patient.scene.tets)):,} "
        f"| {len(planning.columns.offset):,} | {seconds:.1f} | {by} "
        f"| {len(solved)} of {len(found[0].trials)} "
        f"| {np.median([trial.seconds for trial in solved]):.1f} "
        f"| {figures(found[0])} | {figures(found[1])} |"
    )


def figures(found: cmfsim.ExpectedError) -> str:
    """The worst mean, and median, 90 % and worst of the largest errors, mm, as cells."""
    solved = [trial for trial in found.trials if not trial.failed]
    largest = [trial.largest or 0.0 for trial in solved]
    mean = max(trial.mean or 0.0 for trial in solved)
    return (
        f"{mean:.2g} | {np.median(largest):.2g} | {np.percentile(largest, 90):.2g} "
        f"| {max(largest):.2g}"
    )


def main(words: Sequence[str] | None = None) -> int:
    """Prints the table, or fills it into a page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", type=Path, nargs="+", help="case.toml, or its folder")
    parser.add_argument("--plans", type=int, default=8, help="of each head and model")
    parser.add_argument("--corrections", type=int, default=CORRECTIONS, help="plans that correct")
    parser.add_argument("--models", nargs="+", default=["M", "M+S"])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--fill", type=Path, help="page whose table is rewritten")
    options = parser.parse_args(words)
    rows = []
    for path in options.cases:
        patient = build_patient(path, options.models, BuildOptions(check=False))
        for model in options.models:
            rows.append(row(patient, model, options))
            print(rows[-1], file=sys.stderr, flush=True)
    lines = [HEAD, "| --- | --- |" + " ---: |" * 14, *rows]
    text = "\n".join(lines) + (
        f"\n\nmm; seed {options.seed}; {platform.machine()}, {os.cpu_count()} cores, "
        f"RAYON_NUM_THREADS={os.environ.get('RAYON_NUM_THREADS', 'unset')}, "
        f"cmfsim {cmfsim.__version__}.\n"
    )
    publish(options.fill, "operator_error", text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
