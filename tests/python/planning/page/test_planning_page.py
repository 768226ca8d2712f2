"""The planning page in a browser agrees with Python."""

import dataclasses
import json
import re
import shlex

import numpy as np
import pytest
from planning_steps import motions_of, saved, settle, type_number

import cmfsim
import cmfsim.planning.page.content
from browser_page import open_page, until
from cmfsim.planning.replanning.expected_error import plan_distance
from cmfsim.values.motion import plan_digits
from planning_head import other_plan

pytest.importorskip("skimage")
pytest.importorskip("meshio")

HOSTILE = "</script><img src=x onerror=alert(1)>'\"&\u2028"


def test_a_typed_plan_moves_the_vertices_as_python_does(opened, planning, content):
    skull = planning.patient.landmarks["skull"]
    numbers = {"forwards": 7.3, "up": -2, "left": 1.5, "pitch": 4, "yaw": -3, "roll": 2.5}
    opened.get_by_role("tab", name="maxilla").click()
    for key, value in numbers.items():
        type_number(opened, key, value)
    settle(opened)
    plan = motions_of(opened, planning)
    wanted = cmfsim.planned_motion(skull["supradentale"], shift=(7.3, -2, 1.5), turn=(4, -3, 2.5))
    np.testing.assert_allclose(plan["maxilla"], wanted, atol=1e-9)
    stated = cmfsim.clinical_motion("maxilla", plan["maxilla"], landmarks=skull)
    for key, value in numbers.items():
        assert getattr(stated, key) == pytest.approx(value, abs=1e-9)
    after = np.array(opened.evaluate("[...cmfsimPage.after]")).reshape(-1, 3)
    before = np.asarray(content.arrays["face"], dtype=np.float64)
    moved = planning.carried(plan, before)
    assert np.abs(moved).max() > 5.0
    np.testing.assert_allclose(after - before, moved, atol=0.01)


def test_the_measures_are_those_of_python(opened, planning):
    sites = cmfsim.face_sites(planning.patient)
    names = list(sites.skin)
    places = np.array([sites.skin[name] for name in names])
    for motions in (planning.reference, other_plan(planning)):
        rows = [np.asarray(motions[name]).ravel().tolist() for name in planning.segments]
        found = opened.evaluate("m => cmfsimPage.face.measures(m)", rows)
        moved = dict(zip(names, places + planning.carried(motions, places), strict=True))
        for name, site in sites.bone.items():
            matrix = motions[site.segment]
            moved[name] = matrix[:3, :3] @ site.place + matrix[:3, 3]
        wanted = cmfsim.measure_sites(moved)
        assert sum(value is not None for value in found) >= 12
        assert len(found) == len(cmfsim.MEASURES) + len(cmfsim.OCCLUSAL_MEASURES)
        for measure, value in zip(cmfsim.MEASURES, found, strict=False):
            if wanted[measure.key] is None:
                assert value is None
            else:
                limit = 0.05 if measure.unit == "°" else 0.01
                assert value == pytest.approx(wanted[measure.key], abs=limit), measure.key


def test_every_view_draws_something_else(opened):
    pictures = {}
    for name in ("Front", "Right profile", "Left profile", "Three-quarter", "From below"):
        opened.get_by_role("button", name=name, exact=True).click()
        settle(opened)
        # Of all pixels, those that are not the ground.
        pictures[name] = opened.evaluate(
            """() => {
              const { gl, width, height } = cmfsimPage.drawing;
              cmfsimPage.draw();
              const pixels = new Uint8Array(4 * width * height);
              gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
              let drawn = 0;
              for (let i = 0; i < pixels.length; i += 4) if (pixels[i + 2] < 200) drawn++;
              return drawn / (width * height);
            }"""
        )
    assert all(0.05 < share < 0.9 for share in pictures.values()), pictures
    assert len({round(share, 4) for share in pictures.values()}) >= 4


def test_undo_and_redo_give_the_very_plans_back(opened, planning):
    first = motions_of(opened, planning)
    type_number(opened, "forwards", -6)
    second = motions_of(opened, planning)
    type_number(opened, "yaw", 3)
    third = motions_of(opened, planning)
    assert not np.array_equal(second["mandible_body"], third["mandible_body"])
    opened.get_by_role("button", name="Undo").click()
    assert all(np.array_equal(second[n], m) for n, m in motions_of(opened, planning).items())
    opened.keyboard.press("Control+z")
    assert all(np.array_equal(first[n], m) for n, m in motions_of(opened, planning).items())
    opened.keyboard.press("Control+y")
    opened.keyboard.press("Control+y")
    assert all(np.array_equal(third[n], m) for n, m in motions_of(opened, planning).items())
    settle(opened)
    assert opened.get_by_role("button", name="Redo").is_disabled()


def test_what_is_no_number_or_beyond_the_limits_is_refused(opened, planning):
    before = motions_of(opened, planning)
    field = opened.locator("#number-forwards")
    for typed, said in (
        ("", "Type a number"),
        ("2,5,", "Type a number"),
        ("31", "at most 30 mm"),
        ("-1e9", "at most 30 mm"),
    ):
        field.fill(typed)
        field.press("Enter")
        assert said in opened.locator("#message").inner_text()
        until(opened, "document.getElementById('number-forwards').value === '-3.50'")
    after = motions_of(opened, planning)
    assert all(np.array_equal(before[n], m) for n, m in after.items())


def test_a_decimal_comma_is_a_point(opened):
    """A browser drops it from a field of numbers: 2,5 was 25."""
    field = opened.locator("#number-forwards")
    field.click()
    field.fill("")
    opened.keyboard.type("2,5")
    opened.keyboard.press("Enter")
    until(opened, "document.getElementById('number-forwards').value === '2.50'")
    opened.keyboard.press("ArrowUp")
    until(opened, "document.getElementById('number-forwards').value === '2.60'")


def test_a_turn_leaves_the_chosen_centre_in_place(opened, planning):
    opened.locator("#turns-about").select_option(label="pogonion")
    place = planning.patient.landmarks["skull"]["pogonion"]
    before = motions_of(opened, planning)["mandible_body"]
    type_number(opened, "pitch", 6)
    after = motions_of(opened, planning)["mandible_body"]
    centre = [*place, 1.0]
    np.testing.assert_allclose(after @ centre, before @ centre, atol=1e-9)
    turn = cmfsim.decompose_motion(after)
    np.testing.assert_allclose(turn.angle * turn.axis, [-6, 0, 0], atol=1e-9)


def test_handles_pull_the_segment_by_what_the_picture_shows(opened, planning):
    opened.get_by_role("button", name="Right profile", exact=True).click()
    settle(opened)
    before = motions_of(opened, planning)["mandible_body"]
    shape = opened.evaluate("cmfsimPage.handles.shapes.find((s) => s.key === 'forwards')")
    box = opened.locator("#overlay").bounding_box()
    (x, y), step = shape["points"][1], shape["step"]
    opened.mouse.move(box["x"] + x, box["y"] + y)
    opened.mouse.down()
    # In the profile forwards is to the right.
    opened.mouse.move(box["x"] + x + 20, box["y"] + y, steps=4)
    opened.mouse.up()
    settle(opened)
    moved = motions_of(opened, planning)["mandible_body"] - before
    # Kept to a tenth of a millimetre.
    assert moved[1, 3] == pytest.approx(-20 * step, abs=0.051)
    assert np.abs(np.delete(moved.ravel(), 7)).max() < 1e-9
    opened.get_by_role("button", name="Undo").click()
    assert np.array_equal(motions_of(opened, planning)["mandible_body"], before)


def test_a_saved_plan_is_what_predict_reads(opened, planning, folder, tmp_path):
    type_number(opened, "forwards", -5.25)
    type_number(opened, "roll", 1.5)
    file = tmp_path / "plan.toml"
    saved(opened, "#save-plan").save_as(file)
    case = cmfsim.Case.load(folder / "case").with_plan(file)
    plan = motions_of(opened, planning)
    assert set(case.plan) == set(plan)
    for name, motion in case.plan.items():
        np.testing.assert_allclose(motion.matrix, plan[name], atol=1e-12)
    command = opened.locator("#command").inner_text()
    digits = plan_digits(plan)
    assert command == f"cmfsim predict case.toml --plan demo-A-{digits}.toml --model H+S"
    assert f'"A" ({digits}) of the case' in file.read_text("utf-8")
    # Loaded again, it is a variant of its own with the same motions.
    opened.locator("#plan-file").set_input_files(file)
    until(opened, "cmfsimPage.plans.now.variants.length === 2")
    again = motions_of(opened, planning)
    assert all(np.array_equal(plan[name], again[name]) for name in plan)
    assert "Loaded" in opened.locator("#message").inner_text()
    other = tmp_path / "other.toml"
    other.write_text(
        re.sub("# made for: .*", f"# made for: {'0' * 64}", file.read_text("utf-8")), "utf-8"
    )
    opened.locator("#plan-file").set_input_files(other)
    until(opened, "cmfsimPage.plans.now.variants.length === 3")
    assert "another case" in opened.locator("#message").inner_text()


def test_plans_that_are_none_are_refused_whole(opened, tmp_path):
    good = "[plan.maxilla]\nmatrix = [[1.0, 0, 0, 1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"
    rest = "".join(
        good.replace("maxilla", name) for name in ("mandible_body", "ramus_left", "ramus_right")
    )
    faults = {
        "moves skull": good.replace("maxilla", "skull") + good + rest,
        "does not mention ramus_right": good + rest.rsplit("[plan", 1)[0],
        "not a rotation": good.replace("[[1.0", "[[-1.0") + rest,
        "not 4 × 4": good.replace("[0, 1, 0, 0], ", "") + rest,
        "not numbers": good.replace("1.0", "NaN") + rest,
        "second time": good + good + rest,
        "ends inside": good + rest + "[plan.more]\n",
        "not a matrix": good.replace("matrix", "translation") + rest,
        "at most 30 mm": good.replace("0, 0, 1]", "0, 0, 31]", 1) + rest,
        "last row": good.replace("[0, 0, 0, 1]", "[0, 0, 0, 2]") + rest,
    }
    for number, (said, text) in enumerate(faults.items()):
        file = tmp_path / f"{number}.toml"
        file.write_text(text, encoding="utf-8")
        opened.locator("#plan-file").set_input_files(file)
        said_of = f"document.getElementById('message').textContent.startsWith('{file.name}')"
        until(opened, said_of)
        shown = opened.locator("#message").inner_text()
        assert said in shown, shown
        assert "No plan was loaded" in shown
    assert opened.evaluate("cmfsimPage.plans.now.variants.length") == 1


@pytest.mark.parametrize("direction", ["from-parent", "to-parent"])
def test_a_saved_transform_is_the_motion(opened, planning, tmp_path, direction):
    type_number(opened, "yaw", 4)
    opened.locator("#direction").select_option(direction)
    download = saved(opened, "#save-transform")
    digits = plan_digits(motions_of(opened, planning))
    assert download.suggested_filename == f"demo-A-{digits}-mandible_body.{direction}.tfm"
    file = tmp_path / download.suggested_filename
    download.save_as(file)
    motion = cmfsim.read_transform(file, direction=direction)
    wanted = motions_of(opened, planning)["mandible_body"]
    np.testing.assert_allclose(motion, wanted, atol=1e-9)
    other = {"from-parent": "to-parent", "to-parent": "from-parent"}[direction]
    with pytest.raises(cmfsim.CaseError):
        cmfsim.read_transform(file, direction=other)


def test_the_saved_face_is_that_of_the_page(opened, tmp_path):
    type_number(opened, "forwards", 2)
    settle(opened)
    file = tmp_path / "face.stl"
    saved(opened, "#save-face").save_as(file)
    surface = cmfsim.read_surface(file)
    after = np.array(opened.evaluate("[...cmfsimPage.after]")).reshape(-1, 3)
    corners = np.asarray(surface.vertices)[np.asarray(surface.triangles)]
    triangles = np.array(opened.evaluate("[...cmfsimPage.face.triangles]")).reshape(-1, 3)
    np.testing.assert_allclose(corners, after[triangles], atol=1e-4)
    assert saved(opened, "#save-picture").suggested_filename == "demo-A.png"


def test_the_error_is_stated_and_warned_of_beyond_what_was_tried(opened, errors, planning):
    state = opened.locator("#error-state")
    assert "solved exactly" in state.inner_text()
    type_number(opened, "forwards", -4.5)
    until(
        opened, "document.getElementById('error-state').textContent.startsWith('The face differs')"
    )
    plan = motions_of(opened, planning)
    distance = plan_distance(planning, plan)
    mean, largest = errors.at(distance)
    assert (
        f"{mean:.2f} mm on average, at most {errors.usual(distance):.2f} mm in nine of ten plans "
        f"as far away, {largest:.2f} mm in the worst"
    ) in state.inner_text()
    type_number(opened, "forwards", -28)
    until(opened, "document.querySelector('#error-state.warning')")
    assert "farther than any plan that was tested" in state.inner_text()


def test_teeth_that_pass_through_each_other_are_warned_of(opened, planning):
    rows = cmfsim.planning.page.row_overlap(planning.patient)
    state = opened.locator("#teeth-state")
    assert "do not overlap" in state.inner_text()
    type_number(opened, "up", 8)
    until(opened, "document.querySelector('#teeth-state.warning')")
    depth = float(re.search(r"by ([0-9.]+) mm", state.inner_text())[1])
    assert depth == pytest.approx(rows.passing(motions_of(opened, planning)), abs=0.06)


def test_variants_are_named_kept_and_compared(opened, planning):
    opened.get_by_role("button", name="Copy to a new variant").click()
    opened.locator("#variant-name").fill("Setback 6")
    opened.locator("#variant-name").press("Enter")
    type_number(opened, "forwards", -6)
    settle(opened)
    table = opened.locator("#differences").inner_text()
    assert "Setback 6" in table
    row = next(line for line in table.splitlines() if "mandible body: forwards" in line)
    assert row.split("\t")[1:] == ["−3.5", "−6.0", "2.5"]
    opened.get_by_role("button", name="A", exact=True).click()
    settle(opened)
    np.testing.assert_allclose(
        motions_of(opened, planning)["mandible_body"],
        planning.reference["mandible_body"],
        atol=1e-12,
    )


def test_the_keyboard_alone_plans_and_looks(opened, planning):
    opened.locator("#overlay").focus()
    opened.keyboard.press("2")
    settle(opened)
    assert opened.evaluate("cmfsimPage.camera.azimuth") == -90
    opened.keyboard.press("ArrowRight")
    assert opened.evaluate("cmfsimPage.camera.azimuth") == -85
    # From the tabs of the segments to the first number, by Tab alone.
    opened.get_by_role("tab", name="mandible body").focus()
    opened.keyboard.press("ArrowRight")
    assert opened.evaluate("document.activeElement.textContent") == "maxilla"
    for _ in range(3):
        opened.keyboard.press("Tab")
    assert opened.evaluate("document.activeElement.id") == "number-forwards"
    opened.keyboard.press("Control+a")
    opened.keyboard.type("4.2")
    opened.keyboard.press("Enter")
    skull = planning.patient.landmarks["skull"]
    motion = motions_of(opened, planning)["maxilla"]
    stated = cmfsim.clinical_motion("maxilla", motion, landmarks=skull)
    assert stated.forwards == pytest.approx(4.2, abs=1e-9)


def test_two_fingers_zoom(opened):
    """Touches as the browser's protocol sends them: apart zooms in, together out."""
    box = opened.locator("#overlay").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    touch = opened.context.new_cdp_session(opened)

    def send(kind, *places):
        points = [{"x": px, "y": py, "id": i} for i, (px, py) in enumerate(places)]
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    span, past = opened.evaluate("[cmfsimPage.camera.span, cmfsimPage.plans.past.length]")
    send("touchStart", (x - 20, y))
    send("touchStart", (x - 20, y), (x + 20, y))
    for reach in (25, 30, 35, 40):
        send("touchMove", (x - reach, y), (x + reach, y))
    send("touchEnd")
    settle(opened)
    assert opened.evaluate("cmfsimPage.camera.span") == pytest.approx(0.5 * span, rel=0.02)
    send("touchStart", (x - 40, y), (x + 40, y))
    for reach in (35, 30, 25, 20):
        send("touchMove", (x - reach, y), (x + reach, y))
    send("touchEnd")
    settle(opened)
    assert opened.evaluate("cmfsimPage.camera.span") == pytest.approx(span, rel=0.03)
    assert opened.evaluate("cmfsimPage.plans.past.length") == past
    opened.evaluate("cmfsimPage.camera.recentre()")


def test_hostile_names_stay_text(browser, content, tmp_path):
    values = json.loads(json.dumps(content.values))
    values["case"] = HOSTILE
    values["segments"][0]["label"] = HOSTILE
    values["segments"][0]["name"] = HOSTILE
    path = tmp_path / "hostile.html"
    cmfsim.write_planning_page(
        path, dataclasses.replace(content, values=values), case_file="a b'$(x).toml"
    )
    pages = open_page(browser, path)
    page = next(pages)
    page.on("dialog", lambda dialog: pytest.fail(dialog.message))
    assert page.locator("h1").inner_text().startswith("</script><img src=x")
    assert page.locator("img").count() == 0
    command = page.locator("#command").inner_text()
    assert shlex.split(command)[:3] == ["cmfsim", "predict", "a b'$(x).toml"]
    file = tmp_path / "hostile.toml"
    download = saved(page, "#save-plan")
    assert re.fullmatch(r"[A-Za-z0-9_-]+\.toml", download.suggested_filename)
    download.save_as(file)
    tomllib = pytest.importorskip("tomllib")
    assert HOSTILE.replace("\u2028", " ") in tomllib.loads(file.read_text("utf-8"))["plan"]
    assert next(pages, None) is None


def test_a_large_page_computes_a_face_within_a_frame(browser, content, tmp_path):
    """20,000 nodes and vertices, four segments: the issue's limit is a frame, 16 ms."""
    count = 20_000
    rows = np.arange(count) % len(content.arrays["active"])
    picked = np.arange(count) % len(content.arrays["face"])
    nodes = np.arange(count) % len(content.arrays["nodes"])
    arrays = dict(content.arrays)
    arrays["nodes"] = arrays["nodes"][nodes]
    arrays["active"] = np.arange(count, dtype=np.uint32)
    for name in ("columns", "reference_shift"):
        arrays[name] = arrays[name][rows]
    for name in ("face", *(f"face_{p}" for p in ("triangle", "barycentric", "offset", "share"))):
        arrays[name] = arrays[name][picked]
    arrays["face_triangles"] = np.tile(arrays["face_triangles"], (5, 1))[: 2 * count]
    assert len(arrays["face_triangles"]) == 2 * count
    shapes = -(-content.arrays["correction_weights"].shape[1] // 4) * 4
    assert shapes >= 4
    assert arrays["columns"].shape == (count, 3, 48 + shapes)
    path = tmp_path / "large.html"
    size = cmfsim.write_planning_page(path, dataclasses.replace(content, arrays=arrays))
    assert size < 12e6
    pages = open_page(browser, path)
    page = next(pages)
    times = page.evaluate(
        """() => Array.from({ length: 30 }, () => {
          cmfsimPage.compute(); cmfsimPage.place();
          return cmfsimPage.timing.compute + cmfsimPage.timing.normals;
        })"""
    )
    # The best of thirty: other programs run on the machine of a test.
    assert min(times) < 16.0, sorted(times)
    assert next(pages, None) is None
