"""One page for the patient's chart: plan, pictures, measures, band, warnings, versions, hashes.

Every text has a largest width and number of lines; what does not fit is replaced by a reference to
the report, so that nothing overlaps and nothing is cut. Lengths are points from the top left.
"""

import io
from collections.abc import Mapping, Sequence
from typing import Any

from cmfsim.errors import third_party
from cmfsim.report.clinical import TITLES, WAYS, absent_text, measure_rows, site_rows
from cmfsim.report.page import DISCLAIMER, plan_name, whose
from cmfsim.values.clinical_motion import plan_lines
from cmfsim.values.finding import Finding, grouped
from cmfsim.values.language import translated

Values = Mapping[str, Any]

# A4, inches; the same in points, with the margin and the widths of two columns.
A4 = (8.27, 11.69)
WIDTH, HEIGHT, MARGIN, LEFT, RIGHT = 595.0, 842.0, 36.0, 285.0, 224.0
COLUMN = WIDTH - MARGIN - RIGHT
WHOLE = WIDTH - 2 * MARGIN
# Font sizes, and the distance between lines as a multiple of them. A text that is too wide is
# shrunk to the least size or this share before it is shortened.
TITLE, TEXT, SMALL, FINE, LEAST, SHRINK, LEADING = 15.0, 8.0, 6.5, 5.5, 4.5, 0.65, 1.3
# Heights of a row of a table, of a heading, of the gap between parts, at most of pictures, and at
# least of the bones.
ROW, HEADING, APART, PICTURES, BONES = LEADING * SMALL + 1.0, 17.0, 8.0, 220.0, 75.0
# Largest numbers of lines, and digits of the hashes of inputs.
PLAN_LINES, ABSENT_LINES, BAND_ROWS, WARNING_LINES, INPUT_LINES, DIGITS = 7, 4, 11, 8, 3, 12
# Where versions and hashes begin.
FOOT = HEIGHT - MARGIN - (INPUT_LINES + 2) * LEADING * FINE
INK, PALE, RULE, ALARM = "#1d2530", "#5d6875", "#d5dbe2", "#c2410c"
# Shares of the columns in the width of a table of measures.
SHARES: Mapping[str, tuple[float, ...]] = {
    "cephalometry": (0.29, 0.11, 0.125, 0.115, 0.36),
    "face": (0.37, 0.15, 0.17, 0.15, 0.16),
}
# Landmarks at teeth, chin and lips.
SITES = (
    *("U1", "L1", "mid_philtrum", "supradentale", "infradentale", "supramentale", "pogonion"),
    *(f"{n} (skin)" for n in ("pronasale", "subnasale", "labiale_superius", "labiale_inferius")),
    "pogonion (skin)",
)
# Notes that the page states as well: its measures are those of points that nobody placed.
UNPLACED = ("landmarks-proposed", "landmarks-filled")
WIDTHS = ("half_width_mean_mm", "half_width_p95_mm", "half_width_largest_mm")
ELSEWHERE = "… more in report.html"


class _Page:
    """A figure on which texts, tables and pictures are placed."""

    def __init__(self, figure: Any) -> None:
        self._figure = figure
        self._path = third_party("matplotlib.textpath", "pages are drawn", "report").text_to_path
        self._fonts = third_party("matplotlib.font_manager", "pages are drawn", "report")
        figure.set_layout_engine("none")
        self._axes = figure.add_axes((0, 0, 1, 1), xlim=(0, WIDTH), ylim=(HEIGHT, 0))
        self._axes.axis("off")

    def _width(self, text: str, size: float, weight: str = "normal") -> float:
        font = self._fonts.FontProperties(size=size, weight=weight)
        return float(self._path.get_text_width_height_descent(text, font, ismath=False)[0])

    def line(self, x: float, y: float, text: str, size: float, **style: Any) -> None:
        """Writes one line in the reader's language."""
        self._write(x, y, translated(text), size, **style)

    def _write(
        self, x: float, y: float, text: str, size: float, *, room: float = WHOLE, **style: Any
    ) -> None:
        """Writes one line with its top at y, smaller or shortened where it is too wide."""
        text, weight = " ".join(text.split()), style.get("weight", "normal")
        width = self._width(text, size, weight)
        if width > room:
            size = max(LEAST, SHRINK * size, 0.98 * size * room / width)
            if (width := self._width(text, size, weight)) > room:
                text = text[: int(1.3 * len(text) * room / width)]
                while self._width(f"{text}…", size, weight) > room:
                    text = text[:-1]
                text += "…"
        # A user's name may hold dollar signs: nothing of it is mathematics.
        style = {"color": INK, "va": "top", "parse_math": False, **style}
        self._axes.text(x, y, text, size=size, **style)

    def paragraph(
        self, place: tuple[float, float], texts: Sequence[str], size: float, most: int,
        room: float = WHOLE,
    ) -> float:  # fmt: skip
        """Writes texts, each wrapped, in at most so many lines; where the last one ends."""
        lines: list[str] = []
        for text in texts:
            lines.append("")
            for word in translated(text).split():
                longer = f"{lines[-1]} {word}".strip()
                if lines[-1] and self._width(longer, size) > room:
                    lines.append(word)
                else:
                    lines[-1] = longer
        x, y = place
        for line in lines if len(lines) <= most else [*lines[: most - 1], translated(ELSEWHERE)]:
            self._write(x, y, line, size, room=room)
            y += LEADING * size
        return y

    def heading(self, x: float, y: float, text: str, room: float = WHOLE) -> float:
        """Writes a heading over a rule; where what follows begins."""
        self.line(x, y, text, TEXT + 1.0, room=room, weight="bold")
        self._axes.plot([x, x + room], [y + 13.0] * 2, color=RULE, linewidth=0.8)
        return y + HEADING

    def table(
        self, x: float, y: float, rows: Sequence[Sequence[str]], widths: Sequence[float]
    ) -> float:
        """Writes a table with the first row as its head; where it ends."""
        for row in rows:
            weight, end = "bold" if row is rows[0] else "normal", x
            for cell, width in zip(row, widths, strict=True):
                place, side = (end + width, "right") if end > x else (x, "left")
                self.line(place, y, cell, SMALL, room=width - 4.0, ha=side, weight=weight)
                end += width
            y += ROW
        return y

    def picture(
        self, x: float, y: float, image: bytes, room: tuple[float, float], share: float = 1.0
    ) -> float:
        """Draws this share of a PNG, from its right, as large as there is room; where it ends."""
        images = third_party("matplotlib.image", "pages are drawn", "report")
        pixels = images.imread(io.BytesIO(image), format="png")
        pixels = pixels[:, round((1.0 - share) * pixels.shape[1]) :]
        scale = min(room[0] / pixels.shape[1], room[1] / pixels.shape[0])
        wide, high = scale * pixels.shape[1] / WIDTH, scale * pixels.shape[0] / HEIGHT
        axes = self._figure.add_axes((x / WIDTH, 1.0 - y / HEIGHT - high, wide, high))
        axes.imshow(pixels, aspect="auto", cmap="gray")
        axes.axis("off")
        return float(y + high * HEIGHT)


def draw_chart_page(
    figure: Any, prediction: Values, pictures: Mapping[str, bytes], findings: Sequence[Finding]
) -> None:
    """Draws the page of one plan (`prediction.json`) onto an empty figure of the size `A4`.

    Pictures are PNG files, "prediction", "lateral" and "plan", which stands below the others.
    """
    page, y = _Page(figure), MARGIN
    page.line(MARGIN, y, f"{prediction['case']}: predicted face", TITLE, weight="bold")
    page.line(MARGIN, y + 21.0, DISCLAIMER, TEXT, weight="bold", color=ALARM)
    skin = f"Lengths in mm. The skin moves by up to {prediction['skin']['largest']:.1f} mm."
    about = f"Model {prediction['model']}. {plan_name(prediction)}{translated(skin)}"
    page.line(MARGIN, y + 33.0, whose(prediction), TEXT)
    page.line(MARGIN, y + 45.0, about, TEXT, color=PALE)
    y = page.heading(MARGIN, y + 60.0, "Plan")
    words = plan_lines({name: m["clinical"] for name, m in prediction["plan"].items()})
    y = page.paragraph((MARGIN, y), words, TEXT, PLAN_LINES) + APART
    found = prediction.get("clinical", {"cephalometry": (), "face": (), "sites": ()})
    high = min(PICTURES, FOOT - APART - _height_below(found, prediction.get("band")) - y)
    # The panel of the tracing that shows both; results of earlier versions have none.
    beside = ("lateral", 0.5) if "lateral" in pictures else ("plan", 1.0)
    ends = [
        page.picture(x, y, pictures[name], (room, high), share)
        for (name, share), x, room in ((("prediction", 1.0), MARGIN, LEFT), (beside, COLUMN, RIGHT))
        if name in pictures
    ]
    y = max([y, *ends]) + APART
    ends = []
    for kind, x, room in (("cephalometry", MARGIN, LEFT), ("face", COLUMN, RIGHT)):
        kinds = [kind, "occlusion"] if kind == "cephalometry" else [kind]
        end = page.heading(x, y, ", ".join(translated(TITLES[name]) for name in kinds), room)
        rows = [row[:5] for name in kinds for row in measure_rows(found, name)]
        rows.insert(0, ("", "before", "planned", "change", "norm"))
        end = page.table(x, end, rows, [share * room for share in SHARES[kind]])
        absent = "; ".join(filter(None, (absent_text(found, name) for name in kinds)))
        texts = [f"Not available: {absent}"] if absent else []
        ends.append(page.paragraph((x, end), texts, FINE, ABSENT_LINES, room))
    y = max(ends) + APART
    ends = [_sites(page, y, found), _band(page, y, prediction.get("band"))]
    if "plan" in pictures and "lateral" in pictures:
        # The bones from the front as well, in what is left below the band.
        top = page.heading(COLUMN, ends[1] + APART, "Bones as planned", RIGHT)
        page.picture(COLUMN, top, pictures["plan"], (RIGHT, FOOT - top))
        room = LEFT
    else:
        ends, room = [max(ends)], WHOLE
    y = page.heading(MARGIN, ends[0] + APART, "Warnings", room)
    found_sites = [finding for finding in findings if finding.code in UNPLACED]
    warnings = [finding for finding in findings if finding.severity != "note"]
    groups = [*grouped(found_sites), *grouped(warnings)]
    lines = [f"{translated(group.severity)}: {group.text(translated)}" for group in groups] or [
        "None."
    ]
    most = int((FOOT - y) / (LEADING * SMALL))
    page.paragraph((MARGIN, y), lines, SMALL, most, room)
    _origin(page, prediction)


def _height_below(found: Values, band: Values | None) -> float:
    """The largest height of all between the pictures and the foot of the page."""
    rows = {kind: len(measure_rows(found, kind)) for kind in TITLES}
    measures = max(rows["cephalometry"] + rows["occlusion"], rows["face"])
    sites = sum(row[0] in SITES for row in site_rows(found)) + 1
    widths = 1 if band is None else 2 + min(len(band["regions"]), BAND_ROWS)
    left, right = sites * ROW + LEADING * WARNING_LINES * SMALL, widths * ROW + BONES
    texts = (measures + 1) * ROW + LEADING * ABSENT_LINES * FINE
    return 3 * HEADING + 2 * APART + texts + max(left, right)


def _sites(page: _Page, y: float, found: Values) -> float:
    y = page.heading(MARGIN, y, "Movement of landmarks", LEFT)
    moved = {row[0]: (row[0], *row[2:]) for row in site_rows(found)}
    rows = [("", *WAYS, "distance"), *(moved[name] for name in SITES if name in moved)]
    return page.table(MARGIN, y, rows, [0.4 * LEFT, *[0.15 * LEFT] * 4])


def _band(page: _Page, y: float, band: Values | None) -> float:
    y = page.heading(COLUMN, y, "How far to trust the face", RIGHT)
    if band is None:
        text = "No band was requested (cmfsim predict --band)."
        return page.paragraph((COLUMN, y), [text], SMALL, 2, RIGHT)
    state = f"{band['state'].upper()}, {100 * band['coverage']:g} % of faces. Half width:"
    y = page.paragraph((COLUMN, y), [state], SMALL, 2, RIGHT)
    rows: list[tuple[str, ...]] = [("", "mean", "95 %", "largest")]
    for name, entry in [*band["regions"].items()][:BAND_ROWS]:
        rows.append((name, *(f"{entry[key]:.1f}" for key in WIDTHS)))
    return page.table(COLUMN, y, rows, [0.4 * RIGHT, *[0.2 * RIGHT] * 3])


def _origin(page: _Page, prediction: Values) -> None:
    """Versions and hashes at the foot of the page."""
    versions = ", ".join(f"{name} {version}" for name, version in prediction["versions"].items())
    inputs = "; ".join(f"{name} {value[:DIGITS]}" for name, value in prediction["inputs"].items())
    key = f"Plan, inputs and version: SHA-256 {prediction['case_key']}."
    for number, text in enumerate((f"Made by {versions}.", key)):
        page.line(MARGIN, FOOT + number * LEADING * FINE, text, FINE)
    about = translated(f"Inputs (first {DIGITS} digits of SHA-256):")
    texts = [f"{about} {inputs}."] if inputs else []
    page.paragraph((MARGIN, FOOT + 2 * LEADING * FINE), texts, FINE, INPUT_LINES)
