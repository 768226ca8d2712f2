"""The planning page: one HTML file in which bones are moved and the face follows."""

from cmfsim.planning.page.arrays import PageContent as PageContent
from cmfsim.planning.page.content import page_content as page_content
from cmfsim.planning.page.document import page_text as page_text
from cmfsim.planning.page.row_overlap import row_overlap as row_overlap
