"""Measures cmfsim and other finite-element programs on the same generated face-like shell.

    python benches/peers/run.py --tets 20000 80000 --peers cmfsim-cholesky ccx-spooles \
        --threads 2 --repeat 3 --out results.json --markdown table.md

Every measurement is a fresh process pinned to `--threads` cores. Repeats are interleaved (A B C A B
C), so that a disturbance of the machine affects all peers alike. The README next to this file
explains how to install the peers and what the columns mean.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import signal
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from table import markdown

HERE = Path(__file__).resolve().parent
WORKSPACE = HERE.parents[1]
DEBIAN_PYTHON = "/usr/bin/python3"
"""The interpreter that Debian's Python packages belong to."""
TIMEOUT = 1800.0
"""Seconds after which a measurement is stopped."""
LOG_LINE = 200
"""Characters kept of the last line that a failed process wrote."""
THREAD_VARIABLES = (
    "RAYON_NUM_THREADS",
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "CCX_NPROC_EQUATION_SOLVER",
    "CCX_NPROC_STIFFNESS",
    "CCX_NPROC_RESULTS",
)


@dataclass(frozen=True)
class Peer:
    """One row of the table: which adapter file runs which method in which interpreter."""

    adapter: str
    method: str
    debian: bool = False
    """whether Debian's own interpreter runs it"""


PEERS = {
    "cmfsim": Peer("cmfsim_", "auto"),
    "cmfsim-cholesky": Peer("cmfsim_", "cholesky"),
    "cmfsim-pcg": Peer("cmfsim_", "pcg"),
    "skfem-cholmod": Peer("skfem_", "cholmod"),
    "skfem-pardiso": Peer("skfem_", "pardiso"),
    "dolfinx-mumps": Peer("dolfinx_", "mumps", debian=True),
    "dolfinx-gamg": Peer("dolfinx_", "gamg", debian=True),
    "ngsolve": Peer("ngsolve_", "sparsecholesky"),
    "ccx-spooles": Peer("ccx", "SPOOLES"),
}
REFERENCES = ("cmfsim-cholesky", "skfem-cholmod", "skfem-pardiso", "dolfinx-mumps", "ngsolve")
"""The first of these that ran is what the others are compared with."""


def generate(n_tets: int, folder: Path) -> None:
    """Writes the shell of about `n_tets` tets into `folder`."""
    command = ["cargo", "run", "--release", "--quiet", "-p", "mtm-core", "--example", "shell_case"]
    subprocess.run([*command, "--", str(n_tets), str(folder)], cwd=WORKSPACE, check=True)


def busy_seconds() -> float | None:
    """CPU seconds the whole machine has worked since it started; None where it does not tell."""
    try:
        fields = Path("/proc/stat").read_text().split(maxsplit=9)
    except OSError:
        return None
    user, nice, system, _idle, _wait, irq, softirq, steal = map(int, fields[1:9])
    return (user + nice + system + irq + softirq + steal) / os.sysconf("SC_CLK_TCK")


def measure(peer: Peer, case: Path, cores: list[int], debian_python: str, out: Path) -> dict:
    """Report of one fresh process, displacements left in `out`.npz."""
    environment = dict(os.environ) | dict.fromkeys(THREAD_VARIABLES, str(len(cores)))
    environment["OMP_WAIT_POLICY"] = "PASSIVE"
    interpreter = sys.executable
    if peer.debian:
        interpreter = debian_python
        environment.pop("PYTHONPATH", None)  # meant for the other interpreter
        if not Path(interpreter).exists():
            return {"status": "not installed: apt packages python3 python3-dolfinx"}
    command = [interpreter, str(HERE / "worker.py"), str(case), "--adapter", peer.adapter]
    command += ["--method", peer.method, "--cores", ",".join(map(str, cores)), "--out", str(out)]
    busy, start = busy_seconds(), time.perf_counter()
    log_path, report_path = out.with_suffix(".log"), out.with_suffix(".json")
    report_path.unlink(missing_ok=True)
    with open(log_path, "w") as log:
        process = subprocess.Popen(
            command, env=environment, stdout=log, stderr=subprocess.STDOUT, start_new_session=True
        )
        timer = threading.Timer(TIMEOUT, os.killpg, (process.pid, signal.SIGKILL))
        timer.start()
        try:
            _, status, usage = os.wait4(process.pid, 0)  # unlike Popen.wait it tells peak memory
            process.returncode = os.waitstatus_to_exitcode(status)
        finally:
            timer.cancel()
            if process.returncode is None:  # interrupted: leave nothing running
                os.killpg(process.pid, signal.SIGKILL)
    elapsed = time.perf_counter() - start
    used = usage.ru_utime + usage.ru_stime
    others = None if busy is None else max(0.0, busy_seconds() - busy - used) / elapsed
    if report_path.exists():
        report = json.loads(report_path.read_text())
    elif elapsed >= TIMEOUT:
        report = {"status": f"stopped after {TIMEOUT:.0f} s"}
    else:
        last = log_path.read_text(errors="replace").strip().rpartition("\n")[2]
        report = {"status": f"failed ({process.returncode}): {last[:LOG_LINE]}"}
    # ru_maxrss is in KiB on Linux and in bytes on macOS
    unit = 1 if platform.system() == "Darwin" else 1024
    report |= {"process_s": elapsed, "process_cpu_s": used, "other_cores": others}
    return report | {"peak_mb": usage.ru_maxrss * unit / 1e6}


def largest_difference(result: Path, reference: Path) -> float:
    """Largest distance between two sets of displacements, both plans, mm."""
    with np.load(result) as ours, np.load(reference) as theirs:
        shared = sorted(set(ours.files) & set(theirs.files))
        return max(float(np.linalg.norm(ours[k] - theirs[k], axis=1).max()) for k in shared)


def measure_size(n_tets: int, args: argparse.Namespace, cores: list[int], folder: Path) -> dict:
    """All rounds of all peers on one mesh."""
    case = folder / "case"
    generate(n_tets, case)
    rounds: dict[str, list[dict]] = {name: [] for name in args.peers}
    results: dict[str, list[Path]] = {name: [] for name in args.peers}
    for turn in range(args.repeat):
        for name in args.peers:
            if any(run["status"] != "ok" for run in rounds[name]):
                continue
            out = folder / f"{name}-{turn}"
            run = measure(PEERS[name], case, cores, args.debian_python, out)
            rounds[name].append(run)
            if run["status"] == "ok":
                results[name].append(out.with_suffix(".npz"))
            if args.quiet:
                continue
            seconds = {stage: round(s, 3) for stage, s in run.get("wall", {}).items()}
            print(n_tets, name, turn + 1, run["status"], seconds, file=sys.stderr, flush=True)
    reference = next((name for name in REFERENCES if results.get(name)), None)
    for name in args.peers:
        for run, result in zip(rounds[name], results[name], strict=False):
            if reference is not None:
                run["difference_mm"] = largest_difference(result, results[reference][0])
    mesh = {
        name: int(np.load(case / f"{name}.npy", mmap_mode="r").shape[0]) for name in MESH_ARRAYS
    }
    return {"tets_asked": n_tets, "mesh": mesh, "reference": reference, "rounds": rounds}


MESH_ARRAYS = ("nodes", "tets", "fixed", "joined")


def git(*arguments: str) -> str:
    """What git says about the workspace; empty outside a repository."""
    command = ["git", "-C", str(WORKSPACE), *arguments]
    return subprocess.run(command, check=False, capture_output=True, text=True).stdout.strip()


def machine(threads: int) -> dict:
    """What a reader needs to judge the numbers; neither host name nor paths."""
    model = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next(
            line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")
        )
    except (OSError, StopIteration):
        pass
    edited = " with uncommitted changes" if git("status", "--porcelain") else ""
    return {
        "cpu": model,
        "cores": os.cpu_count(),
        "threads": threads,
        "commit": (git("rev-parse", "--short", "HEAD") or "unknown") + edited,
        "date": datetime.date.today().isoformat(),
    }


def main() -> None:
    """Measures, writes the JSON, prints the tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--tets", type=int, nargs="+", default=[20_000, 80_000, 300_000])
    parser.add_argument("--peers", nargs="+", choices=PEERS, default=list(PEERS), metavar="PEER")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--out", type=Path, help="every measurement, as JSON")
    parser.add_argument("--markdown", type=Path, help="the tables")
    parser.add_argument("--debian-python", default=DEBIAN_PYTHON)
    parser.add_argument("-q", "--quiet", action="store_true", help="no line per measurement")
    args = parser.parse_args()
    available = getattr(os, "sched_getaffinity", lambda _: range(os.cpu_count() or 1))(0)
    cores = sorted(available)[: args.threads]
    if len(cores) < args.threads:
        parser.error(f"--threads {args.threads}: this machine offers {len(cores)} cores")

    study = {"machine": machine(args.threads), "repeat": args.repeat, "sizes": []}
    for n_tets in args.tets:
        with tempfile.TemporaryDirectory() as folder:
            study["sizes"].append(measure_size(n_tets, args, cores, Path(folder)))
        if args.out:
            args.out.write_text(json.dumps(study, indent=1) + "\n")
    text = markdown(study)
    if args.markdown:
        args.markdown.write_text(text)
    print(text, end="")


if __name__ == "__main__":
    main()
