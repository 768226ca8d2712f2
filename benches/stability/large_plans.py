"""Inverted tets under large plans on heads: large_plans.py CASE [CASE …] [--edge MM].

The cases have the segments maxilla and mandible_body (Le Fort I, sagittal split) or mandible. Each
is built for each plan with hyperelastic kinematics, and solved with that and with linear
kinematics. The table lists the tissue that the plan crushes, which is removed, and the tets
inverted at equilibrium. Exit code 1 if there are any. Processor times include tensors and set-up.
"""

import argparse
import platform
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

import cmfsim
from cmfsim.pipeline.predicting import build_patient
from cmfsim.solving.inversion import least_volume_ratios
from cmfsim.values.case_parts import CaseMotion

# Motion of maxilla and mandible, mm, LPS: y backwards, z up.
PLANS = {
    "maxilla 5 back": ((0, 5, 0), (0, 0, 0)),
    "maxilla 6 up": ((0, 0, 6), (0, 0, 0)),
    "maxilla 8 forward": ((0, -8, 0), (0, 0, 0)),
    "maxilla 5 back, 4 up": ((0, 5, 4), (0, 0, 0)),
    "mandible 8 back": ((0, 0, 0), (0, 8, 0)),
    "mandible 10 forward": ((0, 0, 0), (0, -10, 0)),
    "mandible 2 back, 5 up": ((0, 0, 0), (0, 2, 5)),
    "mandible 8 sideways": ((0, 0, 0), (8, 0, 0)),
    "maxilla 5 forward, mandible 4 back": ((0, -5, 0), (0, 4, 0)),
    "towards each other, 4 each": ((0, 3, -4), (0, 4, 4)),
    "maxilla 4 back, 5 up; mandible 8 forward, 4 up": ((0, 4, 5), (0, -8, 4)),
    "maxilla 6 forward, 3 up; mandible 8 back, 3 up": ((0, -6, 3), (0, 8, 3)),
}
COLUMNS = (
    "| head | model | tets | plan, mm | crushed tets (mm³) | inverted | least volume ratio "
    "| Newton steps | processor s | over linear |"
)


def row(case: cmfsim.Case, model: str, plan: str, tolerance: float) -> tuple[str, int]:
    """The row of a plan, and its number of inverted tets."""
    names = ("maxilla", next(name for name in case.plan if name.startswith("mandible")))
    moves = {
        name: CaseMotion(matrix=cmfsim.rigid_motion(shift), typed=True)
        for name, shift in zip(names, PLANS[plan], strict=True)
        if any(shift)
    }
    options = replace(case.solver, kinematics="hyperelastic", tolerance=tolerance)
    patient = build_patient(replace(case, plan=moves, solver=options), [model])
    crushed = [f.what for f in patient.findings if f.code == "crushed-left-out"]
    words = crushed[0].split() if crushed else ["0", "", "", "0"]
    large = cmfsim.model_scene(patient, model)
    seconds = []
    for options in (large.options, replace(large.options, kinematics="linear")):
        start = time.process_time()
        solver = cmfsim.scene_solver(replace(large, options=options))
        solution = solver.solve(cmfsim.scene_plan(large))
        seconds.append(time.process_time() - start)
        if options.kinematics == "hyperelastic":
            ratios = least_volume_ratios(solver.tensors, solution.all_displacements)
            steps = solution.iterations
    inverted = int(np.count_nonzero(ratios <= 0.0))
    return (
        f"| {case.name} | {model} | {large.n_tets} | {plan} | {words[0]} ({words[3]}) | {inverted} "
        f"| {ratios.min():.3f} | {steps} | {seconds[0]:.1f} | {seconds[0] / seconds[1]:.1f} |"
    ), inverted


def main(words: Sequence[str] | None = None) -> int:
    """Builds and solves all plans; prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", type=Path, nargs="+")
    parser.add_argument("--models", nargs="+", default=["H"])
    parser.add_argument("--edge", type=float, default=7.0, help="mm")
    parser.add_argument("--plans", type=int, nargs="+", default=range(len(PLANS)))
    parser.add_argument("--tolerance", type=float, default=0.1)
    options = parser.parse_args(words)
    rows, total = [COLUMNS, "|---|---|---:|---|---:|---:|---:|---:|---:|---:|"], 0
    for path in options.cases:
        case = cmfsim.Case.load(path)
        case = replace(case, mesh=replace(case.mesh, edge_length=options.edge))
        for model in options.models:
            for number in options.plans:
                line, inverted = row(case, model, list(PLANS)[number], options.tolerance)
                print(line, file=sys.stderr, flush=True)
                rows.append(line)
                total += inverted
    head = f"cmfsim {cmfsim.__version__}, {platform.machine()}; edge {options.edge:g} mm."
    print(head, "", *rows, sep="\n")
    return 1 if total else 0


if __name__ == "__main__":
    sys.exit(main())
