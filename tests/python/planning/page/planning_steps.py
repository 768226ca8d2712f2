"""What a test does on the planning page, and what it finds there."""

import numpy as np

from browser_page import until


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
