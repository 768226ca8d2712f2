"""The browser that opens pages, where one is installed, and a page that must ask for nothing."""

import os
import shutil
import time
from pathlib import Path

import pytest

BROWSERS = ("chromium", "chromium-browser", "google-chrome")

READY = "globalThis.cmfsimPage?.timing.compute > 0"


@pytest.fixture(scope="module")
def browser():
    """Chromium."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    path = next(filter(None, map(shutil.which, BROWSERS)), None)
    if path is None:
        pytest.skip("no Chromium is installed (Debian: apt-get install chromium)")
    with playwright.sync_playwright() as driver:
        # Without its sandbox: tests may run as root, and open pages that they have made.
        chromium = driver.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield chromium
        chromium.close()


def open_page(browser, path):
    """Yields the page of a file; closing it checks that nothing went wrong."""
    # Small: pictures are drawn by software here.
    context = browser.new_context(viewport={"width": 920, "height": 420}, accept_downloads=True)
    page = context.new_page()
    page.set_default_timeout(20_000)
    troubles, asked = [], []
    page.on("pageerror", lambda error: troubles.append(str(error)))
    page.on("console", lambda line: troubles.append(line.text) if line.type == "error" else None)
    page.on("request", lambda request: asked.append(request.url))
    page.goto(path.as_uri())
    until(page, READY)
    yield page
    assert not troubles
    # Files that are saved are blobs of the page.
    assert [url for url in asked if not url.startswith("blob:")] == [path.as_uri()]
    context.close()


def axe_script():
    """The file of axe-core, wherever it would be."""
    placed = Path(__file__).parents[2] / "node_modules/axe-core/axe.min.js"
    return Path(os.environ.get("CMFSIM_AXE", placed))


def serious_faults(page):
    """Serious faults of accessibility that axe-core finds on a page; skips where it is absent."""
    script = axe_script()
    if not script.is_file():
        pytest.skip("axe-core is not installed: npm install --no-save axe-core, or CMFSIM_AXE")
    page.evaluate(script.read_text(encoding="utf-8"))
    found = page.evaluate("axe.run(document)")
    assert len(found["passes"]) > 10
    return [
        (fault["impact"], fault["id"], node["html"][:200])
        for fault in found["violations"]
        if fault["impact"] in {"serious", "critical"}
        for node in fault["nodes"]
    ]


def until(page, expression, seconds=20.0):
    """Waits for an expression to be true; the policy of the page allows no other way."""
    end = time.monotonic() + seconds
    while not page.evaluate(expression):
        assert time.monotonic() < end, expression
        page.wait_for_timeout(20)
