"""Reports of results: one self-contained page for a case or a study, on screen and on paper."""

from cmfsim.report.case import case_document as case_document
from cmfsim.report.case import findings_of as findings_of
from cmfsim.report.document import Document as Document
from cmfsim.report.document import Figure as Figure
from cmfsim.report.document import Note as Note
from cmfsim.report.document import Section as Section
from cmfsim.report.document import View as View
from cmfsim.report.page import render_page as render_page
from cmfsim.report.study import study_document as study_document
from cmfsim.values.table import Table as Table
