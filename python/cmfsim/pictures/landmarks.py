"""A picture of the landmarks of skull and skin, to confirm where they lie."""

import os
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cmfsim.errors import CaseInputError
from cmfsim.pictures.anatomy import SKIN_COLOUR, segment_colours
from cmfsim.pictures.canvas import View, bounds, draw, polydata, pyvista_module
from cmfsim.pictures.labels import Label, add_labels, column_width
from cmfsim.values.checks import Floats, check_one_of
from cmfsim.values.surface_data import SurfaceData

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


def picture_landmarks(
    path: str | os.PathLike[str],
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

    Parameters
    ----------
    path : path
        Ends in `.png`.
    bones : mapping of str to SurfaceData
    skin : SurfaceData or None
    landmarks : mapping of str to mapping of str to (3,) float64, mm
        Under "skull" and "skin".
    doubtful : mapping of str to sequence of str, optional
        The names of doubtful ones, under "skull" and "skin".
    views : sequence of str
        Of "front", "left", "right": those to draw.
    size : (int, int), pixels, optional
        Of the picture; default: 700 by 700 for each view.

    Raises
    ------
    CaseError
        (also `ValueError`) PyVista or OpenGL is missing, no landmark, no view or an unknown one,
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
    corners = _room(bounds(everywhere), columns)
    wrong = {kind: set((doubtful or {}).get(kind, ())) for kind in points}
    colours = segment_colours(list(bones))

    def paint(plotter: Any, view: View) -> None:
        kind = "skin" if view.caption.startswith("skin") else "skull"
        if kind == "skull":
            for name, bone in bones.items():
                _add(plotter, bone, colours[name])
        elif skin is not None:
            _add(plotter, skin, SKIN_COLOUR)
        _add_points(plotter, view, points[kind], wrong[kind])

    panels = [View(name, f"{kind}, {name}") for kind in points for name in views]
    count = sum(len(names) for names in wrong.values())
    words = [f"Blue balls: landmarks. Red cubes with red names: doubtful ones ({count}) to check."]
    draw(path, panels, corners, size, paint, columns=len(views), words=words)


def _room(box: Floats, columns: float) -> Floats:
    """A box about points with room for columns of names that take a share of each view's width."""
    middle, half = box.mean(axis=0), 0.5 * (box[1] - box[0])
    wide = (half[:2] + BESIDE) / max(1.0 - columns, LEAST_SHARE)
    half = np.array([*wide, half[2] + ROOM])
    return np.array([middle - half, middle + half])


def _add(plotter: Any, surface: SurfaceData, colour: str) -> None:
    plotter.add_mesh(polydata(surface.vertices, surface.triangles), color=colour, specular=0.1)


def _add_points(plotter: Any, view: View, points: Mapping[str, Floats], doubtful: set[str]) -> None:
    pv = pyvista_module()
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
    add_labels(
        plotter,
        toward,
        [
            Label(name, place, DOUBTFUL_COLOUR if name in doubtful else "black")
            for name, place in shown.items()
        ],
    )
