"""A picture of the landmarks of skull and skin, to confirm where they lie."""

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cmfsim.checks import Floats
from cmfsim.errors import CaseInputError
from cmfsim.pictures.anatomy import SKIN_COLOUR, segment_colours
from cmfsim.pictures.canvas import View, bounds, draw, polydata, pyvista_module
from cmfsim.values.surface_data import SurfaceData

__all__ = ["picture_landmarks"]

LANDMARK_SIZE = (2100, 1500)
SURE_COLOUR, DOUBTFUL_COLOUR = "#1f4fd8", "#d62728"
# Radius of a point, mm; a doubtful one is a cube of that half edge.
RADIUS = 2.0
LABEL_SIZE = 13
# From a point to its name, mm.
LABEL_GAP = 3.0
# What is drawn about the points, mm, and how far points stand in front of the surface.
ROOM, LIFT = 22.0, 2.5
VIEWS = (("front", (0.0, -1.0, 0.0)), ("left", (1.0, 0.0, 0.0)), ("right", (-1.0, 0.0, 0.0)))


def picture_landmarks(
    path: str | os.PathLike[str],
    bones: Mapping[str, SurfaceData],
    skin: SurfaceData | None,
    landmarks: Mapping[str, Mapping[str, ArrayLike]],
    *,
    doubtful: Mapping[str, Sequence[str]] | None = None,
    size: tuple[int, int] = LANDMARK_SIZE,
) -> None:
    """Writes a picture of landmarks with their names: skull above, skin below, from three sides.

    Points that are doubtful are red cubes, the others blue balls. A side view shows the points of
    its side and of the midline.

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
    size : (int, int), pixels

    Raises
    ------
    CaseError
        (also `ValueError`) PyVista or OpenGL is missing, no landmark, another ending.

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
    corners = bounds(everywhere) + np.array([[-ROOM], [ROOM]])
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

    views = [View(name, f"{kind}, {name}") for kind in points for name, _ in VIEWS]
    count = sum(len(names) for names in wrong.values())
    words = [
        f"Blue balls: landmarks. Red cubes with red names: doubtful ones ({count}) to look at."
    ]
    draw(path, views, corners, size, paint, columns=len(VIEWS), words=words)


def _add(plotter: Any, surface: SurfaceData, colour: str) -> None:
    plotter.add_mesh(polydata(surface.vertices, surface.triangles), color=colour, specular=0.1)


def _add_points(plotter: Any, view: View, points: Mapping[str, Floats], doubtful: set[str]) -> None:
    pv = pyvista_module()
    toward = np.array(dict(VIEWS)[view.direction])
    hidden = {"left": "_R", "right": "_L"}.get(view.direction)
    shown = {n: p for n, p in points.items() if hidden is None or not n.endswith(hidden)}
    for name, place in shown.items():
        at = place + LIFT * toward
        if name in doubtful:
            mark = pv.Cube(center=at, x_length=2 * RADIUS, y_length=2 * RADIUS, z_length=2 * RADIUS)
        else:
            mark = pv.Sphere(radius=RADIUS, center=at)
        plotter.add_mesh(mark, color=DOUBTFUL_COLOUR if name in doubtful else SURE_COLOUR)
    for colour, names in (
        ("black", [n for n in shown if n not in doubtful]),
        (DOUBTFUL_COLOUR, [n for n in shown if n in doubtful]),
    ):
        if names:
            beside = LABEL_GAP * np.cross((0.0, 0.0, 1.0), toward)
            places = np.array([shown[n] for n in names]) + 10.0 * LIFT * toward + beside
            plotter.add_point_labels(
                places,
                names,
                font_size=LABEL_SIZE,
                text_color=colour,
                shape_opacity=0.5,
                shape_color="white",
                show_points=False,
                always_visible=True,
            )
