"""What models and kinematics cost on a real head: head_models.py CASE [--markdown PAGE].

The case is built once. The four models are solved one after another, as `cmfsim evaluate` solves
them, then M+S with hyperelastic kinematics at two tolerances and close to its own solution. Each
solve includes tensors and set-up. The first solve of a process, whose memory is new, is not timed.
"""

import argparse
import platform
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import cmfsim
from benches.scenes.marked import publish
from cmfsim.pipeline.predicting import build_patient
from cmfsim.values.prediction import MODELS

NAME = "benches/speed/head_models.py"
TOLERANCES = (0.2, 0.1)
CONVERGED = 1e-4
# What counts as the same face, mm.
SAME = 0.02


@dataclass(frozen=True)
class Solved:
    """A solution with its wall time and processor time, s."""

    displacements: NDArray[np.float64]
    iterations: int
    wall: float
    processor: float


def solved(scene: cmfsim.Scene, repeat: int) -> Solved:
    """The scene, solved several times: median times."""
    times = []
    for _ in range(repeat):
        wall, processor = time.perf_counter(), time.process_time()
        result = cmfsim.solve_scene(scene)
        times.append((time.perf_counter() - wall, time.process_time() - processor))
    wall, processor = np.median(times, axis=0)
    iterations = int(result.summary["iterations"])
    return Solved(result.displacements, iterations, float(wall), float(processor))


def four_models(patient: cmfsim.PatientModel, repeat: int) -> list[str]:
    """A row for each model and one for all of them."""
    scenes = {model: cmfsim.model_scene(patient, model) for model in MODELS}
    cmfsim.solve_scene(scenes["M+S"])
    found = {model: solved(scene, repeat) for model, scene in scenes.items()}
    base = found["M+S"]
    rows = [
        "| model | iterations | wall s | processor s | processor s over M+S |",
        "|---|---:|---:|---:|---:|",
    ]
    rows += [
        f"| {model} | {one.iterations} | {one.wall:.2f} | {one.processor:.2f} "
        f"| {one.processor / base.processor:.2f} |"
        for model, one in found.items()
    ]
    wall = sum(one.wall for one in found.values())
    processor = sum(one.processor for one in found.values())
    total = f"| all four | | {wall:.2f} | {processor:.2f} | {processor / base.processor:.2f} |"
    return [*rows, total]


def large_deformation(patient: cmfsim.PatientModel, repeat: int) -> list[str]:
    """A row for each tolerance of hyperelastic M+S: time, and distance from its own solution."""
    scene = cmfsim.model_scene(patient, "M+S")
    linear = solved(scene, repeat)

    def hyperelastic(tolerance: float, count: int) -> Solved:
        options = replace(scene.options, kinematics="hyperelastic", tolerance=tolerance)
        return solved(replace(scene, options=options), count)

    found = {f"hyperelastic, {value:g}": hyperelastic(value, repeat) for value in TOLERANCES}
    exact = hyperelastic(CONVERGED, 1)
    found = {"linear": linear, **found, f"hyperelastic, {CONVERGED:g}": exact}
    columns = (
        "| M+S, tolerance | Newton steps | wall s | processor s | over linear "
        f"| beyond {SAME:g} mm, % | skin: 99.9 %, mm | skin: largest, mm |"
    )
    rows = [columns, "|---|---:|---:|---:|---:|---:|---:|---:|"]
    for name, one in found.items():
        off = np.linalg.norm(one.displacements - exact.displacements, axis=1)
        skin = off[patient.skin_nodes]
        steps = "–" if name == "linear" else str(one.iterations)
        rows.append(
            f"| {name} | {steps} | {one.wall:.2f} | {one.processor:.2f} "
            f"| {one.processor / linear.processor:.1f} | {100 * np.mean(off > SAME):.3f} "
            f"| {np.percentile(skin, 99.9):.4f} | {skin.max():.4f} |"
        )
    return rows


def main() -> None:
    """Builds the case, solves it, and prints or publishes the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("case", type=Path)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--markdown", type=Path)
    options = parser.parse_args()
    patient = build_patient(cmfsim.Case.load(options.case), MODELS)
    head = (
        f"cmfsim {cmfsim.__version__}, {platform.machine()}; "
        f"{len(patient.scene.tets)} tets; median of {options.repeat} solves."
    )
    parts = [
        head,
        "\n".join(four_models(patient, options.repeat)),
        "\n".join(large_deformation(patient, options.repeat)),
    ]
    publish(options.markdown, NAME, "\n\n".join(parts))


if __name__ == "__main__":
    main()
