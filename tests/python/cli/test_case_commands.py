"""`cmfsim build` reads the case, asks the doctor first, and names its stages."""

import argparse
import dataclasses
import io
import json
import logging
import re
import sys
import types

import numpy as np
import pytest

import cmfsim
from cmfsim.cli import main
from cmfsim.cli.parsing import make_parser
from cmfsim.cli.terminal import StageProgress, in_colour
from head_case import HeadCase


@pytest.fixture
def built(monkeypatch):
    """The cases that a stand-in for the build stage was given."""
    cases = []

    def build_case(case, *, progress, check, findings, observer):  # noqa: ARG001
        # The command has asked the doctor itself, and shows all that he finds.
        assert not check
        cases.append(case)
        progress("segmenting")
        progress("meshing")
        mesh = cmfsim.mesh_report(cmfsim.TetMesh(np.eye(4, 3, -1), [[0, 1, 2, 3]]))
        summary = {
            "case": case.name + "\x1b[2J",
            "nodes": {"free": 1, "fixed": 2, "joined": 3, "sliding": 4},
            "segments": {"maxilla\x1b[2J": {"joined": 3, "sliding": 4}},
            "mesh": mesh.as_dict(),
            "findings": [dataclasses.asdict(finding) for finding in findings],
            "timings": {"segmenting": 1.25, "meshing": 0.5},
            "output": str(case.output),
            "files": ["scene.npz", "build.json"],
        }
        return types.SimpleNamespace(summary=summary)

    monkeypatch.setitem(
        sys.modules, "cmfsim.pipeline.outputs.model", types.SimpleNamespace(build_case=build_case)
    )
    return cases


def test_build_passes_the_case_and_names_its_stages(built, tmp_path, capsys):
    """Plain lines in a pipe; overrides of folder and edge length reach the stage."""
    path = HeadCase().write(tmp_path)
    words = ["build", str(path), "-o", str(tmp_path / "there"), "--edge-length", "2.5"]
    assert main(words) == 0
    out, err = capsys.readouterr()
    lines = err.splitlines()
    # Before any work: a plan that is reversed is seen here, not in the face.
    assert lines.pop(1).startswith("cmfsim: plan: mandible: 4.0 mm forwards")
    assert lines == [f"cmfsim: {s}" for s in ("checking the case", "segmenting", "meshing")]
    assert "\x1b" not in out + err
    assert "nodes         1 free, 2 fixed, 3 joined, 4 sliding" in out
    assert "mesh          4 nodes, 1 tets" in out
    assert f"written       {tmp_path / 'there'}" in out
    assert max(len(line) for line in out.splitlines() if "written" not in line) <= 100
    assert (built[0].output, built[0].mesh.edge_length) == (tmp_path / "there", 2.5)
    assert main([*words, "--json", "-q"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    summary = json.loads(out)
    assert summary["mesh"]["n_tets"] == 1
    assert list(summary["timings"]) == ["checking the case", "segmenting", "meshing"]


def test_build_stops_at_an_error_of_the_doctor(built, tmp_path, capsys):
    """Findings on standard error, exit code 2, nothing built; unless told not to ask."""
    head = HeadCase()
    head.replace("skin.ply", "face.ply")
    path = head.write(tmp_path)
    assert main(["build", str(path)]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert "file-missing" in err
    assert built == []
    assert main(["build", str(path), "--no-doctor"]) == 0
    assert len(built) == 1


@pytest.mark.parametrize("value", ["0", "-1", "nan", "inf"])
def test_a_faulty_edge_length_is_bad_input(value, built, tmp_path, capsys):
    """Before anything is read of the case's files."""
    path = HeadCase().write(tmp_path)
    assert main(["build", str(path), f"--edge-length={value}"]) == 2
    assert "--edge-length is" in capsys.readouterr().err
    assert built == []


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self):
        """Always."""
        return True


def test_a_terminal_gets_one_line_that_is_erased_at_the_end():
    """Each update begins at the start of the line; a name cannot steer the terminal."""
    stream = Terminal()
    with StageProgress(stream) as progress:
        progress.stage("mesh\x1bing")
    text = stream.getvalue()
    assert "\n" not in text
    assert text.startswith("\r\x1b[Kcmfsim: mesh\\x1bing 0.0 s")
    assert text.endswith("\r\x1b[K")


def test_a_pipe_gets_a_line_per_stage_and_none_per_step_or_log_line(caplog):
    """A plan of 96 solutions printed 230 lines."""
    stream, logger = io.StringIO(), logging.getLogger("cmfsim.solving")
    with caplog.at_level(logging.INFO, "cmfsim"), StageProgress(stream) as progress:
        progress.stage("meshing")
        for step in range(96):
            progress.stage(f"solving nearby plans ({step + 1} of 96)")
            logger.info("solved")
            logger.warning("a warning is shown")
    assert stream.getvalue() == "cmfsim: meshing\ncmfsim: solving nearby plans\n"
    assert {record.getMessage() for record in caplog.records} == {"a warning is shown"}


def test_the_line_of_a_terminal_begins_with_share_and_time_left():
    """Of the stages that are expected."""
    stream = Terminal()
    with StageProgress(stream, expected={"cutting the bones": 3.0, "solving M": 5.0}) as progress:
        progress.stage("cutting the bones")
    assert "\n" not in stream.getvalue()
    assert re.match(r"\r\x1b\[Kcmfsim: 0 %, about 8 s left: cutting the bo", stream.getvalue())


def test_a_quiet_display_says_nothing():
    """Neither on a terminal nor in a pipe."""
    for stream in (Terminal(), io.StringIO()):
        with StageProgress(stream, quiet=True) as progress:
            progress.stage("meshing")
        assert stream.getvalue() == ""


def test_colours_follow_the_terminal_and_no_color(monkeypatch):
    """https://no-color.org: any value of NO_COLOR but the empty one turns them off."""
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.delenv("NO_COLOR", raising=False)
    assert in_colour(Terminal())
    assert not in_colour(io.StringIO())
    monkeypatch.setenv("NO_COLOR", "1")
    assert not in_colour(Terminal())
    finding = cmfsim.Finding("x", "something", severity="error")
    assert "\x1b[31;1merror\x1b[0m" in cmfsim.values.finding.findings_text([finding], colour=True)


def leaves(parser, name="cmfsim"):
    """Every command with a function of its own, by its words."""
    below = [a for a in parser._actions if isinstance(a, argparse._SubParsersAction)]
    if not below:
        return {name: parser}
    return {
        words: leaf
        for action in below
        for word, command in action.choices.items()
        for words, leaf in leaves(command, f"{name} {word}").items()
    }


@pytest.mark.parametrize("words", leaves(make_parser()))
def test_every_command_can_be_quiet(words):
    """`main` asks each for it."""
    flags = {
        flag for action in leaves(make_parser())[words]._actions for flag in action.option_strings
    }
    assert {"-q", "--quiet"} <= flags


def test_a_folder_without_results_has_no_report(tmp_path, capsys):
    assert main(["report", str(tmp_path)]) == 2
    assert "holds no prediction.json" in capsys.readouterr().err
