"""The planning page: one HTML file in which bones are moved and the face follows."""

from cmfsim.planning.page.content import PageContent, page_content
from cmfsim.planning.page.page import page_text
from cmfsim.planning.page.tooth_rows import tooth_rows

__all__ = ["PageContent", "page_content", "page_text", "tooth_rows"]
