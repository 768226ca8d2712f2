"""How far the plan operator deviates from exact solutions: operator_error.py CASE [CASE …].

For each head and model: the operator about the case's own plan, and plans around it that are solved
exactly, every moved segment by up to 5 mm along each axis and 5° about any axis, every second plan
half of that (`cmfsim.expected_error`). Distances over all nodes of the skin.
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
from cmfsim.pipeline.building.stages import BuildOptions
from cmfsim.pipeline.predicting import build_patient
from marked import publish

HEAD = (
    "| head | model | tets | skin nodes | segments | operator, s | plans | exact, s each "
    "| mean, worst plan | 95 %, worst plan | largest: median plan | worst plan |"
)


def row(patient: cmfsim.PatientModel, model: str, trials: int, seed: int) -> str:
    """The table's row of a head and model."""
    begin = time.perf_counter()
    planning = cmfsim.planning_model(patient, model)
    seconds = time.perf_counter() - begin
    found = cmfsim.expected_error(planning, trials=trials, seed=seed)
    solved = [trial for trial in found.trials if not trial.failed]
    for trial in found.trials:
        text = trial.failed or (
            f"{trial.distance:.1f} mm away: mean {trial.mean:.4f}, largest {trial.largest:.3f} mm"
        )
        print(f"{patient.name} {model}: {text}", file=sys.stderr, flush=True)
    largest = [trial.largest or 0.0 for trial in solved]
    return (
        f"| {patient.name} | {model} | {len(np.asarray(planning.patient.scene.tets)):,} "
        f"| {len(planning.columns.offset):,} | {len(planning.segments)} | {seconds:.1f} "
        f"| {len(solved)} of {len(found.trials)} "
        f"| {np.median([trial.seconds for trial in solved]):.1f} "
        f"| {max(trial.mean or 0.0 for trial in solved):.1g} "
        f"| {max(trial.p95 or 0.0 for trial in solved):.1g} "
        f"| {np.median(largest):.1g} | {max(largest):.1g} |"
    )


def main(words: Sequence[str] | None = None) -> int:
    """Prints the table, or fills it into a page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", type=Path, nargs="+", help="case.toml, or its folder")
    parser.add_argument("--plans", type=int, default=8, help="of each head and model")
    parser.add_argument("--models", nargs="+", default=["M", "M+S"])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--fill", type=Path, help="page whose table is rewritten")
    options = parser.parse_args(words)
    rows = []
    for path in options.cases:
        patient = build_patient(path, options.models, BuildOptions(check=False))
        for model in options.models:
            rows.append(row(patient, model, options.plans, options.seed))
            print(rows[-1], file=sys.stderr, flush=True)
    lines = [HEAD, "| --- | --- |" + " ---: |" * 10, *rows]
    text = "\n".join(lines) + (
        f"\n\nmm; seed {options.seed}; {platform.machine()}, {os.cpu_count()} cores, "
        f"RAYON_NUM_THREADS={os.environ.get('RAYON_NUM_THREADS', 'unset')}, "
        f"cmfsim {cmfsim.__version__}.\n"
    )
    publish(options.fill, "operator_error", text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
