"""A report as one self-contained HTML page, for browsers and for print."""

import base64
from importlib.resources import files

from cmfsim.errors import third_party
from cmfsim.report.document import Document, Figure, Note, Table

DISCLAIMER = "Research software, not a medical device. Not for diagnosis or treatment decisions."


def render_page(document: Document) -> str:
    """The page of a report: all text escaped, pictures inside, no scripts, no addresses.

    Raises
    ------
    CaseError
        (also `ValueError`) Jinja2, of the extra `report`, is not installed.
    """
    jinja2 = third_party("jinja2", "reports are made", "report")
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.globals.update(kind_of=_kind, address=_address)
    text = files("cmfsim.report").joinpath("page.html").read_text(encoding="utf-8")
    page: str = environment.from_string(text).render(document=document, disclaimer=DISCLAIMER)
    return page


def _kind(block: Note | Table | Figure) -> str:
    return type(block).__name__


def _address(figure: Figure) -> str:
    """The picture as a data address."""
    if isinstance(figure.image, str):
        data, kind = figure.image.encode(), "svg+xml"
    else:
        data, kind = figure.image, "png"
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
