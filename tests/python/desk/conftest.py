"""The browser that opens the desk."""

from browser_page import browser

__all__ = ["browser"]
