"""Reports of results: one self-contained page for a case or a study, on screen and on paper."""

from cmfsim.report.case import case_document, findings_of
from cmfsim.report.document import Document, Figure, Note, Section, Table, View
from cmfsim.report.page import render_page
from cmfsim.report.study import study_document

__all__ = [
    "Document",
    "Figure",
    "Note",
    "Section",
    "Table",
    "View",
    "case_document",
    "findings_of",
    "render_page",
    "study_document",
]
