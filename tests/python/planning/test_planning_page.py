"""The planning page in a browser agrees with Python, and planning models with exact solutions.

Everything that needs a head is in this file, so that one is built once.
"""

import base64
import dataclasses
import gzip
import hashlib
import http.client
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from urllib.parse import urlsplit

import numpy as np
import pytest

import cmfsim
import cmfsim.planning.page.content
from cmfsim.cli import main
from cmfsim.cli.patients.plan_command import _correction_text
from cmfsim.planning.page.document import joined_scripts
from cmfsim.planning.replanning import plan_distance
from cmfsim.planning.replanning.expected_error import plan_near
from cmfsim.planning.server import PlanningServer, open_port
from cmfsim.values.motion import plan_digits

pytest.importorskip("skimage")
pytest.importorskip("meshio")

from browser_page import READY, open_page, until
from planning_head import planning_patient

HOSTILE = "</script><img src=x onerror=alert(1)>'\"&\u2028"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("planning")


@pytest.fixture(scope="module")
def bare(folder):
    return cmfsim.planning_model(planning_patient(folder / "case"), "H+S")


@pytest.fixture(scope="module")
def planning(bare):
    """With a correction, which the page must evaluate as Python does."""
    corrected = cmfsim.corrected_planning(bare, 24)
    assert corrected.correction is not None
    return corrected


@pytest.fixture(scope="module")
def reference(planning):
    return planning.solve(planning.reference)


@pytest.fixture(scope="module")
def errors(planning):
    return cmfsim.expected_error(planning, trials=2)


@pytest.fixture(scope="module")
def content(planning, reference, errors):
    """Drawn with few triangles: browsers here draw by software."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cmfsim.planning.page.content, "FACE_TRIANGLES", 10_000)
        patch.setattr(cmfsim.planning.page.content, "BONE_TRIANGLES", 6_000)
        return cmfsim.page_content(planning, reference, errors)


@pytest.fixture(scope="module")
def page_file(folder, content):
    path = folder / "plan.html"
    cmfsim.write_planning_page(path, content)
    return path


def other_plan(planning, size=1.0):
    """Maxilla and mandible away from the reference, by mm and degrees of an ordinary plan."""
    skull = planning.patient.landmarks["skull"]
    plan = dict(planning.reference)
    plan["maxilla"] = cmfsim.planned_motion(
        skull["supradentale"], shift=(3.0 * size, 2.0, -1.0), turn=(-3.0, 2.0 * size, 1.0)
    )
    plan["mandible_body"] = cmfsim.planned_motion(
        skull["pogonion"], shift=(-2.0 * size, 1.0, -1.5), turn=(1.0, 1.5, -2.0 * size)
    )
    return plan


# The planning model ---------------------------------------------------------------------------


def test_the_product_is_the_exact_solution_at_the_reference(planning, reference):
    product = planning.displacements(planning.reference)
    # Contact ends at 1e-4 mm.
    np.testing.assert_allclose(product, reference.skin_displacements, atol=2e-4)


def test_the_columns_are_the_operator_of_the_core(bare):
    """With the skin continued where the tissue ends, as in every prediction."""
    plan = other_plan(bare)
    operator = bare.solver.plan_operator(nodes=bare.patient.skin_nodes, plan=dict(bare.reference))
    np.testing.assert_allclose(
        bare.displacements(plan), bare.patient.skin_end.continued(operator(plan)), atol=1e-9
    )


def test_the_correction_lowers_the_error_at_plans_that_it_was_not_fitted_to(bare, planning, errors):
    plans = [trial.plan for trial in errors.trials]
    plans += [other_plan(planning), other_plan(planning, 0.5)]
    squares = []
    for plan in plans:
        exact = planning.solve(plan).skin_displacements
        away = [np.linalg.norm(m.displacements(plan) - exact, axis=1) for m in (bare, planning)]
        squares.append([(row**2).sum() for row in away])
    before, after = np.sum(squares, axis=0)
    assert after < before
    fitted = planning.correction.plans
    apart = [
        np.abs(fitted - planning.correction.numbers.of(plan)).max(axis=(1, 2)) for plan in plans
    ]
    assert np.min(apart) > 0.5
    # Carried points are corrected too.
    points = np.asarray(planning.skin_before.vertices)[::300]
    difference = planning.carried(plans[0], points) - bare.carried(plans[0], points)
    np.testing.assert_allclose(
        difference, planning.correction.displacements(plans[0])[::300], atol=1e-9
    )


def test_the_command_corrects_the_page_and_states_it(folder, planning, capsys):
    case, out = folder / "case/case.toml", folder / "corrected"
    words = ["plan", str(case), "-o", str(out), "--model", "H+S", "--no-doctor", "-q", "--no-open"]
    assert main([*words, "--trials", "1", "--corrections", "24", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    found = answer["correction"]
    assert 8 <= found["plans"] <= 24
    assert len(found["largest_left_out_mm"]) == found["plans"]
    page = (out / "plan.html").read_text("utf-8")
    values = json.loads(re.search(r'id="page-values">([^<]*)<', page)[1])
    assert values["correction"]["plans"] == found["plans"]
    correction = planning.correction
    text = _correction_text(correction)
    assert f"by {len(correction.plans)} other plans: {correction.before.max():.2f} mm" in text
    usual = np.percentile(correction.left_out, 90)
    left_out = correction.left_out.max()
    assert (
        f"{left_out:.2f} mm when each is predicted from the others (nine of ten: {usual:.2f}"
        in text
    )


def test_corrections_are_the_same_each_time(bare, planning):
    again = cmfsim.corrected_planning(bare, 24).correction
    np.testing.assert_array_equal(again.shapes, planning.correction.shapes)
    np.testing.assert_array_equal(again.weights, planning.correction.weights)
    serial = [planning.solve(plan).skin_displacements for plan in again_plans(bare, 2)]
    largest = [
        np.linalg.norm(exact - bare.displacements(plan), axis=1).max()
        for exact, plan in zip(serial, again_plans(bare, 2), strict=True)
    ]
    np.testing.assert_array_equal(again.before[:2], largest)


def again_plans(bare, count):
    """The first plans of a correction, by its seed."""
    rng = np.random.default_rng((0, 1))
    return [plan_near(bare, rng, 5.0, 5.0) for _ in range(count)]


def test_corrections_that_cannot_be_fitted_leave_the_operator_alone(bare, planning):
    assert cmfsim.corrected_planning(planning, 0).correction is None
    assert cmfsim.corrected_planning(bare, 4).correction is None
    assert (
        cmfsim.corrected_planning(cmfsim.planning_model(bare.patient, "H"), 24).correction is None
    )
    with pytest.raises(cmfsim.CaseError, match="plans is -1"):
        cmfsim.corrected_planning(bare, -1)


def test_without_sliding_the_product_is_exact_for_every_plan(planning):
    model = cmfsim.planning_model(planning.patient, "H")
    plan = other_plan(model, 3.0)
    exact = model.solve(plan).skin_displacements
    assert np.abs(exact).max() > 5.0
    np.testing.assert_allclose(model.displacements(plan), exact, atol=1e-8)
    found = cmfsim.expected_error(model)
    assert not found.slides
    assert len(found.trials) == 1
    assert found.trials[0].largest < 1e-8
    assert found.at(100.0) == (0.0, 0.0)


def test_a_prediction_is_planned_again_as_the_model_solves_it(planning, reference):
    plan = {"maxilla": other_plan(planning)["maxilla"]}
    # A planning model keeps what its reference lifts off the bone, a new prediction does not.
    kept = dataclasses.replace(
        reference, patient=dataclasses.replace(reference.patient, lifted=None)
    )
    again, exact = kept.replan(plan), planning.solve(plan)
    np.testing.assert_allclose(again.skin_displacements, exact.skin_displacements, atol=1e-6)
    # Segments that are not named stay, and nothing is said of where the case's motions came from.
    np.testing.assert_array_equal(again.scene.plan["mandible_body"], np.eye(4))
    assert again.summary["plan"]["maxilla"]["clinical"]["source"] == ""
    assert again.summary["case_key"] != reference.summary["case_key"]
    with pytest.raises(cmfsim.CaseError, match="'skull'; segments are"):
        reference.replan({"skull": np.eye(4)})
    with pytest.raises(cmfsim.CaseError, match="does not record how it was made"):
        dataclasses.replace(reference, predicted_by=None).replan({})


def test_the_expected_error_is_that_of_the_trials(planning, errors):
    trial = errors.trials[0]
    exact = planning.solve(trial.plan).skin_displacements
    away = np.linalg.norm(planning.displacements(trial.plan) - exact, axis=1)
    assert trial.largest == pytest.approx(away.max(), rel=1e-6)
    assert trial.mean == pytest.approx(away.mean(), rel=1e-6)
    assert trial.distance == pytest.approx(plan_distance(planning, trial.plan))
    mean, largest = errors.at(trial.distance)
    assert mean >= trial.mean * (1 - 1e-12)
    assert largest >= trial.largest * (1 - 1e-12)
    assert errors.at(0.0) == (0.0, 0.0)
    assert errors.at(1.01 * errors.reach) is None
    assert errors.usual(1.01 * errors.reach) is None
    # Plans of the correction count as well, each as the others predict it.
    correction = planning.correction
    ratios = np.concatenate(
        [
            [t.largest / t.distance for t in errors.trials],
            correction.left_out / correction.distances,
        ]
    )
    assert largest == pytest.approx(trial.distance * ratios.max())
    assert errors.usual(trial.distance) == pytest.approx(
        trial.distance * np.percentile(ratios, 90.0)
    )
    assert errors.usual(trial.distance) < largest
    drawn = again_plans(planning, len(correction.distances))
    assert correction.distances[0] == pytest.approx(plan_distance(planning, drawn[0]))
    # Trials differ from the reference, by no more than what was asked for.
    assert 1.0 < trial.distance < 5.0 * 3**0.5 + 15.0


def test_scenes_without_a_linear_rigid_answer_are_refused(planning):
    scene = planning.patient.scene
    options = dataclasses.replace(scene.options, kinematics="corotational")
    bent = dataclasses.replace(planning.patient, scene=dataclasses.replace(scene, options=options))
    with pytest.raises(cmfsim.CaseError, match="corotational kinematics"):
        cmfsim.planning_model(bent, "H")
    name = "maxilla"
    shifts = np.zeros((len(scene.segments[name].joined), 3))
    torn = planning.patient.with_plan({name: shifts})
    with pytest.raises(cmfsim.CaseError, match="'maxilla' moves vertex by vertex"):
        cmfsim.planning_model(torn, "H+S")
    with pytest.raises(cmfsim.BoundaryError):
        planning.displacements({name: 2.0 * np.eye(4)})
    with pytest.raises(ValueError, match="trials is 0"):
        cmfsim.expected_error(planning, trials=0)


def test_tooth_rows_pass_through_each_other_when_the_jaw_closes(planning):
    rows = cmfsim.planning.page.tooth_rows(planning.patient)
    maxilla = next(s for s in planning.patient.segments if s.name == "maxilla")
    surface = cmfsim.Surface(maxilla.surface.vertices, maxilla.surface.triangles)
    found = []
    for up in (0.0, 4.0, 7.0):
        shift = cmfsim.rigid_motion((0.0, 0.0, up))
        places = rows.points + [0.0, 0.0, up]
        inside = np.asarray(surface.winding_number(places)) > 0.5
        away = np.linalg.norm(surface.closest(places)[0] - places, axis=1)
        depth = rows.passing({"mandible_body": shift})
        # A grid of 1 mm, against the surface itself.
        assert depth == pytest.approx(max(away[inside], default=0.0), abs=0.25)
        found.append(depth)
    assert found[0] < 0.3 < found[1] < found[2]
    # Both jaws together: nothing changes between them.
    both = cmfsim.rigid_motion((3, -2, 9), 7, (1, 2, 3))
    together = rows.passing({"maxilla": both, "mandible_body": both})
    assert together == pytest.approx(found[0], abs=1e-6)


# The file -------------------------------------------------------------------------------------


def test_the_page_allows_its_own_script_and_no_network(page_file):
    text = page_file.read_text(encoding="utf-8")
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', text)[1]
    script = re.search(r'<script type="module">(.*?)</script>', text, re.DOTALL)[1]
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert policy.startswith("default-src 'none'; script-src 'sha256-")
    assert f"'sha256-{digest}'" in policy
    assert "unsafe" not in policy
    assert "connect-src" not in policy
    addresses = set(re.findall(r"""(?:src|href)=["']?([^"'\s>]+)""", text))
    assert not addresses
    assert not re.search(r"https?://(?!www\.w3\.org)", script)
    assert "not a medical device" in text
    assert page_file.stat().st_size < 12e6


def test_equal_content_gives_equal_bytes(content):
    first, second = (cmfsim.page_text(content) for _ in range(2))
    assert first == second


def test_numbers_that_are_not_finite_are_refused(content):
    arrays = {**content.arrays, "nodes": np.full((4, 3), np.nan, dtype=np.float32)}
    with pytest.raises(cmfsim.CaseError, match="'nodes' of the page holds numbers"):
        cmfsim.page_text(dataclasses.replace(content, arrays=arrays))


def test_packed_numbers_are_those_of_the_content(content, page_file):
    text = page_file.read_text(encoding="utf-8")
    packed = re.search(r'id="page-numbers">([^<]*)<', text)[1]
    block = gzip.decompress(base64.b64decode(packed))
    table = json.loads(re.search(r'id="page-values">([^<]*)<', text)[1])["arrays"]
    assert [entry["name"] for entry in table] == list(content.arrays)
    for entry in table:
        given = content.arrays[entry["name"]]
        count = int(np.prod(entry["shape"]))
        found = np.frombuffer(block, entry["type"], count, entry["start"])
        np.testing.assert_array_equal(found.reshape(given.shape), given)


def test_scripts_that_cannot_be_joined_are_refused():
    with pytest.raises(cmfsim.CaseError, match=r"main\.js → a\.js → main\.js"):
        joined_scripts(
            {
                "main.js": 'import { a } from "./a.js";\n',
                "a.js": 'import { b } from "./main.js";\nexport const a = 1;\n',
            }
        )
    with pytest.raises(cmfsim.CaseError, match=r"no script 'b\.js'"):
        joined_scripts({"main.js": 'import { b } from "./b.js";\n'})
    with pytest.raises(cmfsim.CaseError, match=r"a\.js and main\.js both define 'a'"):
        joined_scripts(
            {"main.js": 'import { a } from "./a.js";\nconst a = 2;\n', "a.js": "const a = 1;\n"}
        )


def test_a_skin_too_fine_for_a_page_is_refused_and_a_fine_face_simplified(
    planning, reference, errors, monkeypatch
):
    fine = cmfsim.planning.page.content
    monkeypatch.setattr(fine, "FACE_TRIANGLES", 8_000)
    found = cmfsim.page_content(planning, reference, errors)
    assert len(found.arrays["face_triangles"]) <= 8_100
    text = next(f.what for f in found.findings if f.where == "face")
    away = float(re.search(r"at most ([0-9.]+) mm away", text)[1])
    assert away < 2.0
    monkeypatch.setattr(fine, "MOST_NODES", 1000)
    with pytest.raises(cmfsim.CaseError, match="use a larger edge_length"):
        cmfsim.page_content(planning, reference, errors)


# In a browser ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def page(browser, page_file):
    """One page for all tests; in the end it must have had no error and asked for nothing."""
    yield from open_page(browser, page_file)


@pytest.fixture
def opened(page):
    """The page as it was when it was opened."""
    page.evaluate("() => { cmfsimPage.reset(); cmfsimPage.plans.past.length = 0; }")
    page.evaluate("cmfsimPage.panel.choose(0)")
    page.locator("#turns-about").select_option("0")
    settle(page)
    return page


def type_number(page, key, value):
    page.locator(f"#number-{key}").fill(str(value))
    page.locator(f"#number-{key}").press("Enter")


def motions_of(page, planning):
    rows = page.evaluate("cmfsimPage.motions")
    return {n: np.array(m).reshape(4, 4) for n, m in zip(planning.segments, rows, strict=True)}


def settle(page):
    """Until the plan on the page has its face."""
    until(page, "!cmfsimPage.frame && !cmfsimPage.work")


def saved(page, button):
    with page.expect_download() as download:
        page.locator(button).click()
    return download.value


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
        for measure, value in zip(cmfsim.MEASURES, found, strict=True):
            if wanted[measure.key] is None:
                assert value is None
            else:
                limit = 0.05 if measure.unit == "°" else 0.01
                assert value == pytest.approx(wanted[measure.key], abs=limit), measure.key


def test_every_view_draws_something_else(opened):
    pictures = {}
    for name in ("Front", "Profile", "Left profile", "Three-quarter", "From below"):
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
    opened.get_by_role("button", name="Profile", exact=True).click()
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
    rows = cmfsim.planning.page.tooth_rows(planning.patient)
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
    opened.get_by_role("button", name="Profile", exact=True).click()
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
    assert page.locator("#command").inner_text().startswith("cmfsim predict 'a b'\\''$(x).toml'")
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


# Served ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def server(planning, content):
    pytest.importorskip("starlette")
    pytest.importorskip("uvicorn")
    running = PlanningServer(planning, content)
    thread = threading.Thread(target=running.run)
    thread.start()
    yield running
    running.stop()
    thread.join(timeout=20)
    assert not thread.is_alive()


def asked(url, body=None, method=None, **headers):
    """Status, body and headers of an answer; names of headers with _ for -."""
    parts = urlsplit(url)
    connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=30)
    own = {"Host": parts.netloc, **{n.replace("_", "-"): v for n, v in headers.items()}}
    try:
        connection.request(method or ("GET" if body is None else "POST"), parts.path, body, own)
        answer = connection.getresponse()
        return answer.status, answer.read(), answer.headers
    finally:
        connection.close()


def origin_of(url):
    return f"http://{urlsplit(url).netloc}"


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

    def solved(plan):
        begun.append(round(float(plan["maxilla"][1, 3]), 3))
        go.wait(20)
        return server._responses.PlainTextResponse("solved")

    monkeypatch.setattr(server, "_solved", solved)

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


def wait_for(condition):
    deadline = time.monotonic() + 20.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


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
