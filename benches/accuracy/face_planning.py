"""Recovers plans from their faces: face_planning.py FOLDER [--plans N] [--truth PATIENT …].

The case is the embedded head with Le Fort I, sagittal split and genioplasty, written into FOLDER.
Random plans of two segments (maxilla, body of the mandible) and of three (with the chin), ±5 mm and
±5° of each number, are searched for from points of the face that the plan operator gives them: 120
points without noise; 30 points with 0.2 mm of noise along each axis. With noise, the covariance of
each search states which directions of its numbers the face determines: those whose deviation is at
most 0.25 (mm or degrees), for which two deviations are 0.5.

With --truth, folders of virtual patients (`cmfsim virtual-patients`): the plan that was operated,
searched for from the face of the other equations, with an operator about no movement at all.
"""

import argparse
import os
import platform
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import cmfsim
from benches.scenes.marked import publish
from cmfsim.lab.virtual.demo import write_demo_case
from cmfsim.pipeline.building.stages import BuildOptions
from cmfsim.pipeline.predicting import build_patient

Motions = Mapping[str, NDArray[np.float64] | cmfsim.MovedSurface]
NUMBERS = ("forwards", "up", "left", "pitch", "yaw", "roll")
SEGMENTS = ("maxilla", "mandible_body", "chin")
SIZE = 5.0
NOISE, DETERMINED = 0.2, 0.25
GENIOPLASTY = """
[[osteotomies]]
procedure = "genioplasty"

[plan.chin]
translation = [0.0, 1.0, 0.5]
"""
HEAD = (
    "| points | noise, mm | prior | plans | worst number | 95 % of numbers "
    "| determined directions | their 95 % | within two deviations | processor s: median | worst |"
)
FREE: dict[str, Any] = {"prior_shift": None, "prior_turn": None, "shift": 60.0, "turn": 60.0}


@dataclass(frozen=True)
class Found:
    """One search: errors of numbers and determined directions; processor time, s."""

    errors: NDArray[np.float64]
    within: NDArray[np.bool_]
    determined: NDArray[np.float64]
    seconds: float


def stated(
    planning: cmfsim.PlanningModel, plan: Motions, names: Sequence[str]
) -> NDArray[np.float64]:
    """The six numbers of each of these segments under a plan, one after the other."""
    skull = planning.patient.landmarks["skull"]
    surfaces = {s.name: np.asarray(s.surface.vertices) for s in planning.patient.segments}
    rows = [
        cmfsim.clinical_motion(name, plan[name], landmarks=skull, vertices=surfaces[name])
        for name in names
    ]
    return np.array([getattr(row, number) for row in rows for number in NUMBERS])


def random_plan(
    planning: cmfsim.PlanningModel, names: Sequence[str], rng: np.random.Generator
) -> dict[str, NDArray[np.float64]]:
    """±5 mm and ±5° of each number of these segments; all others stay."""
    skull = planning.patient.landmarks["skull"]
    plan = {name: np.eye(4) for name in planning.segments}
    for name in names:
        point = cmfsim.clinical_motion(name, np.eye(4), landmarks=skull).point
        assert point is not None  # noqa: S101 (rotations are about a landmark)
        plan[name] = cmfsim.planned_motion(
            point, shift=rng.uniform(-SIZE, SIZE, 3), turn=rng.uniform(-SIZE, SIZE, 3)
        )
    return plan


def search_again(
    planning: cmfsim.PlanningModel, count: int, noise: float, seed: int, *, prior: bool
) -> Found:
    """A random plan, searched for from its own face."""
    rng = np.random.default_rng((seed, int(1e3 * noise)))
    names = SEGMENTS[: 2 + seed % 2]
    plan = random_plan(planning, names, rng)
    follows = np.abs(planning.columns.matrix[..., [9, 10, 11, 21, 22, 23]]).max(axis=(1, 2)) > 0.1
    chosen = rng.choice(np.flatnonzero(follows), count, replace=False)
    points = np.asarray(planning.skin_before.vertices)[chosen]
    goals = points + planning.carried(plan, points) + rng.normal(scale=noise, size=points.shape)
    target = cmfsim.PointTarget(points, goals, std=noise or 0.5)
    search = cmfsim.FaceSearch(names) if prior else cmfsim.FaceSearch(names, **FREE)
    begun = time.process_time()
    found = cmfsim.plan_for_face(planning, [target], search, exact=False)
    seconds = time.process_time() - begun
    off = stated(planning, found.plan, names) - stated(planning, plan, names)
    variance, axes = np.linalg.eigh(found.covariance)
    deviations = np.sqrt(np.diagonal(found.covariance))
    sure = np.sqrt(variance.clip(min=0.0)) <= DETERMINED
    return Found(np.abs(off), np.abs(off) <= 2.0 * deviations, np.abs(axes.T @ off)[sure], seconds)


def table(planning: cmfsim.PlanningModel, plans: int) -> str:
    """The table of all searches."""
    lines = [HEAD, "| ---: | ---: | --- |" + " ---: |" * 8]
    default = f"{cmfsim.FaceSearch().prior_shift:g}"
    rows = ((120, 0.0, True), (120, 0.0, False), (30, NOISE, True), (30, NOISE, False))
    for count, noise, prior in rows:
        found = [search_again(planning, count, noise, seed, prior=prior) for seed in range(plans)]
        errors = np.concatenate([one.errors for one in found])
        sure = np.concatenate([one.determined for one in found])
        within = np.concatenate([one.within for one in found])
        seconds = [one.seconds for one in found]
        noisy = noise > 0.0
        lines.append(
            f"| {count} | {noise:g} | {default if prior else 'none'} | {len(found)} "
            f"| {errors.max():.2g} | {np.percentile(errors, 95):.2g} "
            f"| {f'{len(sure)} of {len(errors)}' if noisy else '-'} "
            f"| {f'{np.percentile(sure, 95):.2g}' if noisy else '-'} "
            f"| {f'{100 * within.mean():.0f} %' if noisy else '-'} "
            f"| {np.median(seconds):.2f} | {max(seconds):.2f} |"
        )
        print(lines[-1], file=sys.stderr, flush=True)
    return "\n".join(lines)


def truth_table(folders: Sequence[Path]) -> str:
    """What is found of the operated plans of virtual patients, from their true faces."""
    lines = [
        "| patient | from | segment | " + " | ".join(NUMBERS) + " |",
        "| --- | --- | --- |" + " ---: |" * 6,
    ]
    for folder in folders:
        patient = build_patient(folder / "case.toml", ("M+S",), BuildOptions(check=False))
        operated = dict(patient.scene.plan)
        still = {name: np.eye(4) for name in operated}
        planning = cmfsim.planning_model(patient, "M+S", reference=still)
        names = [
            name
            for name, motion in operated.items()
            if isinstance(motion, cmfsim.MovedSurface) or not np.array_equal(motion, np.eye(4))
        ]
        before = cmfsim.read_surface(folder / "truth/skin_before.ply")
        exact = cmfsim.read_surface(folder / "truth/skin_exact.ply")
        scanned = cmfsim.read_surface(folder / "truth/skin.ply")
        points, goals = np.asarray(before.vertices), np.asarray(exact.vertices)
        far = np.linalg.norm(goals - points, axis=1) > 0.5
        chosen = np.flatnonzero(far)[:: max(1, int(far.sum()) // 200)]
        wishes: dict[str, cmfsim.PointTarget | cmfsim.SurfaceTarget] = {
            f"{len(chosen)} true points": cmfsim.PointTarget(points[chosen], goals[chosen]),
            "the scanned surface": cmfsim.SurfaceTarget(scanned),
        }
        wanted = stated(planning, operated, names).reshape(-1, 6)
        for name, row in zip(names, wanted, strict=True):
            lines.append(
                f"| {folder.name} | operated | {name} | "
                + " | ".join(f"{v:+.1f}" for v in row)
                + " |"
            )
        for text, wish in wishes.items():
            found = cmfsim.plan_for_face(planning, [wish], cmfsim.FaceSearch(names), exact=False)
            off = stated(planning, found.plan, names).reshape(-1, 6) - wanted
            for name, row in zip(names, off, strict=True):
                cells = " | ".join(
                    f"{v:+.1f} ± {s:.1f}" for v, s in zip(row, found.std[name], strict=True)
                )
                lines.append(f"| | off, from {text} | {name} | {cells} |")
    return "\n".join(lines)


def main(words: Sequence[str] | None = None) -> int:
    """Prints the tables, or fills them into a page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="where the case is written")
    parser.add_argument("--plans", type=int, default=100, help="of each row")
    parser.add_argument("--edge-length", type=float, default=10.0, help="mm")
    parser.add_argument("--model", default="H+S")
    parser.add_argument("--truth", type=Path, nargs="*", default=[], help="virtual patients")
    parser.add_argument("--fill", type=Path, help="page whose tables are rewritten")
    options = parser.parse_args(words)
    made = write_demo_case(options.folder, edge_length=options.edge_length)
    text = made.case.file.read_text(encoding="utf-8")
    made.case.file.write_text(text + GENIOPLASTY, encoding="utf-8")
    patient = build_patient(made.case.file, (options.model,), BuildOptions(check=False))
    planning = cmfsim.planning_model(
        patient, options.model, reference={name: np.eye(4) for name in patient.scene.plan}
    )
    threads = os.environ.get("RAYON_NUM_THREADS", "unset")
    foot = (
        f"\n\nNumbers in mm and degrees; model {options.model}, "
        f"{len(planning.columns.offset):,} nodes on the skin; {platform.machine()}, "
        f"{os.cpu_count()} cores, RAYON_NUM_THREADS={threads}, "
        f"cmfsim {cmfsim.__version__}.\n"
    )
    publish(options.fill, "face_planning", table(planning, options.plans) + foot)
    if options.truth:
        publish(options.fill, "face_planning_truth", truth_table(options.truth) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
