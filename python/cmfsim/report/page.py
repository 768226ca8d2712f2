"""A report as one self-contained HTML page, for browsers and for print."""

import base64
import io
from importlib import import_module
from importlib.resources import files

from cmfsim.errors import third_party
from cmfsim.report.document import Document, Figure, Note, Table, View

# Of WebP, out of 100: letters and shades of a picture look as they do in its PNG.
QUALITY = 88
DISCLAIMER = "Research software, not a medical device. Not for diagnosis or treatment decisions."


def render_page(document: Document) -> str:
    """The page of a report: all text escaped, pictures inside, no addresses.

    It has no script but that of its view, which is allowed by its hash.

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
    blocks = [block for section in document.sections for block in section.blocks]
    page: str = environment.from_string(text).render(
        document=document,
        disclaimer=DISCLAIMER,
        scripts=[block.script for block in blocks if isinstance(block, View)],
    )
    return page


def _kind(block: Note | Table | Figure | View) -> str:
    return type(block).__name__


def _address(figure: Figure) -> str:
    """The picture as a data address."""
    if isinstance(figure.image, str):
        data, kind = figure.image.encode(), "svg+xml"
    else:
        data, kind = _compact(figure.image)
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"


def _compact(png: bytes) -> tuple[bytes, str]:
    """A picture as WebP, an eighth of the PNG; as it is without Pillow, which matplotlib brings."""
    packed = io.BytesIO()
    try:
        import_module("PIL.Image").open(io.BytesIO(png)).save(packed, "WEBP", quality=QUALITY)
    except (ImportError, OSError):
        return png, "png"
    return packed.getvalue(), "webp"
