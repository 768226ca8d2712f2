"""Time and memory of one build or one solve, measured in a process of its own; the machine."""

import os
import platform
import shutil
import sys
import time
from collections.abc import Mapping
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim._core import __version__
from cmfsim.errors import CmfsimError
from cmfsim.io import Case, read_scene, write_scene
from cmfsim.io.files.archives import member_of, read_archive, write_archive
from cmfsim.io.files.summaries import write_record
from cmfsim.lab.frontier.choice import Choice
from cmfsim.lab.frontier.rows import read_points, skin_points, write_points
from cmfsim.pipeline.building.case_model import build_model
from cmfsim.processes.worker import SILENT, Worker, WorkerEndedError, WorkerFailedError, run_program
from cmfsim.solving.models import model_scene
from cmfsim.solving.simulation import solve_scene
from cmfsim.values.skin_motion import SkinEnd, carried_points
from cmfsim.values.surface_data import SurfaceData

Answer = dict[str, Any]
# Begins the error of a job that took too long.
STOPPED = "stopped after the time limit"
# Characters of a failure that are kept, from its end.
LAST_WORDS = 400

STATUS = Path("/proc/self/status")

SKIN_FORMAT = "cmfsim-bench-skin"
MOVED_FORMAT = "cmfsim-bench-moved"


def measured(job: Mapping[str, Any]) -> dict[str, Any]:
    """What was measured of a job; what a stage refuses is an answer too: its error."""
    task = {"build": _build, "solve": _solve}[job["task"]]
    try:
        return {**task(job), "run": job.get("run")}
    except (CmfsimError, MemoryError, OSError) as error:
        return {"error": f"{type(error).__name__}: {error}", "peak_mb": peak_memory()}


def _build(job: Mapping[str, Any]) -> dict[str, Any]:
    """Builds a case; writes the scene of each model, the skin, and the points on it if wanted."""
    case = Choice(**job["choice"]).case(Case.load(job["case"]))
    wall, cpu = time.perf_counter(), time.process_time()
    patient = build_model(case, check=False)
    answer = {
        "wall_s": time.perf_counter() - wall,
        "cpu_s": time.process_time() - cpu,
        "peak_mb": peak_memory(),
        "stages_s": dict(patient.summary["timings"]),
        "n_nodes": patient.scene.n_nodes,
        "n_tets": patient.scene.n_tets,
    }
    folder = Path(job["folder"])
    folder.mkdir(parents=True, exist_ok=True)
    for model in job["models"]:
        write_scene(folder / f"{model}.npz", model_scene(patient, model))
    end = patient.skin_end
    skin: dict[str, NDArray[Any]] = {
        "nodes": patient.skin_nodes,
        "triangles": patient.skin.triangles,
        "end_vertices": end.vertices,
        "end_edges": end.edges,
    }
    write_archive(folder / "skin.npz", SKIN_FORMAT, "skin", {}, skin)
    if job["points"] is not None:
        write_points(Path(job["points"]), *skin_points(patient))
    return answer


def _solve(job: Mapping[str, Any]) -> dict[str, Any]:
    """Solves a scene under a choice's options; writes how the points on the skin move."""
    choice, folder = Choice(**job["choice"]), Path(job["folder"])
    scene = read_scene(folder / f"{choice.model}.npz")
    scene = replace(scene, options=choice.options(scene.options))
    wall, cpu = time.perf_counter(), time.process_time()
    result = solve_scene(scene)
    answer = {
        "wall_s": time.perf_counter() - wall,
        "cpu_s": time.process_time() - cpu,
        "peak_mb": peak_memory(),
        "solution": dict(result.summary),
    }
    _, arrays = read_archive(folder / "skin.npz", SKIN_FORMAT, "skin")
    nodes = member_of(arrays, "nodes")
    skin = SurfaceData(scene.nodes[nodes], member_of(arrays, "triangles"))
    points, _ = read_points(Path(job["points"]))
    end = SkinEnd(member_of(arrays, "end_vertices"), member_of(arrays, "end_edges"))
    moved = carried_points(skin, end.continued(result.displacements[nodes]), points)
    write_archive(Path(job["moved"]), MOVED_FORMAT, "moved", {}, {"displacements": moved})
    return answer


def peak_memory() -> float | None:
    """The largest resident memory of this process so far, MB (10⁶ bytes); None on Windows.

    Linux hands the peak of a parent on to `ru_maxrss` of its child, and not to `VmHWM`.
    """
    if STATUS.exists():
        for line in STATUS.read_text(encoding="utf-8").splitlines():
            if line.startswith("VmHWM:"):
                return float(line.split()[1]) * 1024.0 / 1e6
    if sys.platform == "win32":
        return None
    resource = import_module("resource")
    # Bytes on macOS, KiB elsewhere.
    unit = 1.0 if sys.platform == "darwin" else 1024.0
    return float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) * unit / 1e6


def machine(threads: int | None) -> dict[str, Any]:
    """Processor, cores, threads of the processes (None: all cores), versions and commit."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {
        "processor": _processor(),
        "cores": cores,
        "threads": cores if threads is None else threads,
        "system": platform.system(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "cmfsim": __version__,
        "commit": _commit(),
    }


def _processor() -> str:
    """The name of the processor, as far as the system tells it."""
    file = Path("/proc/cpuinfo")
    if file.exists():
        for line in file.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _commit() -> str | None:
    """The commit that the source is at; None where the package is installed or there is no git."""
    git = shutil.which("git")
    source = Path(__file__).parents[4]
    if git is None or not (source / ".git").exists():
        return None
    words = [git, "-C", str(source), "rev-parse", "--short", "HEAD"]
    return run_program("git", words, seconds=10.0).stdout.decode().strip() or None


def run_job(job: Mapping[str, Any], *, threads: int | None, time_limit: float) -> Answer:
    """The answer of a job, now in the file that it names: figures, or why there are none.

    A process that is killed or takes longer than the limit, s, has an error for an answer too.

    job: What `measured` takes; `answer` is the file's path.
    """
    path = Path(job["answer"])
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    task = "cmfsim.lab.frontier.timing:measured"
    with Worker(threads=threads, log=SILENT) as worker:
        try:
            answer: Answer = worker.ask(task, {"job": dict(job)}, seconds=time_limit).values
        except WorkerFailedError as failed:
            answer = {"error": failed.trace[-LAST_WORDS:].strip()}
        except WorkerEndedError as ended:
            error = f"exit code {ended.code}"
            if ended.code < 0:
                error = f"killed by signal {-ended.code}; 9 is most often lack of memory"
            answer = {"error": f"{STOPPED} of {time_limit:g} s" if ended.late else error}
    write_record(path, answer)
    return answer
