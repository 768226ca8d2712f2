"""The server of the desk: what it refuses, what it writes, and work that dies or is stopped."""

import hashlib
import json
import os
import signal
import subprocess
import sys
import threading

import numpy as np
import pytest

import cmfsim
import head_case
from cmfsim.cli import main
from cmfsim.desk import work
from cmfsim.desk.case_text import open_questions
from cmfsim.desk.server import desk_server
from cmfsim.desk.session import Session
from cmfsim.processes.worker import Answer
from local_requests import asked, origin_of, wait_for

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")

CALLS = ("answer", "cuts", "compute", "save-landmarks", "save-plan", "report", "open", "cancel")


@pytest.fixture
def folder(tmp_path):
    case = head_case.HeadCase().write(tmp_path)
    text = case.read_text(encoding="utf-8").replace("edge_length = 4.0", "edge_length = 12.0")
    text = text.partition("[plan.mandible]")[0] + "[tissue]  # mine\npreset = 'kim2010'\n"
    case.write_text(text, encoding="utf-8")
    return tmp_path


@pytest.fixture
def session(folder):
    """The head of ellipsoids, as if it had been opened."""
    made = Session(folder)
    surfaces, arrays = [], {}
    for number, name in enumerate(("cranium", "mandible", "skin")):
        surface = cmfsim.read_surface(folder / f"{name}.ply")
        surfaces.append({"name": name, "part": name, "away": 0.0})
        arrays[f"surface_{number}"] = surface.vertices.astype(np.float32)
        arrays[f"surface_{number}_triangles"] = surface.triangles.astype(np.uint32)
    skull = {n: p.tolist() for n, p in cmfsim.read_landmarks(folder / "skull.mrk.json").items()}
    sites = [{"kind": "skull", "name": name, "doubt": "", "why": ""} for name in skull]
    page = {"surfaces": surfaces, "target": [0, 0, 0], "span": 100.0, "sites": sites}
    made.made["open_head"] = Answer({"page": page, "skull": skull, "findings": []}, arrays)
    yield made
    made.end()


def running(session):
    """Yields the server of a session."""
    server = desk_server(session)
    thread = threading.Thread(target=server.run)
    thread.start()
    yield server
    server.stop()
    thread.join(timeout=20)


@pytest.fixture
def server(session):
    yield from running(session)


def posted(server, name, values):
    """The status and the values, or the text, of the answer to a call."""
    sent = {"Origin": origin_of(server.url), "Content_Type": "application/json"}
    status, text, _ = asked(f"{server.url}{name}", json.dumps(values), **sent)
    return (status, json.loads(text)) if status == 200 else (status, text.decode())


@pytest.fixture
def post(server):
    return lambda name, **values: posted(server, name, values)


@pytest.fixture
def state(server):
    return lambda: json.loads(asked(f"{server.url}state")[1])


def test_strangers_get_nothing_and_change_nothing(server, folder):
    url, origin = server.url, origin_of(server.url)
    before = (folder / "case.toml").read_bytes()
    sent = {"Origin": origin, "Content_Type": "application/json"}
    for name in CALLS:
        assert asked(f"{origin}/wrong/{name}", "{}", **sent)[0] == 404
        assert asked(f"{url}{name}", "{}", **{**sent, "Origin": "http://evil.example"})[0] == 403
        assert asked(f"{url}{name}", "{}", Host="evil.example", **sent)[0] == 403
        assert asked(f"{url}{name}", "{}", Content_Type="application/json")[0] == 403
        assert asked(f"{url}{name}", "{}", **{**sent, "Content_Type": "text/plain"})[0] == 415
        assert asked(f"{url}{name}", " " * 70_000, **sent)[0] == 413
        assert asked(f"{url}{name}", "[1", **sent)[0] == 400
        assert asked(f"{url}{name}", "[" * 5000, **sent)[0] == 400
        assert asked(f"{url}{name}", "[]", **sent)[0] == 400
        assert asked(f"{url}{name}")[0] == 405
    for name in ("", "landmarks", "plan", "state", "report.html"):
        assert asked(f"{url}{name}", Host="evil.example")[0] == 403
    for path in (
        "case.toml",
        "../case.toml",
        "%2e%2e/case.toml",
        "out/report.html",
        "//etc/passwd",
    ):
        assert asked(f"{url}{path}")[0] == 404, path
    # Files that are there, but that this desk did not write.
    (folder / "out").mkdir()
    (folder / "out/report.html").write_text("not mine")
    assert asked(f"{url}report.html")[0] == 404
    assert (folder / "case.toml").read_bytes() == before


def test_cuts_are_shown_and_what_cannot_be_is_named(post):
    status, shown = post("cuts", cuts={"le_fort_1": {"height": 2.0}, "bsso": {}})
    assert status == 200
    assert {piece["name"] for piece in shown["pieces"]} == {"maxilla", "ramus_left", "ramus_right"}
    assert {h["option"] for h in shown["handles"]} == {
        "height", "posterior", "width", "setback", "lingula",
    }  # fmt: skip
    for handle in shown["handles"]:
        assert np.linalg.norm(handle["way"]) == pytest.approx(1.0, abs=0.1)
    higher = post("cuts", cuts={"le_fort_1": {"height": 7.0}})[1]
    way = next(h["way"] for h in shown["handles"] if h["option"] == "height")
    normal = [p["groups"][0][0] for s in (shown, higher) for p in s["pieces"][:1]]
    # Five units further along the way of the handle.
    assert normal[1][3] - normal[0][3] == pytest.approx(-5.0 * np.dot(way, normal[0][:3]), abs=1e-6)
    for cuts, said in (
        ({"heart": {}}, "procedure"),
        ({"bsso": {"depth": 1}}, "no option 'depth'"),
        ({"bsso": {"setback": 99}}, "-15 to 25"),
        ({"bsso": {"setback": "2"}}, "setback"),
    ):
        status, text = post("cuts", cuts=cuts)
        assert (status, said in text) == (422, True), text
    assert post("cuts", cuts=[])[0] == post("cuts", cuts={"bsso": 1})[0] == 400


def test_cuts_and_first_moves_go_into_the_case_file(post, state, session, folder, monkeypatch):
    started = []
    monkeypatch.setattr(session, "start", lambda *given: started.append(given[0]))
    cuts, moves = {"bsso": {"setback": 3.0}}, {"mandible_body": [-3.0, 0.5, 0.0]}
    status, _ = post("compute", seen=state()["seen"], cuts=cuts, moves=moves)
    assert (status, started) == (200, ["compute"])
    case = cmfsim.Case.load(folder)
    assert [(c.procedure, dict(c.options)) for c in case.osteotomies] == [
        ("bsso", {"setback": 3.0})
    ]
    assert case.plan["mandible_body"].matrix[:3, 3].tolist() == [0.0, 3.0, 0.5]
    assert "[tissue]  # mine" in (folder / "case.toml").read_text(encoding="utf-8")
    # Without its cut, a segment cannot move.
    status, _ = post("compute", seen=state()["seen"], cuts={"genioplasty": {}}, moves={})
    assert status == 200
    case = cmfsim.Case.load(folder)
    assert [c.procedure for c in case.osteotomies] == ["genioplasty"]
    assert not case.plan


def test_moves_and_cuts_that_make_no_plan_are_refused(post, state, folder):
    before = (folder / "case.toml").read_bytes()
    for moves, status, said in (
        ({"maxilla": [31.0, 0, 0]}, 400, "at most 30 mm"),
        ({"maxilla": [1.0, 0]}, 400, "three numbers"),
        ({"maxilla": [True, 0, 0]}, 400, "three numbers"),
        ({"maxilla": ["1", 0, 0]}, 400, "three numbers"),
        ({"maxilla": [float("nan"), 0, 0]}, 400, "at most 30 mm"),
        ({"chin": [1.0, 0, 0]}, 422, "chin is no segment"),
    ):
        given = post("compute", seen=state()["seen"], cuts={"le_fort_1": {}}, moves=moves)
        assert (given[0], said in given[1]) == (status, True), given
    status, text = post("compute", seen=state()["seen"], cuts={}, moves={})
    assert (status, "choose a procedure" in text) == (422, True)
    assert (folder / "case.toml").read_bytes() == before


def test_of_two_tabs_the_second_does_not_overwrite_what_it_has_not_seen(post, state, folder):
    first = second = state()["seen"]
    markups = (folder / "skull.mrk.json").read_text(encoding="utf-8")
    status, after = post("save-landmarks", seen=first, skull=markups)
    assert status == 200
    assert cmfsim.Case.load(folder).landmarks.skull.name == "skull_landmarks.mrk.json"
    written = (folder / "case.toml").read_bytes()
    for name, values in (
        ("save-landmarks", {"skull": markups}),
        ("compute", {"cuts": {"bsso": {}}}),
    ):
        status, text = post(name, seen=second, **values)
        assert (status, "another tab" in text) == (409, True)
        assert post(name, **values)[0] == 409
    assert (folder / "case.toml").read_bytes() == written
    assert post("save-landmarks", seen=after["seen"], skull=markups)[0] == 200


def test_landmarks_that_cannot_be_read_are_not_saved(post, state, folder):
    before = sorted(folder.iterdir()), (folder / "case.toml").read_bytes()
    for given, status in (
        ({}, 400),
        ({"skull": 3}, 400),
        ({"skull": "{}"}, 422),
        ({"skull": '{"markups": [{"controlPoints": [{"label": "x", "position": [1]}]}]}'}, 422),
    ):
        assert post("save-landmarks", seen=state()["seen"], **given)[0] == status
    assert (sorted(folder.iterdir()), (folder / "case.toml").read_bytes()) == before


def test_a_plan_without_an_operator_is_not_saved(post, state):
    motions = [np.eye(4).ravel().tolist()]
    status, text = post("save-plan", seen=state()["seen"], motions=motions)
    assert (status, "compute it again" in text) == (422, True)
    assert post("save-plan", seen=state()["seen"], motions="x")[0] == 400
    assert post("solve", motions=motions)[0] == 422


@pytest.mark.skipif(os.name != "posix", reason="signals are POSIX")
def test_a_report_of_an_earlier_plan_is_gone_when_another_is_asked_for(
    server, post, state, session, folder
):
    """Also if the new one fails, and if another program has written one in its place."""
    (folder / "out").mkdir()
    file = folder / "out/report.pdf"
    file.write_bytes(b"%PDF of plan A")
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    session.made["report"] = Answer({"files": {"report.pdf": digest}, "findings": []}, {})
    session.reported = session.text()
    assert state()["files"] == ["report.pdf"]
    assert asked(f"{server.url}report.pdf")[1] == b"%PDF of plan A"
    file.write_bytes(b"%PDF of plan B, by cmfsim predict --plan")
    status, text, _ = asked(f"{server.url}report.pdf")
    assert status == 409
    assert b"another program" in text
    case = folder / "case.toml"
    case.write_text(case.read_text(encoding="utf-8") + "# plan B\n", encoding="utf-8")
    assert state()["files"] == []

    def fails(kind):
        raise OSError(f"{kind}: disk full")

    session._work = fails
    assert post("report")[0] == 200
    wait_for(lambda: state()["error"] == "report: disk full")
    assert state()["files"] == []
    assert asked(f"{server.url}report.pdf")[0] == 404


def test_a_worker_that_is_killed_or_stopped_is_reported_and_replaced(post, state, session):
    status, _ = post("open")
    assert status == 200
    wait_for(lambda: session._worker is not None)
    assert post("report")[0] == 409
    os.kill(session._worker.pid, signal.SIGKILL)
    wait_for(lambda: not session.busy)
    assert "exit code -9" in state()["error"]
    assert post("open")[0] == 200
    wait_for(lambda: session._worker.alive)
    assert post("cancel")[0] == 200
    wait_for(lambda: not session.busy)
    assert state()["error"] == "stopped"
    # What cannot be read is an error of the page, not an end without a word.
    session.case_file.write_text("nonsense")
    assert "is not TOML" in state()["error"]
    assert post("open")[0] == 200
    wait_for(lambda: not session.busy)
    assert "is not TOML" in state()["error"]


def test_a_folder_without_a_case_is_set_up_and_its_questions_are_answered(tmp_path):
    pytest.importorskip("SimpleITK")
    image = cmfsim.make_head().ct(6.0)
    for name in ("one", "other"):
        cmfsim.write_image(image, tmp_path / f"{name}.nrrd")
    session = Session(tmp_path)
    session.begin()
    wait_for(lambda: not session.busy)
    for server in running(session):
        page = asked(server.url)[1].decode()
        assert "which one is before the operation?" in page
        (question,) = open_questions(session.text())
        answer = {"line": question["line"], "toml": question["choices"][1]["toml"]}
        state = json.loads(asked(f"{server.url}state")[1])
        assert not state["error"]
        assert posted(server, "cuts", {"cuts": {}})[0] == 422
        assert posted(server, "answer", {**answer, "seen": "x"})[0] == 409
        status, state = posted(server, "answer", {**answer, "seen": state["seen"]})
        assert (status, state["work"]["name"]) == (200, "Opening the head")
        assert cmfsim.Case.load(tmp_path).image.file.name == "other.nrrd"
        session.cancel()
        wait_for(lambda: not session.busy)
    session.end()


@pytest.mark.skipif(os.name != "posix", reason="signals are POSIX")
def test_ctrl_c_ends_the_desk_and_its_work_without_a_traceback(folder):
    line = [sys.executable, "-m", "cmfsim", "desk", str(folder), "--json"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(line, text=True, **pipes) as process:
        url = json.loads(process.stdout.readline())["url"]
        assert json.loads(asked(f"{url}state")[1])["work"]["name"] == "Opening the head"
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=60)
    assert (process.returncode, said) == (0, "")


def test_a_folder_that_is_none_is_bad_input(tmp_path, capsys):
    assert main(["desk", str(tmp_path / "gone")]) == 2
    (tmp_path / "scan.nrrd").touch()
    assert main(["desk", str(tmp_path / "scan.nrrd")]) == 2
    assert "name a folder" in capsys.readouterr().err


def test_the_work_of_the_desk_is_named_as_the_session_asks_for_it():
    for name in ("set_up", "open_head", "compute", "solve", "check_plan", "report"):
        assert callable(getattr(work, name))
