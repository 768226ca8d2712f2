"""Runs tasks with 3D Slicer's own code, in the interpreter that has `slicer-core`."""

import json
import os
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
import pytest

TASKS = Path(__file__).with_name("in_slicer_tasks.py")
# An interpreter with `pip install slicer-core==5.12.4.0`, which needs vtk 9.6.0: usually another
# one than that of the tests.
VARIABLE = "CMFSIM_SLICER_PYTHON"


def interpreter():
    """The interpreter that has slicer-core; tests without one are skipped."""
    named = os.environ.get(VARIABLE)
    if named:
        return named
    # Not by whether `slicer` can be imported: the folder of the extension has that name.
    try:
        version("slicer-core")
    except PackageNotFoundError:
        pytest.skip(
            f"3D Slicer's own code is missing: pip install slicer-core==5.12.4.0 into an "
            f"environment of its own, and set {VARIABLE} to its python"
        )
    return sys.executable


def run(*words):
    """Runs a task; its output is shown where it fails."""
    ended = subprocess.run(
        [interpreter(), str(TASKS), *map(str, words)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr


def make_scenes(asked):
    """Where Slicer shows the scenes that it wrote as scene.mrml and scene.mrb, by folder.

    `asked` has by folder what is asked for, with surfaces as (vertices, triangles), LPS mm.
    """
    for folder, scene in asked.items():
        _ask(folder, **scene)
    run("make", *asked)
    for folder in asked:
        (folder / "surfaces.npz").unlink()
        (folder / "scene.json").unlink()
    return {folder: load(folder / "shown.npz") for folder in asked}


def _ask(folder, surfaces, **asked):
    arrays = {}
    for key, (vertices, triangles) in surfaces.items():
        arrays[f"{key}.vertices"] = np.asarray(vertices, dtype=np.float64)
        arrays[f"{key}.triangles"] = np.asarray(triangles, dtype=np.int64)
    np.savez(folder / "surfaces.npz", **arrays)
    (folder / "scene.json").write_text(json.dumps(asked), encoding="utf-8")


def look(file, out):
    """Where Slicer shows what a scene or bundle holds, by name: LPS mm."""
    run("look", file, out)
    return load(out)


def load(path):
    """The arrays of an archive."""
    with np.load(path) as archive:
        return dict(archive)
