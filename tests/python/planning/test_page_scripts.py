"""Scripts of the planning page that need no browser, run by Node."""

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import cmfsim
from cmfsim.planning.face_measures.sites import BoneSite
from cmfsim.planning.page.content import occlusal_measures
from cmfsim.planning.page.document import joined_scripts
from cmfsim.values.motion import plan_digits

SCRIPTS = Path(cmfsim.__file__).parent / "planning/page/scripts"
NODE = shutil.which("node")
pytestmark = pytest.mark.skipif(NODE is None, reason="Node is missing")


def answers(folder, text):
    """What a script prints that imports the page's, as values."""
    for script in SCRIPTS.glob("*.js"):
        shutil.copy(script, folder / script.name)
    (folder / "package.json").write_text('{"type": "module"}', encoding="utf-8")
    (folder / "asked.js").write_text(text, encoding="utf-8")
    done = subprocess.run([NODE, "asked.js"], cwd=folder, capture_output=True, check=True)
    return json.loads(done.stdout)


@pytest.mark.parametrize(
    "page", [("page", "main"), ("landmark_page", "landmarks_main"), ("face_view", "view_main")]
)
def test_the_scripts_of_each_page_are_one_that_is_valid(page, tmp_path):
    folder, main = page
    scripts = [*SCRIPTS.glob("*.js"), *(SCRIPTS.parents[1] / folder / "scripts").glob("*.js")]
    texts = {path.name: path.read_text(encoding="utf-8") for path in scripts}
    (tmp_path / "joined.mjs").write_text(joined_scripts(texts, f"{main}.js"), encoding="utf-8")
    subprocess.run([NODE, "--check", "joined.mjs"], cwd=tmp_path, check=True)


def test_a_decimal_comma_is_a_point_and_all_else_is_refused(tmp_path):
    texts = ["2,5", "2.5", " -3 ", "−1,25", "+.5", "7.", "", "2,5,1", "1.234,5", "2 5", "1e3", "x"]
    found = answers(
        tmp_path,
        'import { typedNumber } from "./elements.js";'
        f"console.log(JSON.stringify({json.dumps(texts)}.map(typedNumber)));",
    )
    assert found == [2.5, 2.5, -3, -1.25, 0.5, 7, None, None, None, None, 1000, None]


def test_the_page_and_predict_give_plans_the_same_digits(tmp_path):
    """Names beyond the basic plane, motions that are none, and a rotation with all its digits."""
    plans = [
        {"maxilla": cmfsim.rigid_motion((0, -4, 0)), "chin": np.eye(4)},
        {"maxilla": cmfsim.rigid_motion((0, -4, 0.1)), "chin": np.eye(4)},
        {"chin": cmfsim.rigid_motion((0, -4, 0))},
        {
            "z": cmfsim.rigid_motion((1.1, -2.2, 3.3), 7.7, (1, 2, 3), (10, -90, 1500)),
            "改": cmfsim.rigid_motion((0.5, 0, 0)),
            "\U0001f9b7": cmfsim.rigid_motion((0, 0, -1.5)),
        },
        {"maxilla": np.eye(4)},
    ]
    given = [
        {
            "page": {"segments": [{"name": n} for n in plan]},
            "motions": [m.ravel().tolist() for m in plan.values()],
        }
        for plan in plans
    ]
    found = answers(
        tmp_path,
        'import { planDigits, planText } from "./exporting.js";'
        f"const plans = {json.dumps(given)};"
        "console.log(JSON.stringify(plans.map((p) => [planDigits(p.page, p.motions),"
        ' planText(p.page, { name: "A", motions: p.motions })])));',
    )
    digits = [plan_digits(plan) for plan in plans]
    assert [entry[0] for entry in found] == digits
    assert len(set(digits)) == len(plans)
    assert all(f'"A" ({d}) of the case' in entry[1] for d, entry in zip(digits, found, strict=True))


@pytest.mark.parametrize("has_teeth", [True, False])
def test_occlusion_follows_the_moves_of_the_page_as_in_python(has_teeth, tmp_path):
    """Also of jaws that are turned, of one that stays, and of bone that is in no segment."""
    head = cmfsim.make_head(cmfsim.HeadParameters(asymmetry=3.0))
    places = {name: np.asarray(place) for name, place in head.skull_landmarks.items()}
    if has_teeth:
        middle = 0.5 * (places["supradentale"] + places["infradentale"])
        for jaw, high in (("U", -1.0), ("L", 1.0)):
            for side, across in (("L", 1.0), ("R", -1.0)):
                places[f"{jaw}{side}1O"] = middle + [4 * across, -3 + high, high]
                places[f"{jaw}{side}6MB"] = middle + [24 * across, 30 - high, 3 + high]
    segments = ("mandible_body", "maxilla")
    sites = {}
    for name, place in places.items():
        upper = name[0] == "U" or name.startswith(("supradentale", "supra_m2"))
        lower = name[0] == "L" or name.startswith(("infradentale", "sub_m2", "chin"))
        part = "maxilla" if upper else "mandible_body" if lower else "skull"
        sites[name] = BoneSite(place, part)
    plans = [
        {},
        {"maxilla": cmfsim.rigid_motion((1, -4, 2), 5, (1, 2, 3), (0, -90, -30))},
        {
            "maxilla": cmfsim.rigid_motion((0, -6, 1), -3, (0, 1, 0), (5, -80, -30)),
            "mandible_body": cmfsim.rigid_motion((-3, 3, 0), 8, (0, 0, 1), (0, 0, 0)),
        },
    ]
    rows = [[plan.get(name, np.eye(4)).ravel().tolist() for name in segments] for plan in plans]
    found = answers(
        tmp_path,
        'import { measure } from "./measures.js";'
        f"const measures = {json.dumps(occlusal_measures(sites, segments, {}))};"
        f"console.log(JSON.stringify({json.dumps([*rows, None])}"
        ".map((m) => measure(measures, {}, m))));",
    )
    for plan, values in zip([*plans, {}], found, strict=True):
        moved = {
            name: plan[site.segment][:3, :3] @ site.place + plan[site.segment][:3, 3]
            if site.segment in plan
            else site.place
            for name, site in sites.items()
        }
        wanted = cmfsim.occlusion(moved, places)
        assert sum(value is not None for value in values) == (7 if has_teeth else 3)
        for measure, value in zip(cmfsim.OCCLUSAL_MEASURES, values, strict=True):
            assert value == pytest.approx(wanted[measure.key], abs=1e-6), measure.key
