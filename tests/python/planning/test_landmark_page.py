"""The page of landmarks in a browser: sites are placed, follow, and go to files and back."""

import dataclasses
import json

import numpy as np
import pytest

import cmfsim
import cmfsim.planning.landmark_page.page
from browser_page import open_page, serious_faults, until
from cmfsim.io import read_landmark_file
from cmfsim.pipeline.outputs.landmark_page import head_content, write_landmark_page
from cmfsim.pipeline.proposing import ProposedHead, filled_landmarks, head_distribution
from cmfsim.registration.proposed.shape_model.site_covariance import PLACED_STD
from cmfsim.registration.proposed.template_head import average_head
from cmfsim.values.landmark_sites import site_part
from cmfsim.values.proposed_landmarks import ProposedLandmarks, ProposedSite, SiteState, site_state

HIGH = 9.0
DOUBTFUL = ("infradentale", "pogonion", "menton")
GONE = "gonion_L"


@pytest.fixture(scope="module")
def head():
    """The average head, with chin sites 9 mm too high and one gonion missing."""
    average = average_head()
    skull = {}
    for name, point in average.skull.items():
        wrong = name in DOUBTFUL
        shift = np.array([0.0, 0.0, HIGH]) if wrong else np.zeros(3)
        doubt = "the jaw is doubtful" if wrong else ""
        skull[name] = ProposedSite(point + shift, 10.0 if wrong else 2.0, doubt)
    del skull[GONE]
    skin = {name: ProposedSite(point, 2.0) for name, point in average.skin_landmarks.items()}
    found = ProposedLandmarks(skull, skin, {GONE: "the image ends there (left border)"})
    return ProposedHead(None, average.bones, average.skin, found)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("landmark_page")


@pytest.fixture(scope="module")
def content(head):
    """Drawn with few triangles: browsers here draw by software."""
    few = {"cranium": 8_000, "mandible": 5_000, "skin": 6_000}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cmfsim.planning.landmark_page.page, "MOST_TRIANGLES", few)
        return head_content("average </script> head", head)


@pytest.fixture(scope="module")
def page(browser, folder, content):
    """One page for all tests; in the end it must have had no error and asked for nothing."""
    write_landmark_page(folder / "landmarks.html", content)
    for opened in open_page(browser, folder / "landmarks.html"):
        opened.emulate_media(reduced_motion="reduce")
        yield opened


@pytest.fixture
def opened(page):
    """The page as it was when it was opened."""
    page.evaluate(
        "() => { const p = cmfsimPage; p.history.take(new Map()); p.history.past.length = 0;"
        " p.history.future.length = 0; p.report(''); p.shown = p.derived(p.decided);"
        " p.showPart('cranium', 1); p.showPart('mandible', 1); p.choose(p.toCheck()[0]); }"
    )
    settle(page)
    return page


def settle(page):
    until(page, "!cmfsimPage.frame && !cmfsimPage.flight")


def index(content, name, kind="skull"):
    names = [(s["kind"], s["name"]) for s in content.values["sites"]]
    return names.index((kind, name))


def choose(page, number):
    page.evaluate(f"cmfsimPage.choose({number})")
    settle(page)


def shown(page, number):
    return page.evaluate(f"cmfsimPage.shown[{number}]")


def message(page):
    return page.locator("#message").inner_text()


def screen_place(page, point):
    """Where a point is on the screen."""
    box = page.locator("#overlay").bounding_box()
    x, y = page.evaluate(
        f"cmfsimPage.camera.project({list(map(float, point))}, ...cmfsimPage.size)"
    )
    return box["x"] + x, box["y"] + y


def click(page, point):
    page.mouse.click(*screen_place(page, point))
    settle(page)


def look(page, azimuth, elevation, span, target):
    page.evaluate(
        "() => { const c = cmfsimPage.camera;"
        f" c.look({{ azimuth: {azimuth}, elevation: {elevation} }});"
        f" c.span = {span}; c.target = {list(map(float, target))}; cmfsimPage.redraw(); }}"
    )
    settle(page)


# What the page shows --------------------------------------------------------------------------


def test_the_page_has_no_serious_fault_of_accessibility(opened):
    assert serious_faults(opened) == []


def test_sites_to_check_come_first_with_reason_and_definition(opened, content):
    rows = opened.locator("#sites .site .name").all_inner_texts()
    assert set(rows[:4]) == {"Infradentale", "Pogonion", "Menton", "Gonion, left"}
    assert len(rows) == 46
    assert "To check (4)" in opened.locator("#group-check").inner_text()
    choose(opened, index(content, "menton"))
    assert opened.locator("#site-title").inner_text() == "Menton"
    assert "the jaw is doubtful" in opened.locator("#site-state").inner_text()
    assert "lowest point of the mandible" in opened.locator("#site-where").inner_text()
    choose(opened, index(content, GONE))
    assert "the image ends there" in opened.locator("#site-state").inner_text()
    # The camera looks at it from its standard view, and the average head is drawn.
    target = opened.evaluate("cmfsimPage.camera.target")
    np.testing.assert_allclose(target, shown(opened, index(content, GONE))["point"], atol=1e-6)
    colours = opened.evaluate(
        "() => { const g = cmfsimPage.panel.drawing; cmfsimPage.panel.drawAverage();"
        " const p = new Uint8Array(4 * g.width * g.height);"
        " g.gl.readPixels(0, 0, g.width, g.height, g.gl.RGBA, g.gl.UNSIGNED_BYTE, p);"
        " return new Set(Array.from({length: p.length / 4}, (_, i) => p[4 * i])).size; }"
    )
    assert colours > 20


def test_every_site_can_be_seen_in_its_standard_view(opened, content):
    """On a head without doubt, a ball is in front of the bone where the camera flies to."""
    for number, site in enumerate(content.values["sites"]):
        if site["doubt"] or site["origin"] == "filled":
            continue
        choose(opened, number)
        at = opened.evaluate(
            f"cmfsimPage.camera.project(cmfsimPage.shown[{number}].point, ...cmfsimPage.size)"
        )
        assert opened.evaluate(f"cmfsimPage.ballAt({at})") == number, site["name"]


# Placing --------------------------------------------------------------------------------------


def test_a_click_places_the_site_on_its_bone_and_the_others_follow_as_in_python(
    opened, content, head
):
    number = index(content, "menton")
    choose(opened, number)
    truth = average_head().skull["menton"]
    look(opened, 0, -60, 120, truth)
    click(opened, truth)
    placed = shown(opened, number)
    assert placed["state"] == "placed"
    assert np.linalg.norm(placed["point"] - truth) < 1.0
    assert "Menton placed" in message(opened)
    # On the displayed surface.
    assert opened.evaluate(f"cmfsimPage.away('mandible', {placed['point']})") < 1e-3
    distribution = head_distribution(head)
    after = distribution.given({("skull", "menton"): np.array(placed["point"])})
    given = opened.evaluate(
        f"[...cmfsimPage.model.shifts([{number}], [cmfsimPage.shown[{number}].point])]"
    )
    np.testing.assert_allclose(
        np.reshape(given, (-1, 3)), after.mean - distribution.mean, atol=1e-3
    )
    errors = opened.evaluate(f"cmfsimPage.model.given([{number}]).errors")
    np.testing.assert_allclose(errors, after.errors, atol=1e-3)
    # The chin was too high and follows; the brow was right and stays.
    pogonion = shown(opened, index(content, "pogonion"))
    truth = average_head().skull["pogonion"]
    assert np.linalg.norm(pogonion["point"] - truth) < 0.6 * HIGH
    glabella = shown(opened, index(content, "glabella"))
    assert np.linalg.norm(glabella["point"] - average_head().skull["glabella"]) < 0.5


def test_the_page_names_the_site_that_helps_the_others_most(opened, content, head):
    distribution = head_distribution(head)
    nasion = average_head().skull["nasion"]
    place(opened, index(content, "nasion"), nasion)
    left = distribution.given({("skull", "nasion"): nasion}).covariance
    names = [
        s["label"]
        for s in opened.evaluate("cmfsimPage.toCheck().map((i) => cmfsimPage.page.sites[i])")
    ]
    sites = opened.evaluate("cmfsimPage.toCheck()")
    assert len(sites) > 1
    gains = [
        sum((left[:, i] ** 2).sum() / (left[i, i] + PLACED_STD**2) for i in range(3 * s, 3 * s + 3))
        for s in sites
    ]
    best = names[int(np.argmax(gains))]
    assert f"{best} would help the others most" in opened.locator("#error-state").inner_text()


def test_a_click_on_another_bone_says_so_and_places_nothing(opened, content):
    nasion = average_head().skull["nasion"]
    choose(opened, index(content, "menton"))
    look(opened, 0, 0, 120, nasion)
    click(opened, nasion + [12.0, 0, 20.0])
    assert "lies on the mandible, and this is the cranium" in message(opened)
    assert opened.evaluate("cmfsimPage.decided.size") == 0
    # With the skin in front it is the skin.
    opened.locator("#show-skin").evaluate(
        "f => { f.value = 1; f.dispatchEvent(new Event('input')); }"
    )
    click(opened, nasion + [12.0, 0, 20.0])
    assert "this is the skin" in message(opened)
    assert opened.evaluate("cmfsimPage.decided.size") == 0


def test_dragging_a_ball_moves_it_over_its_bone_and_undo_brings_it_back(opened, content):
    number = index(content, "glabella")
    choose(opened, number)
    before = shown(opened, number)["point"]
    x, y = screen_place(opened, before)
    opened.mouse.move(x, y)
    opened.mouse.down()
    opened.mouse.move(x + 12, y - 4)
    opened.mouse.move(x + 25, y - 8)
    opened.mouse.up()
    settle(opened)
    after = shown(opened, number)
    assert after["state"] == "placed"
    assert 3.0 < np.linalg.norm(np.subtract(after["point"], before)) < 20.0
    assert opened.evaluate(f"cmfsimPage.away('cranium', {after['point']})") < 1e-3
    opened.keyboard.press("Control+z")
    assert shown(opened, number)["state"] == "proposed"
    np.testing.assert_allclose(shown(opened, number)["point"], before, atol=1e-9)
    opened.keyboard.press("Control+Shift+z")
    assert shown(opened, number)["point"] == after["point"]


def test_dragging_beside_the_balls_turns_the_camera_and_places_nothing(opened, content):
    choose(opened, index(content, "glabella"))
    azimuth = opened.evaluate("cmfsimPage.camera.azimuth")
    box = opened.locator("#overlay").bounding_box()
    opened.mouse.move(box["x"] + 10, box["y"] + 10)
    opened.mouse.down()
    opened.mouse.move(box["x"] + 80, box["y"] + 10)
    opened.mouse.up()
    assert opened.evaluate("cmfsimPage.camera.azimuth") != azimuth
    assert opened.evaluate("cmfsimPage.decided.size") == 0


def test_keys_step_accept_remove_and_change_sides(opened, content):
    order = [s for s in content.values["sites"] if s["doubt"] or s["origin"] == "filled"]
    names = [s["name"] for s in order]
    assert opened.evaluate("cmfsimPage.site.name") == names[0]
    opened.keyboard.press("n")
    assert opened.evaluate("cmfsimPage.site.name") == names[1]
    opened.keyboard.press("p")
    opened.keyboard.press("Enter")
    accepted = index(content, names[0])
    assert shown(opened, accepted)["state"] == "accepted"
    # Accepting goes on to the next that is still to be checked.
    assert opened.evaluate("cmfsimPage.chosen === cmfsimPage.toCheck()[0]")
    choose(opened, accepted)
    opened.keyboard.press("Delete")
    assert shown(opened, accepted)["state"] == "doubtful"
    choose(opened, index(content, "zygomatic_arch_L"))
    opened.keyboard.press("x")
    assert opened.evaluate("cmfsimPage.site.name") == "zygomatic_arch_R"


def test_the_other_side_is_placed_at_the_mirror_image(opened, content):
    right = index(content, "gonion_R")
    choose(opened, right)
    opened.keyboard.press("Enter")
    choose(opened, right)
    opened.keyboard.press("m")
    left = shown(opened, index(content, GONE))
    assert left["state"] == "placed"
    assert np.linalg.norm(left["point"] - average_head().skull[GONE]) < 1.0


# Files ----------------------------------------------------------------------------------------


def saved(page, kind, folder):
    with page.expect_download() as caught:
        page.locator(f"#save-{kind}").click()
    path = folder / caught.value.suggested_filename
    caught.value.save_as(path)
    return path


def load(page, path):
    before = message(page)
    page.locator("#landmark-files").set_input_files(path)
    until(page, f"document.getElementById('message').textContent !== {json.dumps(before)}")
    settle(page)
    return message(page)


def place(page, number, point):
    page.evaluate(f"cmfsimPage.put({number}, {list(map(float, point))})")
    settle(page)


def test_saved_files_are_read_by_cmfsim_and_come_back(opened, content, tmp_path):
    menton, nasion = index(content, "menton"), index(content, "nasion")
    place(opened, menton, average_head().skull["menton"])
    choose(opened, nasion)
    opened.keyboard.press("Enter")
    points = opened.evaluate("cmfsimPage.shown.map((s) => s.point)")
    path = saved(opened, "skull", tmp_path)
    assert path.name == "skull_landmarks.mrk.json"
    read = read_landmark_file(path, kind="skull")
    assert (read.frame, read.stated) == ("LPS", True)
    for site, point in zip(content.values["sites"], points, strict=True):
        if site["kind"] == "skull" and site["name"] in read.points:
            np.testing.assert_allclose(read.points[site["name"]], point, atol=1e-4)
    states = {name: site_state(text) for name, text in read.descriptions.items()}
    assert states["menton"] == SiteState("placed")
    assert states["nasion"] == SiteState("accepted")
    assert states["glabella"].origin == "proposed"
    assert states["glabella"].error > 0.0
    assert not states["pogonion"].by_person
    gone = shown(opened, index(content, GONE))["state"]
    assert (GONE in read.unset) == (gone == "missing")
    # Back, after everything was undone; the rest follows as before.
    opened.evaluate("cmfsimPage.decide(new Map())")
    text = load(opened, path)
    assert "2 skull sites loaded" in text
    assert opened.evaluate("cmfsimPage.decided.size") == 2
    again = opened.evaluate("cmfsimPage.shown.map((s) => s.point)")
    np.testing.assert_allclose(again, points, atol=1e-3)
    opened.keyboard.press("Control+z")
    assert opened.evaluate("cmfsimPage.decided.size") == 0


def test_a_proposed_site_that_was_moved_elsewhere_counts_as_placed(opened, content, tmp_path):
    """3D Slicer keeps the description of a point that a person moves."""
    point = average_head().skull["glabella"] + [4.0, 0.0, 0.0]
    states = {"glabella": SiteState("proposed", 2.0).description}
    path = tmp_path / "skull.mrk.json"
    cmfsim.write_landmarks(path, {"glabella": point}, descriptions=states)
    assert "1 skull sites loaded" in load(opened, path)
    assert shown(opened, index(content, "glabella"))["state"] == "placed"


def test_files_are_dropped_anywhere(opened, content, tmp_path):
    path = tmp_path / "skin_landmarks.mrk.json"
    cmfsim.write_landmarks(path, {"pronasale": average_head().skin_landmarks["pronasale"]})
    opened.evaluate(
        "([text, name]) => { const data = new DataTransfer();"
        " data.items.add(new File([text], name)); document.body.dispatchEvent("
        "new DragEvent('drop', { dataTransfer: data, bubbles: true, cancelable: true })); }",
        [path.read_text(encoding="utf-8"), path.name],
    )
    until(opened, "cmfsimPage.decided.size === 1")
    assert shown(opened, index(content, "pronasale", "skin"))["state"] == "placed"


def right_points(count=12):
    return dict(list(average_head().skull.items())[:count])


@pytest.mark.parametrize(
    ("points", "text"),
    [
        ({n: p + [30.0, 40.0, 10.0] for n, p in right_points().items()}, "another patient"),
        ({n: p * [-1, -1, 1] for n, p in right_points().items()}, "LPS and RAS are exchanged"),
        ({"left ear": (1.0, 2.0, 3.0)}, "do not tell skull from skin"),
        ({"gonion_L": right_points(40)["gonion_R"], "gonion_R": right_points(40)["gonion_L"]},
         "left and right are exchanged"),
        ({"A": right_points()["mid_philtrum"], "mid_philtrum": right_points()["mid_philtrum"]},
         "has mid_philtrum twice"),
        ({"menton": right_points()["menton"],
          "pronasale": average_head().skin_landmarks["pronasale"]}, "both skull and skin"),
        ("nothing", "no JSON"),
        ('{"markups": [{"coordinateSystem": "XYZ"}]}', "LPS and RAS are read"),
        ('{"markups": [{"controlPoints": [{"label": "menton", "position": [1, "x", 2]}]}]}',
         "not at three numbers"),
    ],
)  # fmt: skip
def test_a_wrong_file_is_refused_with_the_reason(opened, tmp_path, points, text):
    path = tmp_path / "points.mrk.json"
    if isinstance(points, str):
        path.write_text(points, encoding="utf-8")
    else:
        cmfsim.write_landmarks(path, points)
    found = load(opened, path)
    assert text in found
    assert "Nothing was loaded" in found
    assert opened.evaluate("cmfsimPage.decided.size") == 0


def test_unknown_labels_and_points_off_the_bone_are_skipped_by_name(opened, content, tmp_path):
    points = {**right_points(), "ear": np.zeros(3), "LGo": right_points(40)["gonion_L"]}
    points["glabella"] = points["glabella"] + [0.0, -30.0, 0.0]
    path = tmp_path / "skull.mrk.json"
    cmfsim.write_landmarks(path, points)
    found = load(opened, path)
    assert "unknown labels were skipped: ear" in found
    assert "more than 8 mm from their surface: glabella" in found
    # By the name of cephalometry.
    assert shown(opened, index(content, "gonion_L"))["state"] == "placed"
    assert shown(opened, index(content, "glabella"))["state"] == "proposed"


# Without a browser ----------------------------------------------------------------------------


def test_the_page_starts_with_what_the_case_has_placed(head):
    point = average_head().skull["menton"]
    state = SiteState("accepted")
    found = head_content("head", head, {("skull", "menton"): (point, state)}).values["sites"]
    entry = next(s for s in found if s["name"] == "menton" and s["kind"] == "skull")
    np.testing.assert_allclose(entry["placed"], point)
    assert entry["placed_origin"] == "accepted"
    assert entry["origin"] == "proposed"


def test_given_sites_stay_others_follow_and_missing_ones_are_filled_in(head):
    truth = average_head()
    names = ("menton", "pogonion", "sub_m2_L")
    given = {("skull", n): (truth.skull[n], SiteState()) for n in names}
    found = filled_landmarks(head, given)
    np.testing.assert_allclose(found.skull["menton"].point, truth.skull["menton"], atol=0.05)
    assert found.skull["menton"].origin == "placed"
    infradentale = found.skull["infradentale"]
    assert infradentale.origin == "moved"
    assert np.linalg.norm(infradentale.point - truth.skull["infradentale"]) < 0.65 * HIGH
    assert infradentale.error < 10.0
    gone = found.skull[GONE]
    assert gone.origin == "filled"
    assert np.linalg.norm(gone.point - truth.skull[GONE]) < 3.0
    assert found.missing_skull == {}
    texts = [f.what for f in found.findings if f.code == "landmarks-filled"]
    assert len(texts) == 1
    assert f"gonion_L ({gone.error:.1f} mm)" in texts[0]
    assert tuple(found.skull) == tuple(truth.skull)


def test_a_point_of_the_drawn_surface_is_brought_onto_the_bone_itself(head):
    """The page places points on a coarser surface; one far away is no such point and stays."""
    point = average_head().skull["pogonion"] + [0.0, -0.6, 0.0]
    mandible = head.bones["mandible"]
    surface = cmfsim.Surface(mandible.vertices, mandible.triangles)
    found = filled_landmarks(head, {("skull", "pogonion"): (point, SiteState())})
    place = found.skull["pogonion"].point
    assert np.linalg.norm(surface.closest(place[None])[0][0] - place) < 1e-9
    assert np.linalg.norm(place - point) < 1.0
    far = point - [0.0, 5.0, 0.0]
    found = filled_landmarks(head, {("skull", "pogonion"): (far, SiteState())})
    np.testing.assert_array_equal(found.skull["pogonion"].point, far)


def test_a_given_site_on_another_bone_is_doubtful_and_one_beside_the_head_an_error(head):
    point = average_head().skull["nasion"]
    found = filled_landmarks(head, {("skull", "menton"): (point, SiteState())})
    assert "lies on the cranium" in found.skull["menton"].doubt
    assert "landmark-doubtful" in {f.code for f in found.findings}
    mirrored = point * [-1.0, -1.0, 1.0] + [0.0, 40.0, 0.0]
    with pytest.raises(cmfsim.LandmarkError, match=r"nasion \(skull\) of the case lies \d+ mm"):
        filled_landmarks(head, {("skull", "nasion"): (mirrored, SiteState())})


def test_without_any_proposal_a_few_placed_sites_place_the_rest(head):
    truth = average_head()
    nothing = dataclasses.replace(head, landmarks=ProposedLandmarks({}, {}))
    names = ("nasion", "menton", "gonion_L", "gonion_R", "zygomatic_arch_L", "supradentale")
    given = {("skull", n): (truth.skull[n], SiteState()) for n in names}
    found = filled_landmarks(nothing, given)
    errors = [
        np.linalg.norm(site.point - truth.skull[n])
        for n, site in found.skull.items()
        if n not in names
    ]
    assert len(errors) > 20
    assert np.mean(errors) < 3.0
    assert {site_part("skull", n) for n in found.skull} == {"cranium", "mandible"}
