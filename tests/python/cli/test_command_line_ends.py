"""How commands end: messages, exit codes and JSON of errors, closed outputs, killed parents."""

import contextlib
import importlib.util
import io
import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import cmfsim
from cmfsim.cli import main
from cmfsim.cli.terminal import spell_out
from head_case import HeadCase

pytest.importorskip("meshio")
pytest.importorskip("scipy")


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    return write_head(tmp_path_factory.mktemp("head"))


def write_head(folder, old="", new=""):
    head = HeadCase(rounds=2)
    head.replace("edge_length = 4.0", "edge_length = 16.0")
    head.replace(old, new)
    after = np.asarray(head.surfaces["skin"].vertices) + [0.0, -1.0, 0.0]
    head.surfaces["after"] = cmfsim.SurfaceData(after, head.surfaces["skin"].triangles)
    head.toml += '\n[postoperative]\nskin = "after.ply"\n'
    return head.write(folder)


def run(*words, **options):
    line = [sys.executable, "-m", "cmfsim", *map(str, words)]
    return subprocess.run(line, capture_output=True, check=False, timeout=120, **options)


# A case by its file, its folder, or neither.


@pytest.mark.parametrize("kind", [str, Path])
def test_functions_take_the_path_of_a_case_or_of_its_folder(case, kind):
    """`cmfsim.predict("case.toml")` ended in an AttributeError."""
    loaded = cmfsim.Case.load(case)
    for path in (kind(case), kind(case.parent)):
        assert cmfsim.diagnose(path) == cmfsim.diagnose(loaded)
        assert cmfsim.Case.load(path).name == loaded.name
    stages = []

    class ReachedError(Exception):
        pass

    def stop(stage):
        stages.append(stage)
        raise ReachedError

    for function in (cmfsim.predict, cmfsim.evaluate, cmfsim.sensitivity, cmfsim.build_case):
        with pytest.raises(ReachedError):
            function(kind(case.parent), progress=stop, check=False)
    with pytest.raises(ReachedError):
        next(cmfsim.predict_models(kind(case), ["H"], progress=stop, check=False))
    assert len(stages) == 5


@pytest.mark.parametrize("thing", [None, 3, {"file": "case.toml"}])
def test_what_is_no_case_is_bad_input(thing):
    for function in (cmfsim.predict, cmfsim.evaluate, cmfsim.diagnose, cmfsim.build_model):
        with pytest.raises(cmfsim.CaseError, match="give a Case, or the path"):
            function(thing)


def test_a_folder_without_a_case_is_named_in_full(tmp_path, monkeypatch, capsys):
    """`cmfsim predict .` printed ": is a folder"."""
    monkeypatch.chdir(tmp_path)
    for command in ("predict", "evaluate", "build", "doctor", "sensitivity"):
        assert main([command, "."]) == 2
        assert f"{tmp_path}: is a folder without a case.toml" in capsys.readouterr().err
    assert main(["study", "."]) == 2
    assert f"{tmp_path}: is a folder without a cohort.toml" in capsys.readouterr().err


def test_a_folder_with_a_case_stands_for_it(case, monkeypatch, capsys):
    monkeypatch.chdir(case.parent)
    assert main(["doctor", ".", "--json", "-q"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["case"] == "ellipsoids"
    # Nothing is left to segment.
    assert "not-segmented" not in {finding["code"] for finding in report["findings"]}


def test_a_home_folder_that_nobody_has_is_bad_input(tmp_path, capsys):
    """`Path.expanduser` raised a RuntimeError."""
    path = write_head(tmp_path, 'skin = "skin.ply"', 'skin = "~nosuchuser/skin.ply"')
    assert main(["predict", str(path)]) == 2
    assert "case.toml:6: surfaces.skin is '~nosuchuser/skin.ply'" in capsys.readouterr().err
    cohort = tmp_path / "cohort.toml"
    cohort.write_text(
        'format = "cmfsim-cohort"\nversion = 1\n[[cases]]\nname = "a"\nfile = "~nosuchuser/x"\n'
    )
    assert main(["study", str(cohort)]) == 2
    assert "cohort.toml:5: cases[0].file is '~nosuchuser/x'" in capsys.readouterr().err


# Models by name.


@pytest.mark.parametrize(
    ("models", "said"),
    [
        ("m+s", "did you mean 'M\\+S'"),
        ("MS", "use one of H, M, H\\+S, M\\+S"),
        ([], "no model is named"),
        (["H", "X"], "model is 'X'"),
        ([None], "model is None"),
    ],
)
def test_models_that_are_none_are_named_with_what_was_meant(case, models, said):
    with pytest.raises(cmfsim.CaseError, match=said):
        next(cmfsim.predict_models(case, models))
    with pytest.raises(cmfsim.CaseError, match=said):
        cmfsim.evaluate(case, models)


# Errors as JSON.


def json_error(capsys):
    out, err = capsys.readouterr()
    assert err
    answer = json.loads(out)
    return answer, answer["error"]


def test_errors_are_json_where_json_is_asked_for(case, tmp_path, capsys):
    assert main(["predict", str(tmp_path / "none.toml"), "--json"]) == 2
    _, error = json_error(capsys)
    assert error["kind"] == "FileNotFoundError"
    assert error["exit"] == 2
    assert "none.toml" in error["text"]
    with pytest.raises(SystemExit):
        main(["predict", str(case), "--model", "X", "--json"])
    _, error = json_error(capsys)
    assert error["kind"] == "UsageError"
    assert "invalid choice: 'X'" in error["text"]
    assert main(["predict", str(case), "--json", "--edge-length", "-3"]) == 2
    assert json_error(capsys)[1]["kind"] == "CaseInputError"


def test_errors_of_the_doctor_are_json_too(tmp_path, capsys):
    path = write_head(tmp_path, "mandible.ply", "other.ply")
    for command in ("predict", "evaluate", "build", "sensitivity"):
        assert main([command, str(path), "--json", "-q"]) == 2
        answer, error = json_error(capsys)
        assert (error["kind"], error["exit"]) == ("FindingsError", 2)
        assert "other.ply" in error["text"]
        assert "file-missing" in {finding["code"] for finding in answer["findings"]}


# What was found before any work.


@pytest.mark.parametrize("command", ["predict", "evaluate"])
def test_missing_packages_are_one_line_before_any_work(command, case, monkeypatch, capsys):
    """They were found one by one, after the case was built."""
    missing = {"jinja2", "scipy", "meshio", "pyvista"}
    find = importlib.util.find_spec
    monkeypatch.setattr(
        "cmfsim.pipeline.predicting.find_spec", lambda name: None if name in missing else find(name)
    )
    assert main([command, str(case)]) == 2
    err = capsys.readouterr().err
    assert err.count("pip install") == 1
    assert "pip install '.[imaging,mesh,report]' in cmfsim's folder" in err
    for name in missing:
        assert f"{name}: " in err
    assert "checking" not in err
    missing -= {"scipy", "meshio"}
    assert main([command, str(case)]) == 2
    assert "pip install '.[mesh,report]' in cmfsim's folder" in capsys.readouterr().err
    # Without pictures there is still a report.
    missing -= {"jinja2"}
    monkeypatch.setattr("cmfsim.cli.study_commands.checked", stop)
    with pytest.raises(KeyboardInterrupt):
        main_without_handlers(command, case)
    assert "skipped: pyvista" in capsys.readouterr().err


def stop(*_, **__):
    raise KeyboardInterrupt


def main_without_handlers(command, case):
    if main([command, str(case)]) == 1:
        raise KeyboardInterrupt


@pytest.mark.parametrize("command", ["predict", "evaluate", "build", "sensitivity", "study"])
def test_an_output_that_cannot_be_written_is_found_first(command, case, tmp_path, capsys):
    (tmp_path / "out").write_text("mine")
    if command == "study":
        path = tmp_path / "cohort.toml"
        text = (
            f'format = "cmfsim-cohort"\nversion = 1\noutput = "out"\n[[cases]]\nfile = "{case}"\n'
        )
        path.write_text(text)
        words = [command, str(path)]
    else:
        words = [command, str(case), "-o", str(tmp_path / "out" / "deeper")]
    assert main(words) == 2
    err = capsys.readouterr().err
    assert f"{tmp_path / 'out'}: is a file" in err
    assert "checking" not in err
    assert (tmp_path / "out").read_text() == "mine"


# Units and spelling.


def test_numbers_in_mm_that_are_called_metres_are_said_to_be_mm(tmp_path):
    """They were said to look like micrometres."""
    path = write_head(tmp_path, 'units = "mm"', 'units = "m"')
    found = [f for f in cmfsim.diagnose(path) if f.code == "surface-units"]
    assert len(found) == 1
    assert "look like mm but are read as m" in found[0].what
    assert 'units = "mm"' in found[0].fix
    assert "um" not in found[0].what.split()


@pytest.mark.parametrize("label", ["Nasion", "NASION", "nasion "])
def test_a_landmark_in_capitals_is_the_landmark(tmp_path, label):
    """One finding called it missing, another took it for the landmark."""
    head = HeadCase(rounds=2)
    head.skull = {label if n == "nasion" else n: p for n, p in head.skull.items()}
    head.skull["Supra-M2_L"] = head.skull.pop("supra_m2_L")
    head.toml += '\n[[osteotomies]]\nprocedure = "le_fort_1"\n'
    path = head.write(tmp_path)
    findings = cmfsim.diagnose(path)
    assert not [f for f in findings if f.code == "landmark-missing"]
    notes = [f for f in findings if f.code == "landmark-spelling"]
    assert len(notes) == 1
    assert "'Supra-M2_L' is 'supra_m2_L'" in notes[0].what
    file = cmfsim.io.read_landmark_file(path.parent / "skull.mrk.json")
    assert {"nasion", "supra_m2_L"} <= set(file.points)
    # Read by itself a file keeps its labels.
    assert "Supra-M2_L" in cmfsim.read_landmarks(path.parent / "skull.mrk.json")


def test_a_landmark_in_two_spellings_is_refused(tmp_path):
    path = tmp_path / "a.mrk.json"
    for labels in (("nasion", "Nasion"), ("NASION", "Nasion")):
        points = {label: np.full(3, float(i)) for i, label in enumerate(labels)}
        cmfsim.write_landmarks(path, points)
        with pytest.raises(cmfsim.LandmarkError, match=r"a.mrk.json: has .*'Nasion'"):
            cmfsim.io.read_landmark_file(path)


# Closed outputs.

posix = pytest.mark.skipif(os.name != "posix", reason="needs pipes and signals")


@posix
@pytest.mark.parametrize("closing", ["head -c 1", "true"])
def test_a_closed_pipe_ends_quietly(case, closing):
    """`cmfsim doctor case.toml | head -1` ended in a traceback."""
    word = f"'{sys.executable}' -m cmfsim doctor '{case}' -q; echo $? >&2"
    done = subprocess.run(
        ["/bin/bash", "-c", f"({word}) | {closing}"],
        capture_output=True,
        check=False,
        encoding="utf-8",
    )
    assert "Traceback" not in done.stderr
    assert "Exception" not in done.stderr
    assert done.stderr.split()[-1] in {"141", "0"}
    if closing == "true":
        assert done.stderr.strip() == "141"


@posix
def test_a_closed_or_full_standard_output_is_no_traceback(case):
    for line, code in ((">&-", 0), ("2>&-", 0), ("> /dev/full", 1)):
        if "full" in line and not Path("/dev/full").exists():
            continue
        word = f"'{sys.executable}' -m cmfsim doctor '{case}' -q {line}"
        done = subprocess.run(
            ["/bin/bash", "-c", word], capture_output=True, check=False, encoding="utf-8"
        )
        assert done.returncode == code, done.stderr
        assert "Traceback" not in done.stderr
        assert "Exception" not in done.stderr


# A study's processes.

STUDY = "import sys, cmfsim; cmfsim.run_study(cmfsim.Cohort.load(sys.argv[1]), workers=1)"


def workers_of(output):
    """The processes that work on a case of a study."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if (entry / "fd" / "2").readlink() == output / "log.txt":
                found.append(int(entry.name))
    return found


def wait_until(condition, seconds=60.0):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.02)
    return False


@posix
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_the_processes_of_a_study_end_with_it(case, tmp_path, number):
    """They went on working for a parent that was gone."""
    path = tmp_path / "cohort.toml"
    path.write_text(
        f'format = "cmfsim-cohort"\nversion = 1\n[[cases]]\nname = "one"\nfile = "{case}"\n'
    )
    output = cmfsim.Cohort.load(path).output / "one"
    parent = subprocess.Popen(
        [sys.executable, "-c", STUDY, str(path)], stderr=subprocess.DEVNULL, start_new_session=True
    )
    try:
        assert wait_until(lambda: workers_of(output))
        # It has begun to work, so that more than its start is ended.
        time.sleep(0.5)
        assert workers_of(output)
        parent.send_signal(number)
        parent.wait(timeout=30)
        assert wait_until(lambda: not workers_of(output), 10.0)
        assert not (output / "metrics.json").exists()
    finally:
        parent.kill()
        parent.wait()


# Terminals, limits and ports.


def test_output_in_another_encoding_ends_no_command(case):
    """The minus sign U+2212 ended a finished prediction with exit code 2."""
    environment = {**os.environ, "PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"}
    done = run("doctor", case, env=environment)
    assert done.returncode == 0, done.stderr
    assert "pitch -2.0 deg" in done.stdout.decode("ascii")


@pytest.mark.parametrize(
    ("encoding", "written"),
    [
        ("ascii", b"-5 x 3 >= 2 ... \\u2603 \\udce9"),
        ("cp1252", b"-5 \xd7 3 >= 2 \x85 \\u2603 \\udce9"),
        ("utf-8", "−5 × 3 ≥ 2 … ☃ ".encode() + b"\\udce9"),
    ],
)
def test_characters_that_an_encoding_lacks_are_spelled_or_escaped(encoding, written):
    stream = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
    spell_out(stream)
    print("−5 × 3 ≥ 2 … ☃ \udce9", file=stream, end="", flush=True)
    assert stream.buffer.getvalue() == written


@pytest.mark.parametrize("port", ["80", "65536", "-1", "x", "1e4"])
def test_a_port_that_is_none_is_refused_before_any_work(port, case, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["plan", str(case), "--serve", "--port", port])
    assert ended.value.code == 2
    assert "use 1024 to 65535" in capsys.readouterr().err


@pytest.mark.parametrize("words", [("--trials", "0"), ("--corrections", "-1")])
def test_counts_of_a_page_are_checked_before_any_work(words, case, capsys):
    assert main(["plan", str(case), *words]) == 2
    said = capsys.readouterr().err
    assert f"{words[0].removeprefix('--')} is {words[1]}" in said
    assert "reading" not in said


def test_a_port_that_is_taken_is_reported_before_any_work(case, capsys):
    pytest.importorskip("uvicorn")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        begun = time.monotonic()
        assert main(["plan", str(case), "--serve", "--port", str(port)]) == 1
    assert f"port {port} cannot be used" in capsys.readouterr().err
    assert time.monotonic() - begun < 5.0


def test_a_sagittal_split_leaves_no_mandible_to_plan(tmp_path, capsys):
    """Found by name, before anything is segmented or cut."""
    path = write_head(
        tmp_path, "[plan.mandible]", '[[osteotomies]]\nprocedure = "bsso"\n[plan.mandible]'
    )
    assert main(["doctor", str(path), "-q"]) == 2
    said = capsys.readouterr().out
    assert "[unknown-name]" in said
    assert "write [plan.mandible_body]" in said
