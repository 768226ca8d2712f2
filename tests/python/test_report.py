"""A report is one page with everything inside, and no name of a stranger's becomes markup."""

import pytest

import cmfsim
from cmfsim.report import Document, Figure, Note, Section, Table, render_page
from cmfsim.report.document import number

pytest.importorskip("jinja2")

PNG = b"\x89PNG\r\n\x1a\n"


def test_text_is_escaped_everywhere():
    evil = "<img src=x onerror=alert(1)>"
    page = render_page(
        Document(
            evil,
            evil,
            {evil: evil},
            [
                Section(evil, (Note(evil), Table((evil, evil), ((evil, evil),), evil))),
                Section("figures", (Figure(PNG, evil), Figure(f"<svg>{evil}</svg>", evil))),
            ],
            evil,
        )
    )
    assert "<img src=x" not in page
    assert page.count("&lt;img src=x") >= 10
    assert page.count("data:image/png;base64,") == 1
    assert page.count("data:image/svg+xml;base64,") == 1


def test_a_page_needs_nothing_beside_it():
    page = render_page(Document("title", "subtitle"))
    assert "default-src 'none'" in page
    assert "<script" not in page
    assert "<link" not in page
    assert "not a medical device" in page


def test_rows_fit_their_head():
    with pytest.raises(cmfsim.CaseError, match="row 1 of a table has 1 cells"):
        Table(("a", "b"), (("1", "2"), ("3",)))


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "–"),
        (0.0, "0.00"),
        (1.234, "1.23"),
        (3e-9, "3.0e-09"),
        (-1e-5, "-1.0e-05"),
        ("a", "a"),
    ],
)
def test_numbers_never_pass_for_zero(value, text):
    assert number(value) == text
