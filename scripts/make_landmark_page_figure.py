"""Makes docs/figures/landmarks_page.png, the page of landmarks: make_landmark_page_figure.py.

Of the CT phantom (the folder named by CMFSIM_DATA; MIT licence, © 2022 Mark Gardner), with the
landmarks that are found on it; those of the chin are moved up and marked as doubtful, and two of
the left side are removed. Needs playwright and a Chromium.
"""

import dataclasses
import os
import shutil
import tempfile
from pathlib import Path

from playwright.sync_api import sync_playwright

import cmfsim
from cmfsim.pipeline.outputs.landmark_page import head_content, write_landmark_page
from cmfsim.pipeline.proposing import ProposedHead
from make_planning_figures import DRAWN, save

FIGURE = Path(__file__).parents[1] / "docs/figures/landmarks_page.png"
REMOVED = ("gonion_L", "zygomatic_arch_L")
DOUBTFUL = ("infradentale", "supramentale", "pogonion", "menton", "sub_m2_L", "sub_m2_R")
SHIFT = (0.0, 2.0, 9.0)


def main() -> None:
    """Writes a page, opens it and chooses a missing site."""
    data = Path(os.environ["CMFSIM_DATA"]) / "ct_phantom"
    bones = {name: cmfsim.read_surface(data / f"{name}.ply") for name in ("cranium", "mandible")}
    skin = cmfsim.read_surface(data / "skin.ply")
    found = cmfsim.propose_landmarks(bones, skin)
    skull = {name: site for name, site in found.skull.items() if name not in REMOVED}
    for name in DOUBTFUL:
        site = skull[name]
        skull[name] = dataclasses.replace(
            site, point=site.point + SHIFT, error=10.0, doubt="the incisors are 14 mm apart"
        )
    gone = dict.fromkeys(REMOVED, "the image ends there (left border)")
    found = dataclasses.replace(found, skull=skull, missing_skull=gone)
    head = ProposedHead(None, bones, skin, found)  # type: ignore[arg-type]  # is not used
    content = head_content("ct_phantom", head)
    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as driver:
        path = Path(folder) / "landmarks.html"
        write_landmark_page(path, content)
        chromium = driver.chromium.launch(executable_path=browser, args=["--no-sandbox"])
        page = chromium.new_page(viewport={"width": 1400, "height": 900}, reduced_motion="reduce")
        page.goto(path.as_uri())
        page.wait_for_timeout(DRAWN)
        page.get_by_role("button", name="Gonion, left").click()
        page.wait_for_timeout(DRAWN)
        save(page.screenshot(), FIGURE, smooth=False)
        chromium.close()


if __name__ == "__main__":
    main()
