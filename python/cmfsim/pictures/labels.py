"""Names of points in columns at the sides of a view, each joined to its point by a line."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cmfsim.pictures.canvas import LEGEND_ROW, LETTER, TEXT_SIZE, pyvista_module
from cmfsim.values.checks import Floats

# PyVista draws text of this size with letters twice as high, pixels.
LABEL_SIZE = 8
# From one line of text to the next, and from text to the edge of the view and to its line, pixels.
ROW = LEGEND_ROW * LABEL_SIZE / TEXT_SIZE
GAP = 6.0
LINE_COLOUR, DOT = "#333333", 7.0
# Points as close to the middle of a view, of its width, belong to neither side.
MIDDLE = 0.05
# Kept free for the caption of a view, pixels.
CAPTION = 40.0


@dataclass(frozen=True)
class Label:
    """A name, the point that it belongs to, mm, and its colour."""

    name: str
    place: Floats
    colour: str = "black"


@dataclass(frozen=True, eq=False)
class LabelPlaces:
    """Where names stand in a view, in pixels from its lower left corner.

    Attributes
    ----------
    left : (n,) bool
        Whether a name stands in the left column.
    lines : (n, 2) float64
        Where its line begins: the inner end of the text, at half its height.
    boxes : (n, 4) float64
        What its text may take: left, bottom, right, top.
    """

    left: Any
    lines: Floats
    boxes: Floats


def column_width(names: Sequence[str]) -> float:
    """The width that the longest of some names takes, with a gap at either side, pixels."""
    longest = max((len(name) for name in names), default=0)
    return longest * LETTER * LABEL_SIZE / TEXT_SIZE + 2.0 * GAP


def spread(heights: ArrayLike, gap: float, low: float, high: float) -> Floats:
    """Heights in the same order, at least `gap` apart, between two bounds.

    They have the least sum of squared distances from those given: with i·gap subtracted from the
    i-th from below, that is isotonic regression, by pooling adjacent violators (Barlow,
    Bartholomew, Bremner & Brunk 1972), cut at the bounds. Where there is no room for all, they
    stand closer than `gap`.

    Parameters
    ----------
    heights : (n,) float64
    gap, low, high : float

    Returns
    -------
    (n,) float64
    """
    given = np.asarray(heights, dtype=np.float64)
    count = len(given)
    if count > 1:
        gap = min(gap, (high - low) / (count - 1))
    order = np.argsort(given, kind="stable")
    steps = gap * np.arange(count)
    blocks: list[tuple[float, int]] = []
    for value in given[order] - steps:
        mean, size = float(value), 1
        while blocks and blocks[-1][0] > mean:
            other, more = blocks.pop()
            mean = (mean * size + other * more) / (size + more)
            size += more
        blocks.append((mean, size))
    pooled = np.concatenate([[], *(np.full(size, mean) for mean, size in blocks)])
    placed = np.empty(count)
    placed[order] = np.clip(pooled, low, max(high - gap * (count - 1), low)) + steps
    return placed


def label_places(points: ArrayLike, names: Sequence[str], size: tuple[float, float]) -> LabelPlaces:
    """Where the names of points stand: in the column that is closer, from the middle in turns.

    Parameters
    ----------
    points : (n, 2) float64
        In pixels from the lower left corner of the view.
    names : sequence of str
    size : (float, float)
        Of the view, pixels.
    """
    at = np.asarray(points, dtype=np.float64).reshape(-1, 2)
    width, height = size
    aside = at[:, 0] / width - 0.5
    left = aside < 0.0
    middle = np.flatnonzero(np.abs(aside) < MIDDLE)
    left[middle[np.argsort(-at[middle, 1], kind="stable")]] = np.arange(len(middle)) % 2 == 1
    lengths = np.array([column_width([name]) for name in names]).reshape(-1)
    lines, boxes = np.zeros((len(at), 2)), np.zeros((len(at), 4))
    for side in (True, False):
        mine = np.flatnonzero(left == side)
        heights = spread(at[mine, 1], ROW, CAPTION + 0.5 * ROW, height - 0.5 * ROW)
        column = lengths[mine].max(initial=0.0)
        inner = np.full(len(mine), column if side else width - column)
        low = inner - lengths[mine] if side else inner
        lines[mine] = np.column_stack([inner, heights])
        boxes[mine] = np.column_stack(
            [low, heights - 0.5 * ROW, low + lengths[mine], heights + 0.5 * ROW]
        )
    return LabelPlaces(left, lines, boxes)


def add_labels(plotter: Any, toward: Floats, labels: Sequence[Label]) -> None:
    """Adds names and lines to a view whose camera stands, in parallel projection.

    Parameters
    ----------
    plotter : pyvista.Plotter
    toward : (3,) float64
        The unit vector from the head to the camera.
    labels : sequence of Label
    """
    if not labels:
        return
    pv = pyvista_module()
    camera = plotter.camera
    low_x, low_y, high_x, high_y = plotter.renderer.GetViewport()
    width = (high_x - low_x) * plotter.window_size[0]
    height = (high_y - low_y) * plotter.window_size[1]
    scale = height / (2.0 * camera.parallel_scale)  # pixels per mm
    up = np.array([0.0, 0.0, 1.0])
    right = np.cross(up, toward)
    middle = np.array(camera.focal_point)
    places = np.array([label.place for label in labels])
    plane = (places - middle) @ np.column_stack([right, up]) * scale + (0.5 * width, 0.5 * height)
    found = label_places(plane, [label.name for label in labels], (width, height))
    # In front of everything: half the way to the camera.
    front = middle + 0.5 * (np.array(camera.position) - middle)
    shift = [0.5 * width, 0.5 * height]
    ends = [front + (xy - shift) / scale @ np.array([right, up]) for xy in (plane, found.lines)]
    corners = np.stack(ends, axis=1).reshape(-1, 3)
    cells = np.column_stack([np.full(len(labels), 2), np.arange(len(corners)).reshape(-1, 2)])
    lines = pv.PolyData(corners, lines=cells.ravel())
    plotter.add_mesh(lines, color=LINE_COLOUR, line_width=1.2, lighting=False)
    # A point behind the surface is seen nowhere else.
    plotter.add_points(ends[0], color=LINE_COLOUR, point_size=DOT, render_points_as_spheres=True)
    for label, left, (x, y) in zip(labels, found.left, found.lines, strict=True):
        text = plotter.add_text(
            label.name,
            position=((x - GAP if left else x + GAP) / width, y / height),
            viewport=True,
            font_size=LABEL_SIZE,
            color=label.colour,
        )
        style = text.GetTextProperty()
        style.SetVerticalJustificationToCentered()
        (style.SetJustificationToRight if left else style.SetJustificationToLeft)()
        style.SetBackgroundColor(1.0, 1.0, 1.0)
        style.SetBackgroundOpacity(0.6)
