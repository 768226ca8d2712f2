"""Scripts of the planning page that need no browser, run by Node."""

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import cmfsim
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
