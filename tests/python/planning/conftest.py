"""The browser that opens planning pages."""

from browser_page import browser

__all__ = ["browser"]
