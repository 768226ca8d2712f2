"""From a CT to the report: wall time of each stage, processor time and memory of all processes.

    python -m benches.speed.case_time [--runs 3] [--clinical] [--markdown docs/benchmarks.md]

`cmfsim predict` runs as from a shell, with Le Fort I and BSSO, a motion of the maxilla, M+S and
landmarks that are found automatically, on the CT phantom of CMFSIM_DATA (else ../shared/data). A
first run, in which Python may compile modules, is not counted. `--clinical` takes the synthetic
phantom with the voxels of a clinical scan instead: 512 × 512 × 200 of 0.45 × 0.45 × 1 mm, noise of
25 HU. The floor of a stage is the time that the machine needs to read and write once, with one
thread, the arrays that the stage turns into others.
"""

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import cmfsim
from benches.scenes.marked import publish
from benches.scenes.real_data import data_folder

NAME = "benches/speed/case_time.py"
SHAPE = (512, 512, 200)
SPACING = (0.45, 0.45, 1.0)  # mm
NOISE = 25.0  # HU
CMFSIM = (sys.executable, "-m", "cmfsim")
SILENT: Mapping[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
SAMPLED = 0.05  # s between two readings of the memory in use
CASE = ["--cut", "le_fort_1", "--cut", "bsso", "--move", "maxilla", "forwards=4", "up=1"]


@dataclass(frozen=True)
class Run:
    """One run: seconds on the clock and of the processors, most memory in MB, its files."""

    wall: float
    user: float
    system: float
    memory: float
    stages: Mapping[str, float]
    summary: Mapping[str, Any]


def main() -> None:
    """Times the case and prints or publishes the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--clinical", action="store_true")
    parser.add_argument("--markdown", type=Path)
    args = parser.parse_args()
    data = data_folder()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        image = folder / ("ct.nrrd" if args.clinical else "ct.nii.gz")
        if args.clinical:
            _write_clinical(image)
        else:
            image.write_bytes((data / "ct_phantom" / "ct.nii.gz").read_bytes())
        subprocess.run([*CMFSIM, "init", str(folder), *CASE], check=True, **SILENT)  # noqa: S603
        runs = [_timed(folder) for _ in range(args.runs + 1)][1:]
        voxels = int(np.prod(cmfsim.read_image(image).values.shape))
    publish(args.markdown, NAME, _table(runs, voxels))


def _timed(folder: Path) -> Run:
    """One prediction, and what it took."""
    started = time.perf_counter()
    command = [*CMFSIM, "predict", str(folder), "--model", "M+S"]
    process = subprocess.Popen(command, **SILENT)  # noqa: S603
    most = [0.0]
    ended = threading.Event()

    def watch() -> None:
        while not ended.wait(SAMPLED):
            most[0] = max(most[0], _memory(process.pid))

    watcher = threading.Thread(target=watch)
    watcher.start()
    _, status, used = os.wait4(process.pid, 0)
    wall = time.perf_counter() - started
    ended.set()
    watcher.join()
    if status:
        raise SystemExit(f"predict ended with {os.waitstatus_to_exitcode(status)}")
    stages = json.loads((folder / "out" / "timings.json").read_text("utf-8"))
    summary = json.loads((folder / "out" / "prediction.json").read_text("utf-8"))
    return Run(wall, used.ru_utime, used.ru_stime, most[0], stages, summary)


def _memory(root: int) -> float:
    """Memory of a process and all below it, MB: pages that several share count once."""
    parents: dict[int, int] = {}
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            parents[int(status.parent.name)] = int(status.read_text().rpartition(")")[2].split()[1])
        except OSError:
            continue
    below = {root}
    while more := {child for child, parent in parents.items() if parent in below} - below:
        below |= more
    total = 0
    for process in below:
        try:
            rollup = Path(f"/proc/{process}/smaps_rollup").read_text("utf-8")
        except OSError:
            continue
        total += sum(int(line.split()[1]) for line in rollup.splitlines() if line[:4] == "Pss:")
    return total / 1024.0


def _floors(summary: Mapping[str, Any], voxels: int) -> dict[str, float]:
    """Bytes that stages have to read and write at least, by the names in `timings.json`."""
    grid = float(np.prod(summary["grid"]["shape"]))
    nodes, tets = summary["mesh"]["n_nodes"], summary["mesh"]["n_tets"]
    mesh = 24.0 * nodes + 16.0 * tets
    # Edges of a mesh of tets: seven a node and half a tet; blocks of nine float64, both triangles.
    matrix = 72.0 * (nodes + 2.0 * (nodes + 1.17 * tets))
    return {
        "reading the image": 2.0 * voxels,
        "segmenting the head: grid": 2.0 * voxels + 4.0 * grid,
        "segmenting the head: skin": 5.0 * grid,
        "segmenting the head: bone": 5.0 * grid,
        "segmenting the head: jaw": 2.0 * grid,
        "filling the tissue with tets": 4.0 * grid + mesh,
        "classifying nodes": mesh + nodes,
        "sampling the muscles": mesh + 32.0 * tets,
        "solving": matrix * summary["solution"]["iterations"],
    }


def _speed() -> float:
    """Bytes that one thread reads and writes in a second: the best of five copies of 256 MB."""
    source = np.ones(2**25)
    target = np.empty_like(source)
    best = np.inf
    for _ in range(5):
        started = time.perf_counter()
        np.copyto(target, source)
        best = min(best, time.perf_counter() - started)
    return 2.0 * source.nbytes / best


def _table(runs: list[Run], voxels: int) -> str:
    """The stages in the order in which they ran: medians, and their floors."""
    summary, speed = runs[0].summary, _speed()
    floors = _floors(summary, voxels)
    lines = ["| stage | wall, s | floor, s |", "|---|---:|---:|"]
    for stage in runs[0].stages:
        took = statistics.median(run.stages.get(stage, 0.0) for run in runs)
        if took >= 0.05:
            floor = f"{floors[stage] / speed:.3f}" if stage in floors else "–"
            lines.append(f"| {stage} | {took:.1f} | {floor} |")
    walls = sorted(run.wall for run in runs)
    user, system, memory = (
        statistics.median(getattr(run, name) for run in runs)
        for name in ("user", "system", "memory")
    )
    head = (
        f"{platform.machine()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, cmfsim "
        f"{cmfsim.__version__}; {summary['mesh']['n_tets']} tets, {len(runs)} runs after a first. "
        f"From the command to its end: **{statistics.median(walls):.1f} s** ({walls[0]:.1f} to "
        f"{walls[-1]:.1f}), {user:.1f} s of processor time and {system:.1f} s in the kernel; most "
        f"memory of all processes {memory:.0f} MB. Floors at {speed / 1e9:.1f} GB/s."
    )
    return "\n".join([head, "", *lines])


def _write_clinical(path: Path) -> None:
    """The synthetic phantom with the voxels of a clinical scan, cut to what such a scan shows."""
    import SimpleITK  # noqa: PLC0415

    cmfsim.write_phantom_case(path.parent, cmfsim.make_head(), spacing=1.0)
    image = SimpleITK.ReadImage(str(path))
    size, step = np.array(image.GetSize()), np.array(image.GetSpacing())
    middle = np.array(image.GetOrigin()) + 0.5 * (size - 1) * step
    middle[2] -= 25.0
    origin = middle - 0.5 * (np.array(SHAPE) - 1) * np.array(SPACING)
    fine = SimpleITK.Resample(
        image,
        SHAPE,
        SimpleITK.Transform(),
        SimpleITK.sitkLinear,
        origin.tolist(),
        SPACING,
        (1, 0, 0, 0, 1, 0, 0, 0, 1),
        -1000.0,
        SimpleITK.sitkFloat32,
    )
    values = SimpleITK.GetArrayFromImage(fine).T
    noise = np.random.default_rng(0).normal(0.0, NOISE, values.shape).astype(np.float32)
    noisy = np.rint(values + noise).astype(np.int16)
    for written in path.parent.iterdir():
        written.unlink()
    cmfsim.write_image(cmfsim.ImageData(noisy, SPACING, origin), path)


if __name__ == "__main__":
    main()
