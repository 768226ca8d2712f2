"""`cmfsim plan` writes a page, and `cmfsim predict --plan` takes the plan that a page saves."""

import argparse
import contextlib
import dataclasses
import io
import json
import re
import signal
import subprocess
import sys
import urllib.request

import numpy as np
import pytest

import cmfsim
from cmfsim.cli import main
from cmfsim.cli.case_commands import case_of
from cmfsim.io.cases.tables import read_tables
from cmfsim.pipeline.building.inputs import plan_key
from cmfsim.pipeline.building.stages import BuildOptions
from cmfsim.pipeline.planning import page_state
from cmfsim.pipeline.predicting import build_patient
from cmfsim.values.case_parts import CaseMesh
from head_case import HeadCase
from shared_values import without_drawings

pytest.importorskip("skimage")
pytest.importorskip("meshio")
pytest.importorskip("jinja2")

MODEL = ["--model", "H", "--edge-length", "9", "--no-doctor", "-q"]
MOTION = cmfsim.rigid_motion((0, -2.5, 1), 3, (1, 0, 0), (3, -100, 1450))
PLAN = """# made for: {state}

[plan.mandible]
matrix = {matrix}
"""


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    return HeadCase().write(tmp_path_factory.mktemp("plan"))


@pytest.fixture(scope="module")
def wished(case):
    """The chin of the skin 2 mm further back than it is, and where it should come to."""
    place = cmfsim.read_landmarks(case.parent / "skin.mrk.json")["pogonion"] + [0.0, 2.0, 0.0]
    file = case.parent / "wished.mrk.json"
    cmfsim.write_landmarks(file, {"Pogonion": place})
    return file, place


@pytest.fixture(scope="module")
def answer(case, wished):
    said = io.StringIO()
    words = ["plan", str(case), "--json", "--trials", "2", "--towards", str(wished[0]), *MODEL]
    with contextlib.redirect_stdout(said):
        assert main(words) == 0
    return json.loads(said.getvalue())


def test_plan_writes_the_page_of_the_case(case, answer):
    page = case.parent / "out/plan.html"
    assert answer["page"] == str(page)
    assert answer["bytes"] == page.stat().st_size < 12e6
    assert page_state(page) == plan_key(cmfsim.Case.load(case))
    # Nothing slides or is lifted in model H: the page is exact, as one solution shows.
    assert answer["expected_error"]["is_exact"]
    assert answer["expected_error"]["trials"][0]["largest_mm"] < 1e-6


def test_python_makes_the_page_of_the_command(case, answer, wished, tmp_path):
    loaded = cmfsim.Case.load(case)
    mesh = dataclasses.replace(loaded.mesh, edge_length=9.0)
    loaded = dataclasses.replace(loaded, mesh=mesh, output=tmp_path)
    stages = []
    page = cmfsim.make_planning_page(
        loaded, model="H", trials=2, towards=wished[0], check=False, progress=stages.append
    )
    assert stages[-1] == "making the page"
    for name in ("plan.html", "towards.toml"):
        made, command = (
            re.sub(r'"seconds": ?[^,}]+', "", (folder / name).read_text("utf-8"))
            for folder in (tmp_path, case.parent / "out")
        )
        assert made == command
    assert page.as_dict()["towards"] == answer["towards"]
    with pytest.raises(cmfsim.CaseError, match="trials is 0"):
        cmfsim.make_planning_page(loaded, trials=0)


def test_a_served_page_ends_with_ctrl_c(case, tmp_path):
    pytest.importorskip("uvicorn")
    out = ["-o", str(tmp_path / "served")]
    words = ["-m", "cmfsim", "plan", str(case), "--serve", "--json", "--no-open", *out, *MODEL]
    with subprocess.Popen([sys.executable, *words], stdout=subprocess.PIPE, text=True) as running:
        url = json.loads(running.stdout.readline())["url"]
        with urllib.request.urlopen(url, timeout=30) as answer:  # noqa: S310 (our own address)
            assert b"connect-src 'self'" in answer.read().replace(b"&#x27;", b"'")
        running.send_signal(signal.SIGINT)
        assert running.wait(timeout=30) == 0


def test_the_plan_of_a_wished_face_is_found_and_saved(case, answer):
    found = answer["towards"]
    assert found["converged"]
    # Solved exactly: half a millimetre is one deviation.
    assert 0.5 * found["rms"][0] < 0.1
    # One point cannot determine six numbers.
    assert "mandible: yaw" in found["undetermined"]
    saved = cmfsim.Case.load(case).with_plan(case.parent / "out/towards.toml")
    skull = cmfsim.read_landmarks(case.parent / "skull.mrk.json")
    matrix = saved.plan["mandible"].matrix
    stated = cmfsim.clinical_motion("mandible", matrix, landmarks=skull)
    assert stated.forwards == pytest.approx(found["plan"]["mandible"]["forwards_mm"])
    page = (case.parent / "out/plan.html").read_text("utf-8")
    values = json.loads(re.search(r'id="page-values">([^<]*)<', page)[1])
    assert [variant["name"] for variant in values["variants"]] == ["Towards"]
    number = [segment["name"] for segment in values["segments"]].index("mandible")
    np.testing.assert_allclose(
        np.reshape(values["variants"][0]["motions"][number], (4, 4)), matrix, atol=1e-12
    )


def test_predict_takes_the_plan_of_a_page(case, answer, wished, capsys, monkeypatch):
    # Pictures are tested elsewhere, and take longer than the rest.
    without_drawings(monkeypatch)
    file = case.parent / "out/towards.toml"
    # Beside the results, which predict replaces.
    plan = case.parent / "saved.toml"
    plan.write_bytes(file.read_bytes())
    assert main(["predict", str(case), "--plan", str(plan), "--json", *MODEL]) == 0
    said = capsys.readouterr()
    assert "another case" not in said.err
    assert json.loads(said.out)["predictions"][0]["model"] == "H"
    # The motion of the file, not of the case, and the face that was wished for.
    summary = json.loads((case.parent / "out/prediction.json").read_text("utf-8"))
    clinical = summary["plan"]["mandible"]["clinical"]
    wanted = answer["towards"]["plan"]["mandible"]
    assert clinical["forwards_mm"] == pytest.approx(wanted["forwards_mm"])
    surface, after = cmfsim.io.read_parts(case.parent / "out")["skin"]["skin"]
    before = np.asarray(surface.vertices)
    nearest = np.argmin(np.linalg.norm(before - (wished[1] - [0.0, 2.0, 0.0]), axis=1))
    assert (after - before)[nearest][1] == pytest.approx(2.0, abs=0.5)
    report = (case.parent / "out/report.html").read_text("utf-8")
    assert '<a href="plan.html">Planning page</a>' in report
    # A page of another head stays: somebody may have planned in it. It is no longer linked.
    page = case.parent / "out/plan.html"
    kept = page.read_bytes()
    state = kept.partition(b'"cmfsim-made-for" content="')[2][:64]
    page.write_bytes(kept.replace(state, b"0" * 64))
    assert main(["report", str(case)]) == 0
    page.write_bytes(kept)
    assert "plan.html shows another head" in capsys.readouterr().err
    assert "Planning page" not in (case.parent / "out/report.html").read_text("utf-8")


def test_wishes_that_are_none_are_refused_before_any_work(case, tmp_path, capsys):
    strange = tmp_path / "face.txt"
    strange.write_text("nothing", encoding="utf-8")
    for words, said in (
        ([str(strange)], "a file with a desired face ends in"),
        ([str(tmp_path / "absent.stl")], "absent.stl"),
    ):
        assert main(["plan", str(case), "--towards", *words, *MODEL]) == 2
        assert said in capsys.readouterr().err


def test_a_written_plan_is_read_back(case, tmp_path):
    plan = {"mandible": MOTION, "pièce+2": np.eye(4)}
    cmfsim.write_plan(tmp_path / "plan.toml", {"mandible": MOTION}, made_for="0" * 64)
    loaded = cmfsim.Case.load(case).with_plan(tmp_path / "plan.toml")
    np.testing.assert_allclose(loaded.plan["mandible"].matrix, MOTION, atol=1e-15)
    cmfsim.write_plan(tmp_path / "plan.toml", plan)
    assert list(read_tables(tmp_path / "plan.toml").table("plan")) == list(plan)
    with pytest.raises(cmfsim.BoundaryError):
        cmfsim.write_plan(tmp_path / "plan.toml", {"mandible": 2 * np.eye(4)})
    with pytest.raises(cmfsim.CaseError, match="is not a valid name"):
        cmfsim.write_plan(tmp_path / "plan.toml", {'a "b"\n': np.eye(4)})


def test_a_plan_of_another_head_is_warned_of(case):
    file = case.parent / "strange.toml"
    file.write_text(PLAN.format(state="0" * 64, matrix=MOTION.tolist()), encoding="utf-8")
    loaded = cmfsim.Case.load(case)
    state = plan_key(loaded)
    # Neither plan, mesh nor muscles change what a plan is about; landmarks do.
    assert plan_key(loaded.with_plan(file)) == state
    options = argparse.Namespace(case=case, plan=file, edge_length=None, output=None)
    given = dataclasses.replace(case_of(options), mesh=CaseMesh(edge_length=12.0))
    assert given.plan.keys() == {"mandible"}
    for made_for, warned in ((given.made_for, True), (state, False)):
        found = dataclasses.replace(given, made_for=made_for)
        patient = build_patient(found, ["H"], BuildOptions(check=False))
        assert ("plan-other-case" in [f.code for f in patient.findings]) == warned
        assert ("plan-other-case" in [f["code"] for f in patient.summary["findings"]]) == warned


def test_plans_in_files_are_checked_with_their_lines(case, tmp_path):
    loaded = cmfsim.Case.load(case)
    faults = {
        "has no motion": "# nothing\n",
        "mesh": "[mesh]\nedge_length = 3\n[plan.mandible]\ntranslation = [0, 0, 1]\n",
        "matrix": "[plan.mandible]\nmatrix = [[1, 0], [0, 1]]\n",
    }
    for said, text in faults.items():
        file = tmp_path / "plan.toml"
        file.write_text(text, encoding="utf-8")
        with pytest.raises(cmfsim.CaseError, match=re.escape(said)):
            loaded.with_plan(file)
    with pytest.raises(FileNotFoundError):
        loaded.with_plan(tmp_path / "absent.toml")
    file.write_text("[plan.mandible]\ntranslation = [0, -4, 0]\n", encoding="utf-8")
    moved = loaded.with_plan(file).plan["mandible"].matrix
    np.testing.assert_allclose(moved, cmfsim.rigid_motion((0, -4, 0)))
