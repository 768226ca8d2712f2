"""From a CT to a saved plan and its report by clicks alone, in a browser."""

import os
import shutil
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

import cmfsim
import real_heads
from browser_page import axe_script, serious_faults, until
from cmfsim.desk.server import desk_server
from cmfsim.desk.session import Session
from cmfsim.io.results.predictions import read_prediction
from cmfsim.values.motion import plan_digits
from shared_values import without_pictures

pytest.importorskip("skimage")
pytest.importorskip("starlette")
pytest.importorskip("uvicorn")
pytest.importorskip("pyvista")

# What the desk may ask of a person, and of one processor, s.
MOST_CLICKS, MOST_SECONDS = 25, 180.0
OPEN = "globalThis.cmfsimDesk?.isOpen && cmfsimDesk.timing === 1"
PLANNING = "globalThis.cmfsimPage?.desk?.seen"
FAILED = "document.getElementById('work-error')?.textContent"


class Person:
    """Who clicks, drags and types on a page, and counts it; and what each step computes."""

    def __init__(self, page, session):
        self.page, self.count = page, 0
        self.session, self.seconds = session, {}

    def computed(self, step):
        """Keeps the processor time of the desk's worker since the step before, s."""
        stat = Path(f"/proc/{self.session._worker.pid}/stat")
        if stat.exists():
            # After the name in brackets: user and system time are fields 14 and 15 (proc(5)).
            times = stat.read_text(encoding="utf-8").rpartition(")")[2].split()[11:13]
            used = sum(map(int, times)) / os.sysconf("SC_CLK_TCK")
            self.seconds[step] = used - sum(self.seconds.values())

    def click(self, selector):
        """One click."""
        self.page.click(selector)
        self.count += 1

    def type(self, selector, text):
        """A number in a field."""
        # A click into the field, and the key that leaves it.
        self.page.fill(selector, text)
        self.page.keyboard.press("Tab")
        self.count += 1

    def drag(self, start, way):
        """From a place of the picture, by pixels."""
        mouse = self.page.mouse
        mouse.move(*start)
        mouse.down()
        mouse.move(*np.add(start, way), steps=5)
        mouse.up()
        self.count += 1

    def can_be_used_by_all(self, page=None):
        """axe-core, where it is installed, finds no serious fault of accessibility."""
        assert not axe_script().is_file() or serious_faults(page or self.page) == []

    def waits(self, expression, seconds):
        """Until an expression is true, or the page reports an error."""
        end = time.monotonic() + seconds
        while True:
            try:
                if self.page.evaluate(expression):
                    return
                failed = self.page.evaluate(FAILED)
            except Exception as error:  # noqa: BLE001 (another page is being opened just now)
                failed = None if "navigat" in str(error) else error
            assert not failed, failed
            assert time.monotonic() < end, expression
            time.sleep(0.2)


def serve(folder, browser):
    """Yields a person at the desk of a folder; in the end no page must have had an error."""
    session = Session(folder)
    server = desk_server(session)
    session.begin()
    thread = threading.Thread(target=server.run)
    thread.start()
    context = browser.new_context(viewport={"width": 920, "height": 420})
    page = context.new_page()
    page.set_default_timeout(60_000)
    page.emulate_media(reduced_motion="reduce")
    troubles, asked = [], []
    page.on("pageerror", lambda error: troubles.append(str(error)))
    page.on("console", lambda line: troubles.append(line.text) if line.type == "error" else None)
    page.on("request", lambda request: asked.append(request.url))
    page.goto(server.url)
    try:
        yield Person(page, session)
    finally:
        context.close()
        server.stop()
        thread.join(timeout=30)
        session.end()
    assert not troubles
    assert all(url.startswith((server.url, "blob:")) for url in asked)


def plan_by_clicks(person, seconds):
    """The whole way; the digits of the plan that was saved."""
    page = person.page
    person.waits(OPEN, seconds)
    person.computed("head")
    person.can_be_used_by_all()
    person.click("#to-landmarks")
    person.waits("globalThis.cmfsimPage?.timing.compute > 0", 60)
    person.can_be_used_by_all()
    person.click("#accept")
    person.click("#save-in-case")
    person.waits(OPEN, 60)
    assert "1 placed or accepted" in page.inner_text("#site-note") or "doubtful" in page.inner_text(
        "#site-note"
    )
    person.click("#cut-le_fort_1")
    person.click("#cut-bsso")
    until(page, "cmfsimDesk.planes.handles.length >= 4")
    raise_plane(person)
    person.type("#move-maxilla-forwards", "4")
    person.type("#move-mandible_body-forwards", "-2,5")
    person.can_be_used_by_all()
    person.click("#compute")
    person.waits(PLANNING, seconds)
    person.computed("plan operator")
    person.can_be_used_by_all()
    person.click("button[role=tab]:has-text('maxilla')")
    person.type("#number-up", "1")
    until(page, "!document.getElementById('save-in-case').disabled")
    solved = "document.getElementById('error-state').textContent.startsWith('Solved exactly')"
    person.waits(solved, seconds)
    person.computed("exact plan")
    person.click("#save-in-case")
    until(page, "!document.getElementById('predict').disabled")
    person.click("#predict")
    person.waits("document.querySelectorAll('#reports a').length === 2", seconds)
    person.computed("report")
    person.can_be_used_by_all()
    with page.expect_popup() as opened:
        person.click("#reports a >> nth=0")
    opened.value.wait_for_load_state()
    assert "predicted face" in opened.value.title()
    person.can_be_used_by_all(opened.value)
    return page.evaluate("cmfsimPage.desk.state.digits")


def raise_plane(person):
    """Drags the plane of the Le Fort I cut upwards."""
    page = person.page
    height = "cmfsimDesk.cutting.value('le_fort_1', 'height')"
    before = page.evaluate(height)
    at = page.evaluate(
        "() => { const p = cmfsimDesk.planes; const box = p.app.overlay.getBoundingClientRect();"
        " const h = p.handles.find((h) => h.option === 'height');"
        " const [x, y] = p.app.camera.project(h.point, ...p.size);"
        " return [x + box.left, y + box.top]; }"
    )
    person.drag(at, (0, -15))
    assert page.evaluate(height) > before + 1.0


def check_saved(folder, digits):
    """The case file has the plan of the page, and so has the prediction that was written."""
    case = cmfsim.Case.load(folder)
    plan = {name: motion.matrix for name, motion in case.plan.items()}
    assert plan_digits(plan) == digits
    np.testing.assert_allclose(plan["maxilla"][:3, 3], [0, -4, 1], atol=1e-9)
    np.testing.assert_allclose(plan["mandible_body"][:3, 3], [0, 2.5, 0], atol=1e-9)
    assert case.osteotomies[0].options["height"] > 6.0
    assert read_prediction(folder / "out")["plan_digits"] == digits
    assert (folder / "out/report.pdf").read_bytes().startswith(b"%PDF")


@pytest.fixture
def folder(tmp_path):
    head = cmfsim.make_head()
    cmfsim.write_image(head.ct(3.0), tmp_path / "ct.nrrd")
    cmfsim.init_case(tmp_path)
    case = tmp_path / "case.toml"
    # Coarser than what init would do.
    text = case.read_text(encoding="utf-8").replace("[image]", "[image]\nworking_spacing = 3.0")
    case.write_text(f"{text}\n[mesh]  # coarse\nedge_length = 14.0\n", encoding="utf-8")
    return tmp_path


def test_a_ct_becomes_a_saved_plan_and_a_printed_page_by_clicks(
    browser, folder, tmp_path_factory, monkeypatch
):
    """Its report is without pictures; test_demo.py counts those of a report."""
    without_pictures(monkeypatch, tmp_path_factory.mktemp("absent"))
    for person in serve(folder, browser):
        digits = plan_by_clicks(person, 240)
        page = person.page
        for name, start in (("report.html", b"<!DOCTYPE html>"), ("report.pdf", b"%PDF")):
            answer = page.request.get(page.url.replace("plan", name))
            assert answer.status == 200
            assert answer.body()[:15].startswith(start)
            assert ("content-security-policy" in answer.headers) == (name == "report.html")
        face = [
            np.array(page.evaluate(f"[...cmfsimPage.{values}]"), dtype=kind).reshape(-1, 3)
            for values, kind in (("after", np.float64), ("face.triangles", np.uint32))
        ]
        assert person.count <= MOST_CLICKS
    check_saved(folder, digits)
    assert "# coarse" in (folder / "case.toml").read_text(encoding="utf-8")
    # The page draws neither the mouth from inside nor the cut through the neck.
    predicted = cmfsim.read_surface(folder / "out/prediction.stl").vertices
    away = np.linalg.norm(cmfsim.Surface(*face).closest(predicted)[0] - predicted, axis=1)
    assert np.percentile(away, 75) < 0.5


@pytest.mark.slow
def test_the_ct_phantom_becomes_a_plan_in_25_clicks_and_3_minutes(browser, tmp_path):
    shutil.copy(real_heads.data_folder() / "ct_phantom/ct.nii.gz", tmp_path)
    for person in serve(tmp_path, browser):
        digits = plan_by_clicks(person, 1200)
        total = sum(person.seconds.values())
        parts = ", ".join(f"{step} {spent:.1f} s" for step, spent in person.seconds.items())
        sys.stdout.write(f"\n{person.count} clicks; {total:.1f} s of processor time: {parts}\n")
        assert person.count <= MOST_CLICKS
        assert total <= MOST_SECONDS
    check_saved(tmp_path, digits)
