"""CalculiX: an input deck is written, `ccx` runs, displacements are read from the `.frd`.

Parsing, assembly, factor and output happen inside one process, so they count together as "solve",
and there is no next plan with the factor kept. The `.frd` keeps 6 significant digits: a difference
of some 1e-6 of the largest displacement is rounding of the output, not of the solver. ccx silently
truncates input fields after 20 characters, so numbers are written with 12 digits, which always fit.
"""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator
from pathlib import Path
from shutil import which

import numpy as np

from case import Case, Clock, NotInstalled, Result

COMPONENT_COLUMNS = (slice(13, 25), slice(25, 37), slice(37, 49))
"""Where the three components stand in a line of the `.frd`."""


def deck(case: Case, solver: str) -> Iterator[str]:
    """Pieces of the input deck; every distinct (E, nu) is a material of its own."""
    yield "*NODE,NSET=ALL\n"
    for number, (x, y, z) in enumerate(case.nodes.tolist(), 1):
        yield f"{number},{x:.12g},{y:.12g},{z:.12g}\n"
    constants = np.stack([case.young, case.poisson], axis=1)
    materials, group = np.unique(constants, axis=0, return_inverse=True)
    group = group.ravel()
    for k, (young, poisson) in enumerate(materials.tolist()):
        yield f"*ELEMENT,TYPE=C3D4,ELSET=TISSUE{k}\n"
        members = np.flatnonzero(group == k)
        corners = (case.tets[members] + 1).tolist()
        for number, (a, b, c, d) in zip((members + 1).tolist(), corners, strict=True):
            yield f"{number},{a},{b},{c},{d}\n"
        yield f"*MATERIAL,NAME=TISSUE{k}\n*ELASTIC\n{young:.12g},{poisson:.12g}\n"
        yield f"*SOLID SECTION,ELSET=TISSUE{k},MATERIAL=TISSUE{k}\n"
    yield f"*STEP\n*STATIC,SOLVER={solver}\n*BOUNDARY\n"
    displacements = case.prescribed_displacements(case.motion)
    for node, u in zip((case.prescribed + 1).tolist(), displacements.tolist(), strict=True):
        for axis, component in enumerate(u, 1):
            yield f"{node},{axis},{axis},{component:.12g}\n"
    yield "*NODE FILE\nU\n*END STEP\n"


def read_displacements(path: Path, n_nodes: int) -> np.ndarray:
    """The DISP block of a `.frd`, (n, 3), mm."""
    u = np.full((n_nodes, 3), np.nan)
    with open(path) as lines:
        for line in lines:
            if line.startswith(" -4  DISP"):
                break
        for line in lines:
            if line.startswith(" -1"):
                u[int(line[3:13]) - 1] = [float(line[column]) for column in COMPONENT_COLUMNS]
            elif line.startswith(" -3"):
                break
    return u


def solve(case: Case, clock: Clock, method: str, threads: int, scratch: Path) -> Result:
    """`method` is a value of ccx's SOLVER parameter, such as "SPOOLES"."""
    if which("ccx") is None:
        raise NotInstalled("apt package calculix-ccx")
    job = scratch / "job"
    with clock("set-up"), open(job.with_suffix(".inp"), "w") as file:
        file.writelines(deck(case, method))
    with clock("solve"):
        command = ["ccx", "-i", "job"]
        run = subprocess.run(command, cwd=scratch, check=False, capture_output=True, text=True)
        if run.returncode or "*ERROR" in run.stdout:
            raise RuntimeError(f"ccx ended with {run.returncode}: {run.stdout[-2000:]}")
        displacements = read_displacements(job.with_suffix(".frd"), case.n_nodes)
    version = re.search(r"CalculiX Version ([\d.]+)", run.stdout)
    own = re.search(r"Total CalculiX Time:\s*([\d.]+)", run.stdout)
    notes = {"ccx_seconds": float(own[1])} if own else {}
    return Result(displacements, version[1].rstrip(".") if version else "unknown", notes=notes)
