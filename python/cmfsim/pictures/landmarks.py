"""A picture of the landmarks of skull and skin, with their names in columns at its sides."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cmfsim.errors import CaseInputError
from cmfsim.pictures import canvas
from cmfsim.pictures.anatomy import SKIN_COLOUR
from cmfsim.values.anatomy import segment_colours
from cmfsim.values.checks import AnyPath, Floats, check_one_of
from cmfsim.values.surface_data import SurfaceData

# PyVista draws text of this size with letters twice as high, pixels.
LABEL_SIZE = 8
# From one line of text to the next, and from text to the edge of the view and to its line, pixels.
ROW = canvas.LEGEND_ROW * LABEL_SIZE / canvas.TEXT_SIZE
GAP = 6.0
LINE_COLOUR, DOT = "#333333", 7.0
# Points as close to the middle of a view, of its width, belong to neither side.
MIDDLE = 0.05
# Kept free for the caption of a view, pixels.
CAPTION = 40.0

# Of a view, pixels.
VIEW_SIZE = (700, 700)
SURE_COLOUR, DOUBTFUL_COLOUR = "#1f4fd8", "#d62728"
# Radius of a point, mm; a doubtful one is a cube of that half edge.
RADIUS = 2.0
# What is drawn above and below the points and beside them, mm, and how far points stand in front of
# the surface.
ROOM, BESIDE, LIFT = 22.0, 6.0, 2.5
# Of a view's width that the head has at least, however long the names.
LEAST_SHARE = 0.3
VIEWS: Mapping[str, tuple[float, float, float]] = MappingProxyType(
    {"front": (0.0, -1.0, 0.0), "left": (1.0, 0.0, 0.0), "right": (-1.0, 0.0, 0.0)}
)


@dataclass(frozen=True)
class Label:
    """A name, the point that it belongs to, mm, and its colour."""

    name: str
    place: Floats
    colour: str = "black"


@dataclass(frozen=True, eq=False)
class LabelPlaces:
    """Where names stand in a view, in pixels from its lower left corner.

    left, lines: (n,), whether a name stands in the left column; (n, 2), where its line begins: the
        inner end of the text, at half its height.
    boxes: (n, 4). What its text may take: left, bottom, right, top.
    """

    left: Any
    lines: Floats
    boxes: Floats


def column_width(names: Sequence[str]) -> float:
    """The width that the longest of some names takes, with a gap at either side, pixels."""
    longest = max((len(name) for name in names), default=0)
    return longest * canvas.LETTER * LABEL_SIZE / canvas.TEXT_SIZE + 2.0 * GAP


def spread(heights: ArrayLike, gap: float, low: float, high: float) -> Floats:
    """Heights (n,) in the same order, at least `gap` apart, between two bounds.

    They have the least sum of squared distances from those given: with i·gap subtracted from the
    i-th from below, that is isotonic regression, by pooling adjacent violators (Barlow,
    Bartholomew, Bremner & Brunk 1972), cut at the bounds. Where there is no room for all, they
    stand closer than `gap`.
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
    """Where the names of points (n, 2) stand: in the closer column, from the middle in turns.

    Both the points and the size of the view are pixels, from its lower left corner.
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
    """Adds names and lines to a view, with the unit vector (3,) from the head to the camera."""
    if not labels:
        return
    pv = canvas.pyvista_module()
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


def picture_landmarks(
    path: AnyPath,
    bones: Mapping[str, SurfaceData],
    skin: SurfaceData | None,
    landmarks: Mapping[str, Mapping[str, ArrayLike]],
    *,
    doubtful: Mapping[str, Sequence[str]] | None = None,
    views: Sequence[str] = tuple(VIEWS),
    size: tuple[int, int] | None = None,
) -> None:
    """Writes a picture of landmarks with their names: skull above, skin below, from three sides.

    Points that are doubtful are red cubes, the others blue balls. A side view shows the points of
    its side and of the midline. Names stand in columns at the sides of a view, joined to their
    points by lines, so that none covers another.

    path: Ends in `.png`.
    landmarks: mapping of str to mapping of str to (3,), mm. Under "skull" and "skin".
    doubtful: The names of doubtful ones, under "skull" and "skin".
    views: Of "front", "left", "right": those to draw.
    size: pixels, of the picture; default: 700 by 700 for each view.
    Raises `CaseError`: PyVista or OpenGL is missing, no landmark, no view or an unknown one,
        another ending.

    Examples
    --------
    >>> from cmfsim.pictures import picture_landmarks
    >>> picture_landmarks("landmarks.png", bones, skin, {"skull": points})  # doctest: +SKIP
    """
    points = {
        kind: {name: np.asarray(place, dtype=np.float64) for name, place in sites.items()}
        for kind, sites in landmarks.items()
        if sites
    }
    if not points:
        raise CaseInputError("there is no landmark to draw")
    everywhere = [np.array(list(sites.values())) for sites in points.values()]
    if not views:
        raise CaseInputError("there is no view to draw: give one of front, left, right")
    for view in views:
        check_one_of("view", view, tuple(VIEWS))
    if size is None:
        size = (VIEW_SIZE[0] * len(views), VIEW_SIZE[1] * len(points))
    names = [name for sites in points.values() for name in sites]
    columns = 2.0 * column_width(names) / (size[0] / len(views))
    corners = _room(canvas.bounds(everywhere), columns)
    wrong = {kind: set((doubtful or {}).get(kind, ())) for kind in points}
    colours = segment_colours(list(bones))

    def paint(plotter: Any, view: canvas.View) -> None:
        kind = "skin" if view.caption.startswith("skin") else "skull"
        if kind == "skull":
            for name, bone in bones.items():
                _add(plotter, bone, colours[name])
        elif skin is not None:
            _add(plotter, skin, SKIN_COLOUR)
        _add_points(plotter, view, points[kind], wrong[kind])

    panels = [canvas.View(name, f"{kind}, {name}") for kind in points for name in views]
    count = sum(len(names) for names in wrong.values())
    words = [f"Blue balls: landmarks. Red cubes with red names: doubtful ones ({count}) to check."]
    canvas.draw(path, panels, corners, size, paint, columns=len(views), words=words)


def _room(box: Floats, columns: float) -> Floats:
    """A box about points with room for columns of names that take a share of each view's width."""
    middle, half = box.mean(axis=0), 0.5 * (box[1] - box[0])
    wide = (half[:2] + BESIDE) / max(1.0 - columns, LEAST_SHARE)
    half = np.array([*wide, half[2] + ROOM])
    return np.array([middle - half, middle + half])


def _add(plotter: Any, surface: SurfaceData, colour: str) -> None:
    plotter.add_mesh(
        canvas.polydata(surface.vertices, surface.triangles), color=colour, specular=0.1
    )


def _add_points(
    plotter: Any, view: canvas.View, points: Mapping[str, Floats], doubtful: set[str]
) -> None:
    pv = canvas.pyvista_module()
    toward = np.array(VIEWS[view.direction])
    hidden = {"left": "_R", "right": "_L"}.get(view.direction)
    shown = {n: p for n, p in points.items() if hidden is None or not n.endswith(hidden)}
    for name, place in shown.items():
        at = place + LIFT * toward
        if name in doubtful:
            mark = pv.Cube(center=at, x_length=2 * RADIUS, y_length=2 * RADIUS, z_length=2 * RADIUS)
        else:
            mark = pv.Sphere(radius=RADIUS, center=at)
        plotter.add_mesh(mark, color=DOUBTFUL_COLOUR if name in doubtful else SURE_COLOUR)
    labels = [
        Label(name, place, DOUBTFUL_COLOUR if name in doubtful else "black")
        for name, place in shown.items()
    ]
    add_labels(plotter, toward, labels)
