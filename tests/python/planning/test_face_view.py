"""The view of a report shows the face where Python has it, and its page allows nothing else."""

import numpy as np
import pytest

import cmfsim
from benches.scenes import meshes
from browser_page import open_page, serious_faults, until
from cmfsim.planning.face_view import FACE_TRIANGLES, face_view
from cmfsim.report.document import Document, Section, View
from cmfsim.report.page import render_page

pytest.importorskip("jinja2")


@pytest.fixture(scope="module")
def parts():
    """A ball of skin whose front is drawn out, a bone in it that moves and one that stays."""
    skin = cmfsim.SurfaceData(*meshes.icosphere(4, 60.0))
    bone = cmfsim.SurfaceData(*meshes.icosphere(2, 20.0))
    pulled = np.clip(-skin.vertices[:, 1:2] / 60.0, 0.0, 1.0) * (0.0, -8.0, 1.0)
    moved = bone.vertices + (0.0, -5.0, 0.0)
    still = (bone, bone.vertices)
    return {
        "skin": {"skin": (skin, skin.vertices + pulled)},
        "bones": {"maxilla": (bone, moved), "skull": still},
    }


@pytest.fixture(scope="module")
def page(browser, parts, tmp_path_factory):
    path = tmp_path_factory.mktemp("view") / "report.html"
    view = View(*face_view(parts), "caption")
    path.write_text(
        render_page(Document("t", "s", sections=[Section("Face", (view,))])), encoding="utf-8"
    )
    yield from open_page(browser, path)


def _drawn(page):
    until(page, "!cmfsimPage.frame")
    return np.array(page.evaluate("[...cmfsimPage.parts.at(-1).places]")).reshape(-1, 3)


def test_the_slider_moves_the_face_from_before_to_after(page, parts):
    skin, after = parts["skin"]["skin"]
    for share in (1.0, 0.0, 0.5):
        page.locator("#show-share").fill(str(share))
        wanted = skin.vertices + share * (after - skin.vertices)
        np.testing.assert_allclose(_drawn(page), wanted, atol=0.01)
    assert "50 %" in page.locator("#caption-left").inner_text()
    page.locator("#show-share").fill("1")


def test_views_and_colours_change_the_picture(page):
    pictures = set()
    for name in ("Front", "Left profile", "Right profile"):
        page.get_by_role("button", name=name, exact=True).click()
        _drawn(page)
        pictures.add(page.evaluate("document.getElementById('drawing').toDataURL()"))
    page.get_by_label("Colour by movement").check()
    _drawn(page)
    assert "8.5" in page.locator("#legend").inner_text()
    pictures.add(page.evaluate("document.getElementById('drawing').toDataURL()"))
    assert len(pictures) == 4


def test_a_bone_that_stays_has_the_colour_of_bone(page):
    assert page.evaluate("cmfsimPage.parts.map(p => p.colour[0])")[1] == pytest.approx(0.9)


def test_the_skin_has_the_colours_of_a_photo(browser, parts, tmp_path):
    colours = np.full((len(parts["skin"]["skin"][0].vertices), 3), (20, 220, 60), np.uint8)
    path = tmp_path / "report.html"
    view = View(*face_view(parts, colours), "caption")
    path.write_text(
        render_page(Document("t", "s", sections=[Section("Face", (view,))])), encoding="utf-8"
    )
    for page in open_page(browser, path):
        _drawn(page)
        red, green, blue, _ = page.evaluate(
            """() => {
              const { gl, width, height } = cmfsimPage.drawing;
              const pixel = new Uint8Array(4);
              gl.readPixels(width / 2, height / 2, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
              return [...pixel];
            }"""
        )
        assert green > 2 * max(red, blue)


def test_a_distance_is_measured_between_two_clicks(page):
    page.locator("#show-share").fill("0")
    page.get_by_label("Colour by movement").uncheck()
    page.get_by_role("button", name="Front", exact=True).click()
    page.get_by_role("button", name="Whole face").click()
    page.get_by_label("Measure").check()
    _drawn(page)
    overlay = page.locator("#overlay")
    size, span = overlay.bounding_box(), page.evaluate("cmfsimPage.camera.span")
    x, _, z = page.evaluate("cmfsimPage.camera.target")
    scale = size["height"] / span
    for left, up in ((-20.0, 0.0), (20.0, 30.0)):
        across, down = size["width"] / 2 + scale * (left - x), size["height"] / 2 - scale * (up - z)
        overlay.click(position={"x": across, "y": down})
    _drawn(page)
    # On the front of a ball of 60 mm; clicks are whole pixels.
    found = np.array(page.evaluate("cmfsimPage.ruler.places()"))
    wanted = [(-20.0, -np.sqrt(60.0**2 - 400.0), 0.0), (20.0, -np.sqrt(60.0**2 - 1300.0), 30.0)]
    np.testing.assert_allclose(found, wanted, atol=1.5 / scale)
    stated = float(page.locator(".controls .note").inner_text().split(" mm")[0])
    assert stated == pytest.approx(np.linalg.norm(found[0] - found[1]), abs=0.051)
    page.get_by_label("Measure").uncheck()
    page.locator("#show-share").fill("1")


def test_the_report_has_no_serious_fault_of_accessibility(page):
    assert serious_faults(page) == []


def test_the_wheel_scrolls_the_report_until_the_picture_is_clicked_on(page):
    page.locator("#overlay").scroll_into_view_if_needed()
    page.locator("h2").click()
    span = page.evaluate("cmfsimPage.camera.span")
    page.locator("#overlay").hover()
    page.mouse.wheel(0, 100)
    page.wait_for_timeout(100)
    assert page.evaluate("cmfsimPage.camera.span") == span
    page.locator("#overlay").click()
    page.mouse.wheel(0, 100)
    until(page, f"cmfsimPage.camera.span > {span}")


def test_a_face_of_a_scan_takes_a_megabyte_at_most():
    face = cmfsim.SurfaceData(*meshes.icosphere(6, 60.0))
    assert len(face.triangles) > FACE_TRIANGLES
    bones = dict.fromkeys(("maxilla", "mandible"), (face, face.vertices + 3.0))
    markup, script = face_view({"skin": {"skin": (face, 1.1 * face.vertices)}, "bones": bones})
    assert len(markup) < 1.1e6
    assert script in render_page(
        Document("t", "s", sections=[Section("", (View(markup, script, ""),))])
    )
