"""`cmfsim plan` writes a page, and `cmfsim predict --plan` takes the plan that a page saves."""

import argparse
import contextlib
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
from cmfsim.build import plan_key
from cmfsim.cli import main
from cmfsim.cli.case_commands import case_of
from cmfsim.planning_page import page_state
from head_case import HeadCase

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
def answer(case):
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        assert main(["plan", str(case), "--json", "--trials", "2", *MODEL]) == 0
    return json.loads(said.getvalue())


def test_plan_writes_the_page_of_the_case(case, answer):
    page = case.parent / "out/plan.html"
    assert answer["page"] == str(page)
    assert answer["bytes"] == page.stat().st_size < 12e6
    assert page_state(page) == plan_key(cmfsim.Case.load(case))
    # Nothing slides in model H: the page is exact, as one solution shows.
    assert not answer["expected_error"]["slides"]
    assert answer["expected_error"]["trials"][0]["largest_mm"] < 1e-6


def test_a_served_page_ends_with_ctrl_c(case):
    pytest.importorskip("uvicorn")
    words = ["-m", "cmfsim", "plan", str(case), "--serve", "--json", "--no-open", *MODEL]
    with subprocess.Popen([sys.executable, *words], stdout=subprocess.PIPE, text=True) as running:
        url = json.loads(running.stdout.readline())["url"]
        with urllib.request.urlopen(url, timeout=30) as answer:  # noqa: S310 (our own address)
            assert b"connect-src 'self'" in answer.read().replace(b"&#x27;", b"'")
        running.send_signal(signal.SIGINT)
        assert running.wait(timeout=30) == 0


def test_predict_takes_the_plan_of_a_page(case, answer, capsys):
    file = case.parent / "saved.toml"
    state = plan_key(cmfsim.Case.load(case))
    file.write_text(PLAN.format(state=state, matrix=MOTION.tolist()), encoding="utf-8")
    assert main(["predict", str(case), "--plan", str(file), "--json", *MODEL]) == 0
    said = capsys.readouterr()
    assert "another case" not in said.err
    found = json.loads(said.out)["predictions"][0]
    assert found["model"] == "H"
    summary = json.loads((case.parent / "out/prediction.json").read_text("utf-8"))
    # The motion of the file, not of the case.
    assert summary["plan"]["mandible"]["clinical"]["pitch_deg"] == pytest.approx(-3.0)
    report = (case.parent / "out/report.html").read_text("utf-8")
    assert '<a href="plan.html">Planning page</a>' in report
    assert answer["page"]


def test_a_plan_of_another_head_is_warned_of(case, caplog):
    file = case.parent / "strange.toml"
    file.write_text(PLAN.format(state="0" * 64, matrix=MOTION.tolist()), encoding="utf-8")
    loaded = cmfsim.Case.load(case)
    state = plan_key(loaded)
    # Neither plan, mesh nor muscles change what a plan is about; landmarks do.
    assert plan_key(loaded.with_plan(file)) == state
    options = argparse.Namespace(case=case, plan=file, edge_length=None, output=None)
    assert case_of(options).plan.keys() == {"mandible"}
    assert "was made for another case" in caplog.text


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
