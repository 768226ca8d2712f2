"""cmfsim itself, through its public API only."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np

from case import Case, Clock, NotInstalled, Result

SEGMENT = "maxilla"


def solve(case: Case, clock: Clock, method: str, threads: int, scratch: Path) -> Result:
    """`method` is one of `StaticSolver`; a factor made inside the first solve counts as such."""
    try:
        with clock("import"):
            import cmfsim
    except ImportError as absent:
        raise NotInstalled("pip install . in the project folder") from absent

    with clock("set-up"):
        mesh = cmfsim.TetMesh(case.nodes, case.tets.astype(np.uint32))
        tissue = cmfsim.Tissue.isotropic(case.young, case.poisson)
        boundary = cmfsim.Boundary(
            fixed=case.fixed.astype(np.uint32), joined={SEGMENT: case.joined.astype(np.uint32)}
        )
    with clock("assembly"):
        tensors = cmfsim.MassTensors(mesh, tissue)
    with clock("factor"):
        solver = cmfsim.StaticSolver(tensors, boundary, method=method)
    with clock("solve"):
        first = solver.solve({SEGMENT: case.motion})
    with clock("next plan"):
        second = solver.solve({SEGMENT: case.next_motion})
    timings = {stage: float(seconds) for stage, seconds in dict(first.timings).items()}
    late = min(timings.get("factor", 0.0), clock.wall["solve"])
    if late > clock.wall["factor"]:  # the constructor was too short to have made it
        clock.wall["factor"] += late
        clock.wall["solve"] -= late
    notes = {"timings": timings, "iterations": first.iterations}
    try:
        release = version("cmfsim")
    except PackageNotFoundError:  # imported from a source folder
        release = "unreleased"
    u, u_next = np.asarray(first.displacements), np.asarray(second.displacements)
    return Result(u, release, u_next, notes)
