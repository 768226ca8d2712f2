"""The served planning page: plans are solved exactly, and requests of others are refused."""

import http.client
import json
import os
import signal
import subprocess
import sys
import threading
import time
from urllib.parse import urlsplit

import numpy as np
import pytest
from planning_steps import motions_of, settle, type_number

import cmfsim
from browser_page import READY, until
from cmfsim.planning import server as planning_servers
from cmfsim.planning.server import open_port, planning_server
from local_requests import asked, origin_of, wait_for
from planning_head import other_plan

pytest.importorskip("skimage")
pytest.importorskip("meshio")


@pytest.fixture(scope="module")
def server(planning, content):
    pytest.importorskip("starlette")
    pytest.importorskip("uvicorn")
    running = planning_server(planning, content)
    thread = threading.Thread(target=running.run)
    thread.start()
    yield running
    running.stop()
    thread.join(timeout=20)
    assert not thread.is_alive()


def plan_body(planning, plan):
    rows = [np.asarray(plan[name]).ravel().tolist() for name in planning.segments]
    return json.dumps({"motions": rows})


def test_a_served_plan_is_solved_exactly(server, planning):
    status, page, headers = asked(server.url)
    assert status == 200
    assert b"connect-src &#x27;self&#x27;" in page or b"connect-src 'self'" in page
    assert headers["X-Frame-Options"] == "DENY"
    assert headers["Cache-Control"] == "no-store"
    plan = other_plan(planning)
    status, body, headers = asked(
        f"{server.url}solve",
        plan_body(planning, plan),
        Origin=origin_of(server.url),
        Content_Type="application/json",
    )
    assert status == 200
    shift = np.frombuffer(body, "<f4").reshape(-1, 3)
    exact = planning.solve(plan).skin_displacements
    np.testing.assert_allclose(shift, exact, atol=1e-4)
    assert json.loads(headers["X-Solution"])["contact_converged"]


def test_requests_that_are_not_the_pages_own_are_refused(server, planning):
    good = plan_body(planning, planning.reference)
    url, origin = server.url, origin_of(server.url)
    host = urlsplit(url).netloc
    sent = {"Origin": origin, "Content_Type": "application/json"}
    port = host.rsplit(":", 1)[1]
    assert host == f"127.0.0.1:{port}"
    token = urlsplit(url).path.strip("/")
    assert len(token) >= 43
    for path in ("/", "/x/", f"/{token[:-1]}/", f"/{token}x/", "/%00/", f"/{token}/../x"):
        assert asked(f"{origin}{path}")[0] == 404, path
    for other in ("evil.example", f"localhost:{port}", f"evil.example:{port}", "127.0.0.1"):
        assert asked(url, Host=other)[0] == 403
    assert asked(url, Origin="http://evil.example")[0] == 403
    solve = f"{url}solve"
    wrong = token[:-1] + ("A" if token[-1] != "A" else "B")
    cases = {
        404: (f"{origin}/{wrong}/solve", good, sent),
        403: (solve, good, {**sent, "Origin": "http://evil.example"}),
        415: (solve, good, {**sent, "Content_Type": "text/plain"}),
        413: (solve, good + " " * 70_000, sent),
    }
    for status, (where, body, headers) in cases.items():
        assert asked(where, body, **headers)[0] == status
    assert asked(solve, good, Content_Type="application/json")[0] == 403
    assert asked(solve, good, **{**sent, "Origin": "null"})[0] == 403
    assert asked(solve, method="GET")[0] == 405
    # Checked before it is redirected, or answered as no method of this server.
    for where, method, answer in (
        (url.rstrip("/"), "GET", 405),
        (f"{url}solve/", "POST", 404),
        (url, "DELETE", 405),
    ):
        assert asked(where, method=method, Host="evil.example")[0] == 403
        status, _, headers = asked(where, method=method)
        assert status == answer
        assert headers["X-Frame-Options"] == "DENY"


def test_plans_that_are_none_get_an_error_and_no_solution(server, planning):
    sent = {"Origin": origin_of(server.url), "Content_Type": "application/json"}
    far = dict(planning.reference) | {"maxilla": cmfsim.rigid_motion((0, 0, 2000))}
    mirror = dict(planning.reference) | {"maxilla": np.diag([-1.0, 1, 1, 1])}
    for body, said in (
        ("[]", b"needed as JSON"),
        ("{" * 1000, b"needed as JSON"),
        ('{"motions": [[1, 2]]}', b"16 finite numbers"),
        (plan_body(planning, planning.reference).replace("1.0", "NaN", 1), b"16 finite"),
        (plan_body(planning, planning.reference).replace("1.0", "1e999", 1), b"16 finite"),
        (plan_body(planning, planning.reference).replace("1.0", '"1.0"', 1), b"lists of numbers"),
        (plan_body(planning, planning.reference).replace("1.0", "true", 1), b"lists of numbers"),
        (plan_body(planning, planning.reference).replace("1.0", "null", 1), b"lists of numbers"),
        ('{"motions": "1 0 0"}', b"lists of numbers"),
        (plan_body(planning, far), b"more than 1000 mm"),
        (plan_body(planning, mirror), b"maxilla"),
    ):
        status, text, _ = asked(f"{server.url}solve", body, **sent)
        assert status == 400
        assert said in text, text


@pytest.fixture
def held(server, planning, monkeypatch):
    """Solving waits for the test: the shifts that were begun, how to go on, and how to send one."""
    begun, go, connections = [], threading.Event(), []

    def solved(_, plan):
        begun.append(round(float(plan["maxilla"][1, 3]), 3))
        go.wait(20)
        return np.zeros((1, 3)), {}

    monkeypatch.setattr(planning_servers, "solved_plan", solved)

    def posted(shift):
        parts = urlsplit(server.url)
        connections.append(http.client.HTTPConnection(parts.hostname, parts.port, timeout=30))
        plan = dict(planning.reference) | {"maxilla": cmfsim.rigid_motion((0, shift, 0))}
        headers = {"Origin": origin_of(server.url), "Content-Type": "application/json"}
        body = plan_body(planning, plan)
        connections[-1].request("POST", f"{parts.path}solve", body, headers)
        return connections[-1]

    yield begun, go, posted
    go.set()
    for connection in connections:
        connection.close()


def test_of_plans_that_wait_the_newest_is_solved_and_the_others_refused(held):
    begun, go, posted = held
    first = posted(-1.0)
    wait_for(lambda: begun == [-1.0])
    older = posted(-2.0)
    # Refused at once where the next arrives, while the first is still solved.
    newer = posted(-3.0)
    assert older.getresponse().status == 409
    go.set()
    assert first.getresponse().status == 200
    assert newer.getresponse().status == 200
    assert begun == [-1.0, -3.0]


def test_nothing_is_solved_for_a_page_that_has_gone(held):
    begun, go, posted = held
    first = posted(-1.0)
    wait_for(lambda: begun == [-1.0])
    posted(-2.0).close()
    time.sleep(0.3)
    go.set()
    assert first.getresponse().status == 200
    last = posted(-4.0)
    assert last.getresponse().status == 200
    assert begun == [-1.0, -4.0]


SLOW = """
import time
from cmfsim.planning import server

class Planning:
    def solve(self, plan):
        print("solving", flush=True)
        time.sleep(60.0)

server.page_text = lambda *_, **__: "page"
server.plan_of_body = lambda *_: {}
server.serve_planning(Planning(), None, on_start=lambda url: print(url, flush=True))
"""


@pytest.mark.skipif(os.name != "posix", reason="signals are POSIX")
def test_ctrl_c_ends_a_server_that_solves_without_a_traceback():
    pytest.importorskip("uvicorn")
    line = [sys.executable, "-c", SLOW]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(line, text=True, **pipes) as process:
        url = process.stdout.readline().strip()
        parts = urlsplit(url)
        connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=30)
        headers = {"Origin": origin_of(url), "Content-Type": "application/json"}
        connection.request("POST", f"{parts.path}solve", "{}", headers)
        assert process.stdout.readline() == "solving\n"
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=20)
        connection.close()
    assert (process.returncode, said) == (0, "")


def test_a_port_is_held_from_the_start_and_one_that_is_taken_is_named():
    pytest.importorskip("uvicorn")
    with open_port() as taken:
        port = taken.getsockname()[1]
        with pytest.raises(OSError, match=f"port {port} cannot be used .*--port"):
            open_port(port)


def test_the_served_page_swaps_in_the_exact_face(browser, server, planning):
    context = browser.new_context(viewport={"width": 920, "height": 420})
    page = context.new_page()
    troubles = []
    page.on("pageerror", lambda error: troubles.append(str(error)))
    page.goto(server.url)
    until(page, READY)
    type_number(page, "forwards", -5.5)
    until(page, "document.getElementById('error-state').textContent.startsWith('Solved exactly')")
    settle(page)
    exact = planning.solve(motions_of(page, planning))
    before = np.array(page.evaluate("[...cmfsimPage.face.before]")).reshape(-1, 3)
    after = np.array(page.evaluate("[...cmfsimPage.after]")).reshape(-1, 3)
    np.testing.assert_allclose(after - before, exact.carried(before), atol=0.01)
    # Another plan is the operator's again until it is solved.
    page.get_by_role("button", name="Undo").click()
    until(page, "document.getElementById('error-state').textContent.includes('case\\'s plan')")
    assert not troubles
    context.close()
