"""A session on the planning page in stills: make_planning_figures.py PLAN.HTML [OUT].

PLAN.HTML is what `cmfsim plan` writes for the embedded case (`cmfsim demo`): Le Fort I and
sagittal split. Two variants are planned, one by numbers and one by pulling the chin, and one is
chosen by its profile. Prints how long the steps took. Needs playwright and a Chromium.
"""

import io
import shutil
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from PIL import Image
from playwright.sync_api import sync_playwright

WIDTH, COLOURS = 1080, 256
# What a picture of the page waits for, ms: software rendering is slow.
DRAWN = 1500
# How far the chin is pulled back and up, pixels of the picture.
PULLED = (-7, -4)


def main(page_file: Path, out: Path) -> None:
    """Plans and chooses as a planner would, with a still after each part."""
    out.mkdir(parents=True, exist_ok=True)
    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
    with sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=browser, args=["--no-sandbox"])
        page = chromium.new_page(viewport={"width": 1440, "height": 900}, accept_downloads=True)
        page.goto(page_file.resolve().as_uri())
        page.wait_for_timeout(DRAWN)
        spent = 0.0
        for name, part in PARTS.items():
            begun = time.perf_counter()
            part(page)
            spent += time.perf_counter() - begun
            page.wait_for_timeout(DRAWN)
            save(page.screenshot(), out / f"{name}.png")
        print(f"{spent:.1f} s for the steps, without the pauses before pictures")
        chromium.close()


def opened(page: Any) -> None:
    """The case's own plan, bones seen through the skin."""
    page.locator("#show-skin").fill("0.6")


def first_variant(page: Any) -> None:
    """A variant by numbers: more setback, seen in profile."""
    page.get_by_role("button", name="Copy to a new variant").click()
    rename(page, "Setback 6")
    page.get_by_role("tab", name="mandible body").click()
    page.locator("#number-forwards").fill("-6")
    page.locator("#number-forwards").press("Enter")
    page.get_by_role("button", name="Right profile", exact=True).click()
    top(page)


def second_variant(page: Any) -> None:
    """A variant by the face: the chin is pulled back and up, and the mandible follows."""
    page.get_by_role("button", name="New from the case's plan").click()
    rename(page, "Chin pulled")
    page.locator("#show-skin").fill("1")
    page.locator("#show-pull").check()
    maxilla = page.evaluate("cmfsimPage.page.segments.findIndex((s) => s.name === 'maxilla')")
    page.locator(f"#follows-{maxilla}").uncheck()
    top(page)
    box = page.locator("#overlay").bounding_box()
    x, y = page.evaluate(
        """() => {
          const { face, camera, overlay, motions } = cmfsimPage;
          const [px, py, pz] = face.sitePlaces(motions).pogonion;
          return camera.project([px, py + 1, pz], overlay.clientWidth, overlay.clientHeight);
        }"""
    )
    page.mouse.move(box["x"] + x, box["y"] + y)
    page.mouse.down()
    page.mouse.move(box["x"] + x + PULLED[0], box["y"] + y + PULLED[1], steps=12)
    page.mouse.up()


def compared(page: Any) -> None:
    """Before and after side by side, with the movement of the skin in colours."""
    page.locator("#show-pull").uncheck()
    page.get_by_role("button", name="Three-quarter", exact=True).click()
    page.locator("#show-map").check()
    page.locator("#show-side").check()
    page.locator("#differences").scroll_into_view_if_needed()


def chosen(page: Any) -> None:
    """One is chosen by its profile and saved."""
    page.locator("#show-map").uncheck()
    page.locator("#show-side").uncheck()
    page.get_by_role("button", name="Right profile", exact=True).click()
    page.get_by_role("button", name="Setback 6", exact=True).click()
    with page.expect_download():
        page.locator("#save-plan").click()
    page.locator("canvas.profile").scroll_into_view_if_needed()
    page.mouse.wheel(0, 250)


PARTS: dict[str, Callable[[Any], None]] = {
    "planning_open": opened,
    "planning_page": first_variant,
    "planning_pull": second_variant,
    "planning_page_movement": compared,
    "planning_choice": chosen,
}


def rename(page: Any, name: str) -> None:
    """Gives the active variant a name."""
    page.locator("#variant-name").fill(name)
    page.locator("#variant-name").press("Enter")


def top(page: Any) -> None:
    """The picture and the numbers of the plan in sight."""
    page.evaluate("scrollTo(0, 0)")


def save(data: bytes, path: Path, *, smooth: bool = True) -> None:
    """A picture of the width of a page, in few colours; smooth ones are mixed of dots."""
    image = Image.open(io.BytesIO(data)).convert("RGB")
    height = round(image.height * WIDTH / image.width)
    small = image.resize((WIDTH, height), Image.Resampling.LANCZOS)
    if smooth:
        few = small.quantize(COLOURS, dither=Image.Dither.FLOYDSTEINBERG)
    else:
        few = small.quantize(COLOURS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    few.save(path, optimize=True)
    print(f"{path.name} {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    figures = Path(__file__).parents[1] / "docs/figures"
    main(Path(sys.argv[1]), Path(sys.argv[2]) if len(sys.argv) > 2 else figures)
