"""A report as one self-contained HTML page, for browsers and print; labels of its figures."""

import base64
import io
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from importlib.resources import files

from cmfsim.errors import third_party
from cmfsim.report.document import Document, Figure, Note, View
from cmfsim.values.language import language, translated
from cmfsim.values.table import Table

# How a distance between skins was measured, by the method of `compare_skins`.
MEASURES: Mapping[str, str] = {
    "landmarks": "from the corresponding point given by a spline through the skin landmarks, as "
    "in the paper",
    "closest": "from the closest point, which ignores skin that slid along itself: smaller than "
    "through landmarks",
}

# mm³ in a cm³, and one in a hundred.
CUBIC, PERCENT = 1e-3, 100.0

# Label and factor of each figure, by its key in the summary.
Labels = Mapping[str, tuple[str, float]]

MESH: Labels = {
    "n_nodes": ("nodes", 1),
    "n_tets": ("tets", 1),
    "mean_edge": ("mean edge, mm", 1.0),
    "volume": ("volume, cm³", CUBIC),
    "volume_error": ("volume relative to the tissue, %", PERCENT),
    "boundary_error_mean": ("mean distance from the surface, mm", 1.0),
    "boundary_error_max": ("largest distance from the surface, mm", 1.0),
    "min_dihedral": ("smallest dihedral angle, °", 1.0),
    "max_dihedral": ("largest dihedral angle, °", 1.0),
    "edge_ratio": ("longest over shortest edge of the worst tet", 1.0),
    "dropped_parts": ("removed bodies (too small)", 1),
    "dropped_volume": ("volume of removed bodies, cm³", CUBIC),
    "dropped_tets": ("poor tets removed at the surface", 1),
}
MUSCLES: Labels = {
    "template": ("template", 1),
    "smoothing": ("smoothing of the spline", 1.0),
    "blur": ("blur of the shares of muscle, mm", 1.0),
    "preset": ("constants of fat and muscle", 1),
    "mixing": ("quantity mixed in a tet", 1),
    "inside": ("inside test", 1),
    "muscles": ("muscles", 1),
    "muscle_volume": ("volume of all muscles in the tissue, cm³", CUBIC),
    "muscle_tets": ("tets that contain muscle", 1),
    "pairs": ("pairs of tet and muscle checked", 1),
    "crossed": ("tets that a muscle's surface crosses", 1),
    "samples": ("points in each of these", 1),
    "samples_per_crossed_tet": ("points in each of these", 1),
    "points": ("points in total", 1),
    "seed": ("random seed of the points", 1),
}


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

    Raises `CaseError`: Jinja2, of the extra `report`, is not installed.
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
    environment.globals.update(kind_of=_kind, address=lambda figure: addresses[id(figure)])
    page: str = environment.from_string(text).render(
        document=document,
        disclaimer=DISCLAIMER,
        language=language(),
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
