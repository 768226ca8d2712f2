"""A report as one self-contained HTML page, for browsers and print; labels of its figures."""

import base64
import csv
import io
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from importlib.resources import files

from cmfsim.errors import third_party
from cmfsim.report.document import Document, Figure, View
from cmfsim.values.language import language, translated

# How a distance between skins was measured, by the method of `compare_skins`.
MEASURES: Mapping[str, str] = {
    "landmarks": "from the corresponding point given by a spline through the skin landmarks, as "
    "in the paper",
    "closest": "from the closest point, which ignores skin that slid along itself: smaller than "
    "through landmarks",
}

# Label and factor of each figure, by its key in the summary: mm³ become cm³, shares percent.
Labels = Mapping[str, tuple[str, float]]


def _labels(summary: str) -> Labels:
    text = files("cmfsim.report").joinpath("labels.csv").read_text(encoding="utf-8")
    rows = [row for row in csv.DictReader(text.splitlines()) if row["summary"] == summary]
    return {row["key"]: (row["label"], float(row["factor"])) for row in rows}


MESH, MUSCLES = _labels("mesh"), _labels("muscles")


def labelled(values: Mapping[str, object], labels: Labels) -> dict[str, object]:
    """Numbers and names of a summary by label, in the order of the labels; others by key."""
    out: dict[str, object] = {}
    keys = [*(k for k in labels if k in values), *(k for k in values if k not in labels)]
    for key in keys:
        value = values[key]
        label, factor = labels.get(key, (key.replace("_", " "), 1))
        if isinstance(value, str | bool) or (isinstance(value, int) and factor == 1):
            out[label] = value
        elif isinstance(value, int | float):
            out[label] = value * factor
    return out


# Of WebP, out of 100: letters and shades of a picture look as they do in its PNG.
QUALITY = 88
# From 0 to 6: its usual 4 takes more than twice as long for files that are 4 % smaller.
WEBP_EFFORT = 2
DISCLAIMER = "Research software, not a medical device. Not for diagnosis or treatment decisions."


def render_page(document: Document) -> str:
    """The page of a report: all text escaped, pictures inside, no addresses.

    It has no script but that of its view, which is allowed by its hash.
    """
    jinja2 = third_party("jinja2", "reports are made", "report")
    environment = jinja2.Environment(
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        finalize=lambda value: translated(value) if type(value) is str else value,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    text = files("cmfsim.report").joinpath("page.html").read_text(encoding="utf-8")
    blocks = [block for section in document.sections for block in section.blocks]
    figures = [block for block in blocks if isinstance(block, Figure)]
    # Two pictures at a time: to make them small takes longer than the page.
    with ThreadPoolExecutor(2) as pool:
        addresses = dict(zip(map(id, figures), pool.map(_address, figures), strict=True))
    environment.globals.update(
        kind_of=lambda block: type(block).__name__, address=lambda figure: addresses[id(figure)]
    )
    page: str = environment.from_string(text).render(
        document=document,
        disclaimer=DISCLAIMER,
        language=language(),
        scripts=[block.script for block in blocks if isinstance(block, View)],
    )
    return page


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
        # Else Pillow loads its readers and writers of all formats.
        import_module("PIL.WebPImagePlugin")
        import_module("PIL.Image").open(io.BytesIO(png)).save(
            packed, "WEBP", quality=QUALITY, method=WEBP_EFFORT
        )
    except (ImportError, OSError):
        return png, "png"
    return packed.getvalue(), "webp"


def whose(prediction: Mapping[str, object]) -> str:
    """Whose face was predicted, and when, as sentences; empty parts are left out."""
    patient, date = prediction.get("patient"), prediction.get("written_at")
    texts = (f"Predicted {date}." if date else "", f"Patient: {patient}." if patient else "")
    return "".join(f"{translated(text)} " for text in texts if text)


def plan_name(prediction: Mapping[str, object]) -> str:
    """What the planning page and a saved plan call the plan: its digits, as a sentence."""
    digits = prediction.get("plan_digits")
    return f"{translated('Plan')} {digits}. " if digits else ""
