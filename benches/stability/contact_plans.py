"""Solves random plans with sliding contact on heads: contact_plans.py CASE [CASE …] --plans 200.

Each plan moves one or more segments of the case by up to 10 mm along each axis and up to 8° about
any axis; plans whose bones would pass through each other are drawn again. The table lists how many
plans converge and in how many Newton steps. With --nearby N, the first N plans of each model are
also solved with 0.01 mm more motion, and once more starting from the solution of the previous plan.
The table has the largest resulting change of the skin, and the number of plans for which it is
larger than allowed. Where lips touch, the steps are rounds of contact between them, and the gap is
the largest depth of tissue in tissue or bone. Exit code 1 if a plan does not converge.
"""

import argparse
import itertools
import os
import platform
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import cmfsim
from benches.scenes.marked import publish

Floats = NDArray[np.float64]
Plan = dict[str, Floats]

# Tries to find a plan whose bones keep clear of each other.
MOST_DRAWS = 20_000
# Points of a bone at which its depth in another is looked at.
SAMPLES = 3000
HEAD = (
    "| head | model | tets | sliding | plans | converged | steps: median | P95 | most "
    "| largest gap, µm | 0.01 mm more: skin, mm (over 0.05) | other start: skin, mm (over 0.001) |"
)
# More motion of a plan whose skin should move hardly more, mm.
NEARBY = 0.01
# How much more is a jump, and how far apart ends of one plan may lie, mm.
JUMP = 0.05
APART = 1e-3


@dataclass
class Tally:
    """What came of the plans of one model of one head."""

    head: str
    model: str
    tets: int
    sliding: int
    steps: list[int] = field(default_factory=list)
    gaps: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    nearby: list[float] = field(default_factory=list)
    restarted: list[float] = field(default_factory=list)

    def row(self) -> str:
        """The table's row."""
        n = len(self.steps) + len(self.failures)
        steps = np.array(self.steps or [0])
        return (
            f"| {self.head} | {self.model} | {self.tets:,} | {self.sliding} | {n} "
            f"| {len(self.steps)} | {np.median(steps):g} | {np.percentile(steps, 95):.0f} "
            f"| {steps.max()} | {1e3 * max(self.gaps, default=0.0):.1g} "
            f"| {_most(self.nearby, JUMP)} | {_most(self.restarted, APART)} |"
        )


def _most(distances: Sequence[float], limit: float) -> str:
    if not distances:
        return "–"
    over = sum(d > limit for d in distances)
    return f"{max(distances):.2g} ({over} of {len(distances)})"


class Jaws:
    """Bones of a head as they move: whether a plan drives them through each other."""

    def __init__(self, model: cmfsim.PatientModel, overlap: float) -> None:
        self.overlap = overlap
        self.surfaces: dict[str, cmfsim.Surface] = {}
        self.points: dict[str, Floats] = {}
        for segment in model.segments:
            mesh = segment.surface
            self.surfaces[segment.name] = cmfsim.Surface(mesh.vertices, mesh.triangles)
            vertices = np.asarray(mesh.vertices)
            self.points[segment.name] = vertices[:: -(-len(vertices) // SAMPLES)]
        rest = {name: np.eye(4) for name in self.surfaces}
        self.before = {pair: self._depth(*pair, rest) for pair in self._pairs()}

    def _pairs(self) -> Iterator[tuple[str, str]]:
        return itertools.permutations(self.surfaces, 2)

    def _depth(self, one: str, other: str, plan: Mapping[str, Floats]) -> float:
        """How deep a bone lies in another, mm."""
        back = np.linalg.inv(plan.get(other, np.eye(4))) @ plan.get(one, np.eye(4))
        points = self.points[one] @ back[:3, :3].T + back[:3, 3]
        inside = self.surfaces[other].winding_number(points) > 0.5
        if not inside.any():
            return 0.0
        nearest = self.surfaces[other].closest(points[inside])[0]
        return float(np.linalg.norm(nearest - points[inside], axis=1).max())

    def clear(self, plan: Mapping[str, Floats]) -> bool:
        """Whether no bone passes more than the allowed overlap deeper into another than at rest."""
        for pair in self._pairs():
            if np.array_equal(plan.get(pair[0], np.eye(4)), plan.get(pair[1], np.eye(4))):
                continue
            if self._depth(*pair, plan) > self.before[pair] + self.overlap:
                return False
        return True


def _stays(motion: Floats | cmfsim.MovedSurface) -> bool:
    return not isinstance(motion, cmfsim.MovedSurface) and np.allclose(motion, np.eye(4))


def draw(
    model: cmfsim.PatientModel, count: int, reach: tuple[float, float], overlap: float, seed: int
) -> list[Plan]:
    """Random plans: each segment that the case's plan moves stays or goes."""
    rng = np.random.default_rng(seed)
    jaws = Jaws(model, overlap)
    nodes = np.asarray(model.scene.nodes)
    segments = model.scene.segments
    movable = [n for n, m in model.scene.plan.items() if not _stays(m)]
    centres = {
        n: nodes[np.concatenate([segments[n].joined, segments[n].sliding])].mean(axis=0)
        for n in movable
    }
    plans: list[Plan] = []
    for _ in range(MOST_DRAWS):
        if len(plans) == count:
            break
        chosen = [n for n in movable if rng.random() < 0.7] or [rng.choice(movable)]
        plan = {name: np.eye(4) for name in segments}
        for name in chosen:
            way = rng.uniform(-reach[0], reach[0], 3)
            axis = rng.normal(size=3)
            angle = float(rng.uniform(-reach[1], reach[1]))
            plan[name] = cmfsim.rigid_motion(tuple(way), angle, tuple(axis), tuple(centres[name]))
        if jaws.clear(plan):
            plans.append(plan)
    return plans


def run(tally: Tally, scene: cmfsim.Scene, plans: Sequence[Plan]) -> None:
    """Solves the plans; each failure is printed."""
    solver = cmfsim.scene_solver(scene)
    for k, plan in enumerate(plans):
        begin = time.process_time()
        try:
            found = solver.solve(plan)
        except cmfsim.CmfsimError as error:
            tally.failures.append(f"plan {k}: {error}")
            print(f"{tally.head} {tally.model} plan {k}: {error}", file=sys.stderr, flush=True)
            continue
        tally.seconds.append(time.process_time() - begin)
        gap = max(found.contact_gap, found.penetration)
        if not (found.contact_converged and found.touching_converged):
            tally.failures.append(f"plan {k}: gap {gap:.1e} mm")
            print(f"{tally.head} {tally.model} {tally.failures[-1]}", file=sys.stderr, flush=True)
            continue
        tally.steps.append(found.touching_rounds or found.contact_iterations)
        tally.gaps.append(gap)


def run_nearby(
    tally: Tally, scene: cmfsim.Scene, skin: NDArray[np.uint32], plans: Sequence[Plan], seed: int
) -> None:
    """Solves plans with a little more motion, and from the solution of the plan before.

    `skin`: nodes whose displacements are compared.
    """
    solver = cmfsim.scene_solver(scene)
    rng = np.random.default_rng(seed)
    before = None
    for plan in plans:
        here = solver.solve(plan)
        name = str(rng.choice([n for n, m in plan.items() if not _stays(m)]))
        way = rng.normal(size=3)
        more = cmfsim.rigid_motion(tuple(NEARBY * way / np.linalg.norm(way))) @ plan[name]
        tally.nearby.append(_apart(here, solver.solve({**plan, name: more}), skin))
        if before is not None:
            tally.restarted.append(_apart(here, solver.solve(plan, start=before), skin))
        before = here


def _apart(one: cmfsim.Solution, other: cmfsim.Solution, nodes: NDArray[np.uint32]) -> float:
    """Largest distance of one of `nodes` in one solution from where it is in another, mm."""
    between = (one.displacements - other.displacements)[nodes]
    return float(np.linalg.norm(between, axis=1).max())


def main(words: Sequence[str] | None = None) -> int:
    """The exit code; prints the table, or fills it into a page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", type=Path, nargs="+", help="case.toml, or its folder")
    parser.add_argument("--plans", type=int, default=200, help="of each head, half of each model")
    parser.add_argument("--models", nargs="+", default=["H+S", "M+S"])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--distance", type=float, default=10.0, help="mm along each axis")
    parser.add_argument("--angle", type=float, default=8.0, help="degrees")
    parser.add_argument("--overlap", type=float, default=2.0, help="of bones, mm")
    parser.add_argument("--method", default="auto")
    parser.add_argument("--nearby", type=int, default=0, help="plans of each model to vary")
    parser.add_argument("--fill", type=Path, help="page whose table is rewritten")
    options = parser.parse_args(words)
    tallies = []
    for path in options.cases:
        case = cmfsim.Case.load(path)
        model = cmfsim.build_case(case)
        reach = (options.distance, options.angle)
        each = -(-options.plans // len(options.models))
        plans = draw(model, options.plans, reach, options.overlap, options.seed)
        for k, name in enumerate(options.models):
            scene = cmfsim.model_scene(model, name)
            scene = replace(scene, options=replace(scene.options, method=options.method))
            sliding = sum(len(s.sliding) for s in scene.segments.values())
            tally = Tally(case.name, name, scene.n_tets, sliding)
            own = plans[k * each : (k + 1) * each]
            run(tally, scene, own)
            run_nearby(tally, scene, model.skin_nodes, own[: options.nearby], options.seed)
            tallies.append(tally)
            print(tally.row(), file=sys.stderr, flush=True)
            seconds = np.array(tally.seconds or [0.0])
            spent = f"{np.median(seconds):.1f} s (median), {seconds.max():.1f} s (most)"
            print(f"processor time of a plan: {spent}", file=sys.stderr, flush=True)
    lines = [HEAD, "| --- " * 2 + "| ---: " * 10 + "|"]
    text = "\n".join([*lines, *(tally.row() for tally in tallies)])
    text += (
        f"\n\nPlans of up to {options.distance:g} mm and {options.angle:g}°, seed {options.seed}; "
        f"{platform.machine()}, {os.cpu_count()} cores, cmfsim {cmfsim.__version__}.\n"
    )
    publish(options.fill, "contact_plans", text)
    return 1 if any(tally.failures for tally in tallies) else 0


if __name__ == "__main__":
    sys.exit(main())
