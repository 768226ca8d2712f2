"""What the planning page measures and mirrors, and that everybody can use it."""

import numpy as np
import pytest
from planning_steps import settle

from browser_page import serious_faults, until
from cmfsim.values.motion import carried, rigid_motion

pytest.importorskip("skimage")
pytest.importorskip("meshio")
image = pytest.importorskip("PIL.Image")
draw = pytest.importorskip("PIL.ImageDraw")


def test_the_mirror_image_is_at_the_plane_between_the_corners_of_the_eyes(opened, planning):
    skin = planning.patient.landmarks["skin"]
    left, right = (
        np.array([skin[f"{name}_{side}"] for name in ("exocanthion", "endocanthion")])
        for side in "LR"
    )
    normal = (left - right).sum(axis=0)
    normal /= np.linalg.norm(normal)
    middle = (left + right).mean(axis=0) / 2.0
    plane = opened.evaluate("cmfsimPage.mirror.plane")
    np.testing.assert_allclose(plane["normal"], normal, atol=1e-6)
    assert abs((np.array(plane["point"]) - middle) @ normal) < 1e-4
    opened.get_by_label("Mirror image").check()
    settle(opened)
    (part,) = opened.evaluate("cmfsimPage.mirror.parts(null)")
    matrix = np.array(part["motion"]).reshape(4, 4)
    mirrored = left @ matrix[:3, :3].T + matrix[:3, 3]
    np.testing.assert_allclose(
        mirrored, left - 2.0 * ((left - middle) @ normal)[:, None] * normal, atol=1e-4
    )
    motions = opened.evaluate("cmfsimPage.face.sitePlaces(cmfsimPage.motions)")
    off = (np.array(motions["subnasale"]) - middle) @ normal
    side = "" if abs(off) < 0.05 else " left" if off > 0.0 else " right"
    assert f"subnasale {abs(off):.1f} mm{side}" in opened.locator(".controls").inner_text()
    opened.get_by_label("Mirror image").uncheck()


def test_a_measured_point_of_bone_moves_with_its_segment(opened):
    opened.locator("#show-skin").fill("0")
    opened.get_by_role("checkbox", name="Measure").check()
    opened.get_by_label("Handles").uncheck()
    opened.get_by_role("button", name="Front", exact=True).click()
    settle(opened)
    places = opened.evaluate(
        """() => {
          const { camera, overlay, bones, ruler } = cmfsimPage;
          const at = (p) => camera.project(p, overlay.clientWidth, overlay.clientHeight);
          const bone = cmfsimPage.surfaces().findIndex((_, i) => i && bones[i - 1].segment === 0);
          const { places } = cmfsimPage.surfaces()[bone];
          // The foremost vertex of the segment, and a point beside it.
          let front = 0;
          for (let i = 3; i < places.length; i += 3) {
            if (places[i + 1] < places[front + 1]) front = i;
          }
          ruler.clicked(at(places.slice(front, front + 3)));
          ruler.clicked(at([places[front] + 2, places[front + 1], places[front + 2]]));
          return [ruler.places(), ruler.points.map((p) => p.number), bone];
        }"""
    )
    before, numbers, bone = np.array(places[0]), places[1], places[2]
    assert numbers[0] == bone
    was = opened.evaluate("cmfsimPage.motions[0]")
    motion = np.array(was).reshape(4, 4)
    motion[:3, 3] += (1.0, -4.0, 2.0)
    opened.evaluate("m => cmfsimPage.preview({segment: 0, motion: m})", motion.ravel().tolist())
    settle(opened)
    after = np.array(opened.evaluate("cmfsimPage.ruler.places()"))
    np.testing.assert_allclose(after[0] - before[0], (1.0, -4.0, 2.0), atol=1e-4)
    opened.get_by_role("checkbox", name="Measure").uncheck()
    opened.get_by_label("Handles").check()
    opened.locator("#show-skin").fill("1")


PHOTO = {"width": 900, "height": 1200}


def drawn_photo(opened, path, side, turn=0.1):
    """A photo of the profile, and where it shows each landmark: the face looks to a side (±1)."""
    sites = opened.evaluate(
        "() => { const places = cmfsimPage.face.sitePlaces(null);"
        " return cmfsimPage.photo.sites.map((name) => [name, places[name]]); }"
    )
    rows = np.array([place for _, place in sites])
    flat = np.stack([-side * rows[:, 1], -rows[:, 2]], axis=1)
    spin = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    pixels = 5.0 * (flat - flat.mean(axis=0)) @ spin.T + [450.0, 600.0]
    picture = image.new("RGB", (PHOTO["width"], PHOTO["height"]), "#b9c7b0")
    pen = draw.Draw(picture)
    for x, y in pixels:
        pen.ellipse([x - 9, y - 9, x + 9, y + 9], fill="#7a4a20")
    picture.save(path)
    return {name: pixel for (name, _), pixel in zip(sites, pixels, strict=True)}


@pytest.mark.parametrize("side", [1, -1])
def test_a_photo_of_either_profile_lies_under_the_lines_of_the_plan(opened, tmp_path, side):
    path = tmp_path / "photo.jpg"
    pixels = drawn_photo(opened, path, side)
    opened.locator("#photo-file").set_input_files(path)
    # The photo of the other side may still be there.
    until(opened, "!cmfsimPage.photo.canvas.hidden && cmfsimPage.photo.points.length === 0")
    canvas = opened.locator("canvas.photo")
    box = canvas.bounding_box()
    scale = box["width"] / PHOTO["width"]
    for name in (names := [*pixels])[:3]:
        assert f"Click on {name.replace('_', ' ')} " in opened.locator("#photo-note").inner_text()
        assert not opened.evaluate("Boolean(cmfsimPage.photo.fit.place)")
        canvas.click(position={"x": scale * pixels[name][0], "y": scale * pixels[name][1]})
    opened.locator("#photo-skip").click()
    for name in names[4:]:
        canvas.click(position={"x": scale * pixels[name][0], "y": scale * pixels[name][1]})
    # Whole pixels of the screen are clicked on.
    note = opened.locator("#photo-note").inner_text()
    assert "Dashed: before" in note
    assert opened.evaluate("cmfsimPage.photo.fit.error") < 1.0
    left_out = names[3]
    shown = opened.evaluate(
        "name => cmfsimPage.photo.fit.place(cmfsimPage.face.sitePlaces(null)[name].slice(1))",
        left_out,
    )
    assert np.linalg.norm(np.array(shown) - pixels[left_out]) < 6.0
    with opened.expect_download() as saved:
        opened.locator("#photo-save").click()
    with image.open(saved.value.path()) as written:
        assert written.size == (PHOTO["width"], PHOTO["height"])


def test_a_photo_whose_points_do_not_fit_gets_no_lines(opened, tmp_path):
    path = tmp_path / "photo.png"
    pixels = drawn_photo(opened, path, 1)
    opened.locator("#photo-file").set_input_files(path)
    until(opened, "cmfsimPage.photo.photo && cmfsimPage.photo.points.length === 0")
    wrong = [*pixels.values()][::-1]
    wrong[0], wrong[1] = wrong[1], wrong[0]
    opened.evaluate("rows => rows.forEach((row) => cmfsimPage.photo.take(row))",
                    [row.tolist() for row in wrong])  # fmt: skip
    assert "do not fit this face" in opened.locator("#photo-note").inner_text()
    opened.locator("#photo-save").click()
    assert not opened.evaluate("Boolean(cmfsimPage.photo.fit.place)")
    # A file that is no picture leaves the photo that is there.
    (tmp_path / "plan.png").write_text("no picture", encoding="utf-8")
    opened.locator("#photo-file").set_input_files(tmp_path / "plan.png")
    opened.get_by_text("is no JPEG or PNG").wait_for()


def test_the_page_has_no_serious_fault_of_accessibility(opened):
    assert serious_faults(opened) == []


def test_the_button_moves_the_lower_jaw_into_the_target_bite(opened, planning):
    names = list(planning.segments)
    numbers = [names.index(name) for name in ("maxilla", "mandible_body")]
    motion = rigid_motion((0.5, -2.0, 1.0), 2.0, (0.0, 0.0, 1.0))
    upper = rigid_motion((0.0, -4.0, 1.0), 3.0, (1.0, 0.0, 0.0))
    target = {
        "upper": numbers[0],
        "lower": numbers[1],
        "motion": motion.ravel().tolist(),
        "places": [[0.0, -90.0, -50.0], [30.0, -50.0, -50.0], [-30.0, -50.0, -50.0]],
    }
    assert not opened.locator("#target-bite").is_visible()
    assert "null" not in opened.inner_text("#panel")
    opened.evaluate(
        """([target, upper]) => {
          cmfsimPage.page.target_bite = target;
          const panel = new cmfsimPage.panel.constructor(cmfsimPage);
          cmfsimPage.panel.root.replaceWith(panel.root);
          cmfsimPage.panel = panel;
          cmfsimPage.preview({segment: target.upper, motion: upper});
          cmfsimPage.commit();
        }""",
        [target, upper.ravel().tolist()],
    )
    settle(opened)
    now = np.array(opened.evaluate("cmfsimPage.motions")).reshape(-1, 4, 4)[numbers[1]]
    places = np.array(target["places"])
    off = np.linalg.norm(carried(upper @ motion, places) - carried(now, places), axis=1).max()
    assert f"{off:.1f} mm off the target bite" in opened.locator("#target-bite").inner_text()
    opened.get_by_role("button", name="Move the lower jaw into the target bite").click()
    settle(opened)
    now = np.array(opened.evaluate("cmfsimPage.motions")).reshape(-1, 4, 4)[numbers[1]]
    np.testing.assert_allclose(now, upper @ motion, atol=1e-9)
    assert "are 0.0 mm off the target bite" in opened.locator("#target-bite").inner_text()
    opened.get_by_role("button", name="Undo").click()
    settle(opened)
    # A bite that no operation gives is refused, and the plan stays.
    opened.evaluate("cmfsimPage.page.target_bite.motion[3] = 300")
    opened.get_by_role("button", name="Move the lower jaw into the target bite").click()
    assert "at most 30 mm are allowed" in opened.locator("#message").inner_text()
    assert "0.0 mm off" not in opened.locator("#target-bite").inner_text()
