"""The planning page: one HTML file in which bones are moved and the face follows."""

from cmfsim.planning.page.content import PageContent, page_content
from cmfsim.planning.page.page import PAGE_FILE, page_state, page_text, write_planning_page
from cmfsim.planning.page.tooth_rows import ToothRows, tooth_rows

__all__ = [
    "PAGE_FILE",
    "PageContent",
    "ToothRows",
    "page_content",
    "page_state",
    "page_text",
    "tooth_rows",
    "write_planning_page",
]
