"""The planning page: one HTML file in which bones are moved and the face follows."""

from cmfsim.planning_page.content import PageContent, page_content
from cmfsim.planning_page.page import PAGE_FILE, page_text, write_planning_page

__all__ = ["PAGE_FILE", "PageContent", "page_content", "page_text", "write_planning_page"]
