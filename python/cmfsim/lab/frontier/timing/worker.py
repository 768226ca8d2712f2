"""One build or one solve in a process of its own, so that its time and memory are its own."""

import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from cmfsim.errors import CmfsimError
from cmfsim.io import Case, read_scene, write_scene
from cmfsim.io.files.archives import member_of, read_archive, write_archive
from cmfsim.lab.frontier.choice import Choice
from cmfsim.lab.frontier.skin_points import read_points, skin_points, write_points
from cmfsim.lab.frontier.timing.memory import peak_memory
from cmfsim.pipeline.building.case_model import build_model
from cmfsim.solving.models import model_scene
from cmfsim.solving.simulation import solve_scene
from cmfsim.values.skin_motion import SkinEnd, carried_points
from cmfsim.values.surface_data import SurfaceData

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
