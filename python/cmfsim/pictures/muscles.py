"""Pictures of muscles: with their names, or with fibre boxes and directions."""

from __future__ import annotations

import colorsys
import itertools
import os
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from cmfsim.errors import CaseInputError
from cmfsim.pictures.canvas import SIZE, Shown, View, bounds, draw, polydata
from cmfsim.values.checks import Floats
from cmfsim.values.surface_data import SurfaceData

if TYPE_CHECKING:
    from cmfsim.values.musculature import MuscleSurface, Musculature

MUSCLE_COLOUR, BONE_COLOUR = "#b8564b", "#e6dcc3"
# Boxes whose direction the outline hardly tells are drawn in the second colour.
BOX_COLOUR, SHEET_COLOUR, LINE_COLOUR = "#1f5fbf", "#e08a00", "#202020"
# Length of a direction on the surface, as a share of the picture's diagonal.
STROKE = 0.012
# About as many directions are drawn on each muscle.
STROKES = 60


def picture_muscles(
    path: str | os.PathLike[str],
    musculature: Musculature,
    skull: SurfaceData | None = None,
    *,
    fibres: bool = False,
    size: tuple[int, int] = SIZE,
) -> None:
    """Writes a picture of muscles: in colours with their names, or with their fibres.

    In colours, from the front and the left; muscles of both sides with the same name have one
    colour. With fibres, boxes of muscles whose outline hardly determines the direction are orange,
    others blue; where fibre lines are known the directions follow them.

    path: Ends in `.png`.
    skull: Drawn with them, such as the patient's bones.
    fibres: Whether to draw boxes and directions (Kim et al. 2010, Figure 2) instead of names.
    size: pixels.
    Raises `CaseError`: PyVista or OpenGL is missing, no muscle, another ending.
    Raises `MeshError`: A muscle's surface that cannot be used for fibres.

    Examples
    --------
    >>> import cmfsim, cmfsim.pictures
    >>> template = cmfsim.MuscleTemplate.load("default")
    >>> cmfsim.pictures.picture_muscles(
    ...     "muscles.png", template.musculature, template.skull
    ... )  # doctest: +SKIP
    """
    if not len(musculature):
        raise CaseInputError("there is no muscle to draw")
    clouds = [muscle.surface.vertices for muscle in musculature]
    corners = bounds(clouds if skull is None else [*clouds, skull.vertices])

    views = tuple(View(name, name) for name in ("front", "left front", "left"))
    shown = Shown()

    names = dict.fromkeys(_without_side(muscle.name) for muscle in musculature)
    colours = {n: MUSCLE_COLOUR if fibres else _hue(k) for k, n in enumerate(names)}
    length = STROKE * float(np.linalg.norm(corners[1] - corners[0]))
    lines = [_lines(muscle, length) if fibres else None for muscle in musculature]

    def paint(plotter: Any, _: View) -> None:
        if skull is not None:
            shown.add(plotter, "skull", partial(add_bones, plotter, skull))
        for muscle, drawn in zip(musculature, lines, strict=True):
            make = partial(add_muscle, plotter, muscle, colours[_without_side(muscle.name)])
            shown.add(plotter, f"muscle {muscle.name}", make)
            if drawn is not None:
                strokes, edges, colour = drawn
                plotter.add_lines(strokes, color=LINE_COLOUR, width=2)
                plotter.add_lines(edges, color=colour, width=1)

    legend = list(colours.items())
    if fibres:
        legend = [("muscle", MUSCLE_COLOUR), ("fibre direction", LINE_COLOUR)]
        legend += [("box", BOX_COLOUR), ("box of a sheet", SHEET_COLOUR)]
    draw(path, views, corners, size, paint, legend=legend)


def add_bones(plotter: Any, skull: SurfaceData) -> Any:
    """The actor of the skull, added to a view."""
    shape = polydata(skull.vertices, skull.triangles)
    return plotter.add_mesh(shape, color=BONE_COLOUR, smooth_shading=True)


def add_muscle(plotter: Any, muscle: MuscleSurface, colour: str) -> Any:
    """The actor of a muscle, added in a colour to a view."""
    shape = polydata(muscle.surface.vertices, muscle.surface.triangles)
    return plotter.add_mesh(shape, color=colour, smooth_shading=True, ambient=0.15)


def _lines(muscle: MuscleSurface, length: float) -> tuple[Floats, Floats, str]:
    """Fibre strokes and box edges as pairs of points, and the colour of the boxes."""
    vertices = muscle.surface.vertices
    triangles = muscle.surface.triangles.astype(np.int64)
    fibres = muscle.fibres()
    every = max(1, len(triangles) // STROKES)
    corners = vertices[triangles[::every]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    # Just above the surface, so that they show.
    middle = corners.mean(axis=1) + 0.15 * length * normals
    half = 0.5 * length * fibres.directions(middle)
    strokes = np.stack([middle - half, middle + half], axis=1).reshape(-1, 3)
    centres, axes, half_extents = fibres.boxes
    edges = []
    for centre, frame, extent in zip(centres, axes, half_extents, strict=True):
        for axis in range(3):
            one, other = (k for k in range(3) if k != axis)
            along = extent[axis] * frame[axis]
            for a, b in itertools.product((-1.0, 1.0), repeat=2):
                at = centre + a * extent[one] * frame[one]
                at = at + b * extent[other] * frame[other]
                edges += [at - along, at + along]
    colour = SHEET_COLOUR if fibres.is_sheet else BOX_COLOUR
    return strokes, np.array(edges), colour


def _without_side(name: str) -> str:
    return name.removesuffix("_L").removesuffix("_R")


def _hue(number: int) -> str:
    """A colour that differs from those of the numbers near it."""
    # Steps of the golden section spread hues evenly, however many there are.
    hue = (number * 0.6180339887) % 1.0
    channels = colorsys.hsv_to_rgb(hue, 0.75, 0.62 + 0.28 * (number % 2))
    return "#" + "".join(f"{round(255 * channel):02x}" for channel in channels)
