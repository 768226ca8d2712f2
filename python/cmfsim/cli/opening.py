"""A page that is opened in the browser, where there is a screen and a person at it."""

import os
import sys
import webbrowser
from pathlib import Path

from cmfsim.pictures import has_screen


def can_open() -> bool:
    """Whether a person works at a screen."""
    return sys.stdout.isatty() and not os.environ.get("CI") and has_screen()


def open_page(path: Path, *, wanted: bool = True) -> None:
    """Opens a file in the browser if it is wanted and somebody is there."""
    if wanted and can_open():
        webbrowser.open(path.resolve().as_uri())
