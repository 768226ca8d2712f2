"""A page in a browser, which must have no error and ask for nothing."""

import time

READY = "globalThis.cmfsimPage?.timing.compute > 0"


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


def until(page, expression, seconds=20.0):
    """Waits for an expression to be true; the policy of the page allows no other way."""
    end = time.monotonic() + seconds
    while not page.evaluate(expression):
        assert time.monotonic() < end, expression
        page.wait_for_timeout(20)
