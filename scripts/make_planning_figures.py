"""Pictures of the planning page for the documentation: make_planning_figures.py PLAN.HTML [OUT].

PLAN.HTML is what `cmfsim plan` writes for the embedded case (`cmfsim demo`). Needs playwright and a
Chromium.
"""

import io
import shutil
import sys
from pathlib import Path
from typing import Any

from PIL import Image
from playwright.sync_api import sync_playwright

WIDTH, COLOURS = 1080, 256


def main(page_file: Path, out: Path) -> None:
    """Draws a variant in profile, and its movement next to the face before."""
    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
    with sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=browser, args=["--no-sandbox"])
        page = chromium.new_page(viewport={"width": 1440, "height": 900})
        page.goto(page_file.resolve().as_uri())
        page.get_by_role("button", name="Copy to a new variant").click()
        page.locator("#number-forwards").fill("-6")
        page.locator("#number-forwards").press("Enter")
        page.get_by_role("button", name="Profile", exact=True).click()
        page.locator("#show-skin").fill("0.5")
        page.evaluate("scrollTo(0, 0)")
        page.wait_for_timeout(2000)
        save(page.screenshot(), out / "planning_page.png")
        page.get_by_role("button", name="Three-quarter", exact=True).click()
        page.locator("#show-skin").fill("1")
        page.locator("#show-map").check()
        page.locator("#show-side").check()
        page.wait_for_timeout(2000)
        picture: Any = page.locator("#picture")
        save(picture.screenshot(), out / "planning_page_movement.png")
        chromium.close()


def save(data: bytes, path: Path) -> None:
    """A picture of the width of a page, in few colours."""
    image = Image.open(io.BytesIO(data)).convert("RGB")
    height = round(image.height * WIDTH / image.width)
    small = image.resize((WIDTH, height), Image.Resampling.LANCZOS)
    small.quantize(COLOURS, dither=Image.Dither.FLOYDSTEINBERG).save(path, optimize=True)


if __name__ == "__main__":
    figures = Path(__file__).parents[1] / "docs/figures"
    main(Path(sys.argv[1]), Path(sys.argv[2]) if len(sys.argv) > 2 else figures)
