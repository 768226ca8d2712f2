"""The command line that solves scenes and lists what they hold."""

import dataclasses
import json
import subprocess
import sys

import numpy as np
import pytest
from block_scene import HIGH, TETS, scene

import cmfsim
from cmfsim.cli import main


def run(capsys, *words):
    code = main([str(w) for w in words])
    out = capsys.readouterr()
    return code, out.out, out.err


@pytest.mark.parametrize("suffix", [".npz", ".vtu", ".vtp"])
def test_solve_writes_the_result(suffix, saved, capsys):
    """Exit code 0, progress on stderr, figures on stdout, the file in place."""
    out = saved.parent / f"out{suffix}"
    code, text, progress = run(capsys, "solve", saved, "-o", out)
    assert code == 0, progress
    assert "displacement" in text
    assert "cholesky" in text
    assert "wrote" in progress
    assert out.stat().st_size > 0
    assert [p.name for p in saved.parent.glob(".*")] == []


def test_solve_gives_json_for_machines(saved, capsys):
    """One object on stdout, nothing else; -q leaves stderr empty."""
    out = saved.parent / "out.npz"
    code, text, progress = run(capsys, "solve", saved, "-o", out, "--json", "-q")
    assert code == 0
    assert progress == ""
    summary = json.loads(text)
    assert summary["n_tets"] == len(TETS)
    assert summary["scene_sha256"] == scene().sha256()
    assert cmfsim.read_result(out).summary["method"] == "cholesky"


def test_options_replace_those_of_the_scene(saved, capsys):
    """--method, --contact and --plan win over the file."""
    s = dataclasses.replace(
        scene(),
        segments={"bone": cmfsim.SegmentData(joined=HIGH), "floor": scene().segments["floor"]},
        plan={"bone": np.eye(4), "floor": np.eye(4)},
    )
    cmfsim.write_scene(saved, s)
    plan = saved.parent / "plan.json"
    plan.write_text(
        json.dumps({"plan": {"bone": {"translation": [0, 0, 1]}, "floor": {"angle": 0}}})
    )
    out = saved.parent / "out.npz"
    words = ("solve", saved, "-o", out, "--method", "pcg", "--contact", "unilateral")
    code, _, progress = run(capsys, *words, "--plan", plan, "--tolerance", "1e-8")
    assert code == 0, progress
    result = cmfsim.read_result(out)
    assert result.summary["method"] == "pcg"
    assert result.summary["contact"] == "unilateral"
    np.testing.assert_allclose(result.displacements[HIGH, 2], 1.0, atol=1e-12)


def test_info_says_what_a_scene_holds(saved, capsys):
    """Counts, names escaped, hash."""
    code, text, _ = run(capsys, "info", saved)
    assert code == 0
    assert f"{len(TETS)} tets" in text
    assert "\x1b" not in text
    assert "bone \\x1b[31m/.." in text
    code, text, _ = run(capsys, "info", saved, "--json")
    assert json.loads(text)["sha256"] == scene().sha256()


@pytest.mark.parametrize(
    "words",
    [
        ("solve", "missing.npz", "-o", "out.npz"),
        ("solve", "{scene}", "-o", "out.txt"),
        ("solve", "{scene}", "-o", "nowhere/out.npz"),
        ("solve", "{scene}", "-o", "{scene}"),
        ("solve", "{folder}", "-o", "out.npz"),
        ("solve", "{scene}", "-o", "out.npz", "--tolerance", "-1"),
        ("solve", "{scene}", "-o", "out.npz", "--plan", "missing.toml"),
        ("info", "missing.npz"),
    ],
)
def test_bad_input_exits_with_2(words, saved, capsys, monkeypatch):
    """A missing file, another ending, no folder, the scene itself as the result."""
    monkeypatch.chdir(saved.parent)
    before = saved.read_bytes()
    code, text, err = run(capsys, *(w.format(scene=saved, folder=saved.parent) for w in words))
    assert code == 2
    assert text == ""
    assert "error: " in err
    assert "Traceback" not in err
    assert saved.read_bytes() == before


@pytest.mark.parametrize("words", [(), ("solve",), ("solve", "a.npz"), ("fly",), ("--speed",)])
def test_wrong_words_exit_with_2(words, capsys):
    """Argparse's own exit code is ours."""
    try:
        code = main(list(words))
    except SystemExit as error:
        code = error.code
    assert code == 2
    assert "usage" in capsys.readouterr().err


def test_a_failed_solve_exits_with_1_and_leaves_the_old_result(saved, capsys):
    """Not converging is no input error; the result of before stays whole."""
    options = cmfsim.SolverOptions(method="relaxation", max_iterations=1)
    cmfsim.write_scene(saved, scene(options=options))
    out = saved.parent / "out.npz"
    out.write_bytes(b"old")
    code, _, err = run(capsys, "solve", saved, "-o", out)
    assert code == 1, err
    assert out.read_bytes() == b"old"
    assert sorted(p.name for p in saved.parent.iterdir()) == ["out.npz", "scene.npz"]


def test_physics_found_wrong_by_the_core_exits_with_2(saved, capsys):
    """An inverted tet comes through the file to its name."""
    tets = TETS.copy()
    tets[3] = tets[3][[1, 0, 2, 3]]
    cmfsim.write_scene(saved, scene(tets=tets))
    code, _, err = run(capsys, "solve", saved, "-o", saved.parent / "out.npz")
    assert code == 2
    assert "tet 3 is inverted" in err


def test_the_program_runs_as_a_module(saved):
    """`python -m cmfsim --version` and help in a process of its own."""
    for words, expected in ((["--version"], cmfsim.__version__), (["--help"], "solve")):
        done = subprocess.run(
            [sys.executable, "-m", "cmfsim", *words],
            check=True,
            capture_output=True,
            text=True,
            cwd=saved.parent,
        )
        assert expected in done.stdout
