"""Runs one peer on one case in this process; `run.py` starts a new one for every measurement.

Stages: "set-up", "assembly", "factor", "solve" make the total (case in memory to displacements in
memory); "import", "compile" and "next plan" are reported separately.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import tempfile
from pathlib import Path


def loaded_blas() -> list[str]:
    """File names of the BLAS libraries in this process: they decide the speed of direct solvers."""
    try:
        lines = Path("/proc/self/maps").read_text().splitlines()
    except OSError:
        return []
    names = {Path(line.split()[-1]).name for line in lines if "/" in line}
    return sorted(n for n in names if n.startswith(("libblas", "libopenblas", "libmkl_core")))


def main() -> None:
    """Solves and writes `OUT.json`, and `OUT.npz` with the displacements."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("case", type=Path)
    parser.add_argument("--adapter", required=True)
    parser.add_argument("--method", required=True)
    parser.add_argument("--cores", required=True, help="comma-separated")
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    cores = [int(core) for core in args.cores.split(",")]
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, cores)  # before any library counts the cores

    import numpy as np

    from case import Case, Clock, NotInstalled

    case, clock = Case.load(args.case), Clock()
    report: dict[str, object] = {"status": "ok", "n_tets": len(case.tets), "n_nodes": case.n_nodes}
    try:
        adapter = importlib.import_module(args.adapter)
        with tempfile.TemporaryDirectory(dir=args.out.parent) as scratch:
            result = adapter.solve(case, clock, args.method, len(cores), Path(scratch))
    except NotInstalled as absent:
        report["status"] = f"not installed: {absent}"
    else:
        arrays = {"displacements": result.displacements}
        if result.next_displacements is not None:
            arrays["next_displacements"] = result.next_displacements
        np.savez(args.out.with_suffix(".npz"), **arrays)
        report |= {"version": result.version, "notes": result.notes, "blas": loaded_blas()}
        report |= {"wall": clock.wall, "cpu": clock.cpu}
    args.out.with_suffix(".json").write_text(json.dumps(report))


if __name__ == "__main__":
    main()
