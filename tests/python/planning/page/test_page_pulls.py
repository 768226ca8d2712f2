"""Points of the skin are pulled on the planning page, by numbers and with the mouse."""

import numpy as np
import pytest
from planning_steps import motions_of, settle

import cmfsim
from browser_page import until

pytest.importorskip("skimage")
pytest.importorskip("meshio")


def test_a_point_of_the_skin_is_pulled_by_numbers_as_python_plans_it(opened, planning):
    site = cmfsim.face_sites(planning.patient).skin["pogonion"]
    opened.get_by_role("button", name="New without movement").click()
    opened.locator("#pull-point").select_option(label="pogonion")
    for key, value in {"forwards": -3, "up": 1.5, "left": 1}.items():
        opened.locator(f"#wish-{key}").fill(str(value))
    opened.locator("#pull-typed").focus()
    opened.keyboard.press("Enter")
    settle(opened)
    plan = motions_of(opened, planning)
    goal = site + [1.0, 3.0, 1.5]
    followers = ("mandible_body", "maxilla")
    wish = [cmfsim.PointTarget(site[None], goal[None], std=0.5)]
    search = cmfsim.FaceSearch(followers, shift=30.0, turn=30.0)
    found = cmfsim.plan_for_face(planning, wish, search, exact=False)
    assert found.converged
    skull = planning.patient.landmarks["skull"]
    for name in followers:
        stated = cmfsim.clinical_motion(name, plan[name], landmarks=skull)
        for number in ("forwards", "up", "left", "pitch", "yaw", "roll"):
            wanted = getattr(found.motions[name], number)
            assert getattr(stated, number) == pytest.approx(wanted, abs=0.02), (name, number)
    reached = site + planning.carried(plan, site[None])[0]
    np.testing.assert_allclose(reached, goal, atol=0.05)
    # Segments that were not chosen stay, and the pull is one step back.
    for name in ("ramus_left", "ramus_right"):
        np.testing.assert_array_equal(plan[name], np.eye(4))
    assert "−3.0 forwards, +1.5 up, +1.0 left" in opened.locator("#pull-state").inner_text()
    opened.get_by_role("button", name="Undo").click()
    assert all(np.array_equal(m, np.eye(4)) for m in motions_of(opened, planning).values())


def test_a_point_of_the_skin_is_dragged_and_bones_follow_live(opened, planning):
    opened.get_by_role("button", name="Right profile", exact=True).click()
    opened.locator("#show-pull").check()
    # The mandible alone: the maxilla is locked.
    maxilla = planning.segments.index("maxilla")
    opened.locator(f"#follows-{maxilla}").uncheck()
    settle(opened)
    before = motions_of(opened, planning)
    box = opened.locator("#overlay").bounding_box()
    # In profile, the foremost point at the height of the pogonion, 4 mm inside of the outline.
    x, y = opened.evaluate(
        """() => {
          const { face, camera, overlay, motions } = cmfsimPage;
          const [px, py, pz] = face.sitePlaces(motions).pogonion;
          return camera.project([px, py + 4, pz], overlay.clientWidth, overlay.clientHeight);
        }"""
    )
    opened.mouse.move(box["x"] + x, box["y"] + y)
    opened.mouse.down()
    picked = np.array(opened.evaluate("cmfsimPage.pulling.pull.from"))
    scale = opened.evaluate("cmfsimPage.camera.span / cmfsimPage.overlay.clientHeight")
    opened.mouse.move(box["x"] + x + 9, box["y"] + y, steps=3)
    until(opened, "cmfsimPage.pending !== null")
    opened.mouse.move(box["x"] + x + 18, box["y"] + y - 6, steps=3)
    opened.mouse.up()
    settle(opened)
    plan = motions_of(opened, planning)
    # Seen from the patient's right, forwards (−P) is to the right of the picture.
    goal = picked + scale * np.array([0.0, -18.0, 6.0])
    vertex = opened.evaluate("cmfsimPage.pulling.vertex")
    start = np.array(opened.evaluate("v => [...cmfsimPage.face.before.slice(3*v, 3*v+3)]", vertex))
    reached = start + planning.carried(plan, start[None])[0]
    assert np.linalg.norm(goal - picked) > 3.0
    assert np.linalg.norm(reached - goal) < 0.1
    np.testing.assert_array_equal(plan["maxilla"], before["maxilla"])
    assert not np.allclose(plan["mandible_body"], before["mandible_body"])
    # One drag is one step, and each of its steps takes less than a frame.
    assert opened.evaluate("cmfsimPage.plans.past.length") == 1
    times = opened.evaluate(
        """() => Array.from({ length: 20 }, (_, i) => {
          const { pulling } = cmfsimPage;
          const pull = pulling.begin();
          const begun = performance.now();
          pull.towards(pull.from.map((v, k) => v + (k === 1 ? -0.5 : 0.1 * i)));
          return performance.now() - begun;
        })"""
    )
    assert min(times) < 16.0, sorted(times)
    opened.get_by_role("button", name="Undo").click()
    for name, motion in motions_of(opened, planning).items():
        np.testing.assert_array_equal(motion, before[name])
    # Where there is no skin, the picture turns as ever.
    azimuth = opened.evaluate("cmfsimPage.camera.azimuth")
    opened.mouse.move(box["x"] + 8, box["y"] + 60)
    opened.mouse.down()
    opened.mouse.move(box["x"] + 40, box["y"] + 60)
    opened.mouse.up()
    assert opened.evaluate("cmfsimPage.camera.azimuth") != azimuth
    opened.locator("#show-pull").uncheck()
    opened.locator(f"#follows-{maxilla}").check()


def test_pulls_that_nothing_follows_are_refused(opened, planning):
    opened.locator("#pull-point").select_option(label="pogonion")
    opened.locator("#wish-up").fill("2")
    for number in range(len(planning.segments)):
        opened.locator(f"#follows-{number}").set_checked(False)
    opened.locator("#pull-typed").click()
    assert "No segment follows" in opened.locator("#message").inner_text()
    opened.locator("#wish-up").fill("")
    opened.locator("#follows-0").check()
    opened.locator("#pull-typed").click()
    assert "the plan was not changed" in opened.locator("#message").inner_text()
    assert opened.evaluate("cmfsimPage.plans.past.length") == 0
    for number, name in enumerate(planning.segments):
        moves = not np.array_equal(planning.reference[name], np.eye(4))
        opened.locator(f"#follows-{number}").set_checked(moves)
