"""Process pools: solves in forked children, and values that travel to other processes."""

import copy
import dataclasses
import json
import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest

import cmfsim
from cmfsim.bones.achieved import motion_by_vertices
from cmfsim.values.checks import Frozen

HERE = Path(__file__).parents[1]
# A deadlock never ends; on an idle machine the tasks take a few seconds.
PATIENCE = 300.0


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.parametrize("threads", ["1", "3"])
def test_forked_children_solve_after_their_parent_and_get_the_same_bits(threads):
    """A child of `fork` has none of its parent's threads: it starts its own, as many as asked for.

    Linux's default start method before Python 3.14; the child used to wait for ever.
    """
    path = os.pathsep.join([*sys.path, str(HERE)])
    process = subprocess.Popen(
        [sys.executable, str(HERE / "fork_tasks.py")],
        env={**os.environ, "RAYON_NUM_THREADS": threads, "PYTHONPATH": path},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        out, errors = process.communicate(timeout=PATIENCE)
    finally:
        if process.poll() is None:
            # Its waiting children with it.
            os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == 0, errors
    found = json.loads(out)
    assert found["parent"] == [found["children"][0]] * 2
    assert len(found["children"]) == 1
    assert found["grandchild"] == 0
    # The pool's, Python's own, and one that runs the solve.
    assert found["threads"] in {0, int(threads) + 1, int(threads) + 2}


def small_scene(**changes):
    nodes = np.vstack([np.zeros((1, 3)), np.eye(3), [[1.0, 1, 1]]])
    surface = cmfsim.SurfaceData([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    options = {
        "nodes": nodes,
        "tets": [[0, 1, 2, 3], [1, 2, 3, 4]],
        "tissue": cmfsim.TissueData("isotropic", young=[1.0, 2.0], poisson=0.3),
        "fixed": [1, 2],
        "segments": {
            "jaw": cmfsim.SegmentData(joined=[4], sliding=[3], contact=surface, gap="rest"),
            "chin": cmfsim.SegmentData(joined=[0]),
        },
        "plan": {
            "jaw": cmfsim.MovedSurface(surface, np.asarray(surface.vertices) + [0, 0, 0.1]),
            "chin": cmfsim.rigid_motion((0, 0, 0.1), 3),
        },
        "loads": np.zeros((5, 3)),
        **changes,
    }
    return cmfsim.Scene(**options)


def a_case(folder):
    (folder / "case.toml").write_text(
        """
format = "cmfsim-case"
version = 1
[surfaces]
skin = "skin.ply"
units = "mm"
frame = "LPS"
[surfaces.bones]
cranium = "cranium.ply"
maxilla = "maxilla.ply"
[plan.maxilla]
matrix = [[1, 0, 0, 2], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
""",
        encoding="utf-8",
    )
    return cmfsim.Case.load(folder / "case.toml")


def values(folder):
    sheet = cmfsim.SurfaceData([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    line = np.array([[0.0, 0, 0], [1, 0, 0]])
    muscle = cmfsim.MuscleSurface("masseter_L", "L", sheet, course=(line,))
    held = small_scene(segments={}, plan={}, loads=None, fixed=[0, 1, 2])
    image = cmfsim.ImageData(np.zeros((2, 2, 2), np.int16), (1.0, 1.0, 1.0))
    shifted = cmfsim.SurfaceData(np.asarray(sheet.vertices) + 1, sheet.triangles)
    return {
        "Scene": small_scene(),
        "SceneResult": cmfsim.solve_scene(held),
        "Case": a_case(folder),
        "Musculature": cmfsim.Musculature((muscle,)),
        "MuscleTemplate": cmfsim.MuscleTemplate.load("default"),
        "ImageData": image,
        "AchievedMotion": motion_by_vertices(sheet, shifted),
        "PhantomHead": cmfsim.make_head(),
        "proxy in a proxy": MappingProxyType({"a": MappingProxyType({"b": line})}),
    }


def same(a, b, where="value"):
    """Asserts that two values hold the same, bit for bit, and are as read-only as each other."""
    assert type(a) is type(b), where
    if isinstance(a, np.ndarray):
        np.testing.assert_array_equal(a, b, err_msg=where)
        assert a.dtype == b.dtype
    elif dataclasses.is_dataclass(a):
        for field in dataclasses.fields(a):
            one, other = getattr(a, field.name), getattr(b, field.name)
            same(one, other, f"{where}.{field.name}")
            if isinstance(a, Frozen) and isinstance(one, np.ndarray):
                assert not other.flags.writeable, f"{where}.{field.name} can be written to"
    elif isinstance(a, Mapping):
        assert list(a) == list(b), where
        for key in a:
            same(a[key], b[key], f"{where}[{key!r}]")
    elif isinstance(a, tuple | list):
        assert len(a) == len(b), where
        for i, (one, other) in enumerate(zip(a, b, strict=True)):
            same(one, other, f"{where}[{i}]")
    else:
        assert a == b or a is b, where


def test_values_are_the_same_after_a_pickle_and_a_deep_copy(tmp_path):
    """Scene, Case and what they are made of go through a process pool and through `deepcopy`."""
    for name, value in values(tmp_path).items():
        for protocol in range(2, pickle.HIGHEST_PROTOCOL + 1):
            same(value, pickle.loads(pickle.dumps(value, protocol)), name)
        same(value, copy.deepcopy(value), name)


def test_a_scene_keeps_its_hash_and_its_solution():
    """The hash of a scene is that of its content, wherever it went."""
    scene = small_scene(
        fixed=[1, 2, 3],
        segments={"jaw": cmfsim.SegmentData(joined=[4])},
        plan={"jaw": cmfsim.rigid_motion((0, 0, 0.1))},
    )
    moved = pickle.loads(pickle.dumps(scene))
    copied = copy.deepcopy(scene)
    assert scene.sha256() == moved.sha256() == copied.sha256()
    first = cmfsim.solve_scene(scene).displacements
    np.testing.assert_array_equal(cmfsim.solve_scene(moved).displacements, first)
    with pytest.raises(ValueError, match="read-only"):
        moved.plan["jaw"][0, 3] = 1.0
    with pytest.raises(TypeError):
        moved.plan["jaw"] = np.eye(4)


def test_a_mapping_that_cannot_be_written_to_can_be_pickled_and_copied():
    """MappingProxyType is what Python cannot pickle: every value of the package holds some."""
    proxied = MappingProxyType({"a": np.arange(3)})
    for moved in (pickle.loads(pickle.dumps(proxied)), copy.deepcopy(proxied)):
        assert type(moved) is MappingProxyType
        np.testing.assert_array_equal(moved["a"], [0, 1, 2])
        assert not moved["a"].flags.writeable
