"""Pictures of a plan and of the face that it is predicted to give."""

import os
from dataclasses import replace
from typing import Any

import numpy as np

from cmfsim.pictures.anatomy import SKIN_COLOUR, add_bone, segment_colours
from cmfsim.pictures.canvas import SIZE, View, add_scale_bar, bounds, draw, polydata
from cmfsim.pictures.skin_ends import skin_ends, trimmed
from cmfsim.values.clinical_motion import plan_lines
from cmfsim.values.prediction import Prediction
from cmfsim.values.surface_data import SurfaceData

__all__ = ["picture_plan", "picture_prediction"]

# Of six views in two rows, pixels.
TWO_ROWS = (1650, 1240)
# Skin shines a little.
SKIN_SHADING = {"smooth_shading": True, "ambient": 0.12, "specular": 0.12, "specular_power": 12}
# Movement that fills the colour scale at least, mm.
LEAST_SCALE = 0.01
# Of bone where it was before the operation.
GHOST_COLOUR = "#7f8c9a"
# A segment that moves less than this, mm, is drawn where it was: two surfaces in one place flicker.
STAYS = 0.5


def picture_prediction(
    path: str | os.PathLike[str],
    prediction: Prediction,
    *,
    size: tuple[int, int] = TWO_ROWS,
) -> None:
    """Writes a picture of a face before and after, and how far each point of it moves.

    Parameters
    ----------
    path : path
        Ends in `.png`.
    prediction : Prediction
    size : (int, int), pixels

    Raises
    ------
    CaseError
        (also `ValueError`) PyVista or OpenGL is missing, another ending.

    Examples
    --------
    >>> import cmfsim.pictures
    >>> cmfsim.pictures.picture_prediction("prediction.png", prediction)  # doctest: +SKIP
    """
    before, after = prediction.face_before, prediction.face
    moved = np.linalg.norm(after.vertices - before.vertices, axis=1)
    largest = max(float(moved.max()), LEAST_SCALE)
    ends = skin_ends(prediction.skin_before)

    def paint(plotter: Any, view: View) -> None:
        surface = before if view.caption.startswith("before") else after
        shape = polydata(surface.vertices, surface.triangles)
        shape.point_data["movement"] = moved
        if prediction.patient.face is None:
            # The mesh's own skin ends in a ragged rim; a whole head goes on past the picture.
            shape = trimmed(shape, ends)
        if not view.caption.startswith("movement"):
            plotter.add_mesh(shape, color=SKIN_COLOUR, **SKIN_SHADING)
            return
        plotter.add_mesh(
            shape,
            scalars="movement",
            clim=(0.0, largest),
            cmap="viridis",
            smooth_shading=True,
            ambient=0.3,
            show_scalar_bar=False,
        )
        if view.direction == "left":
            # Before the forehead: the head fills the other side.
            add_scale_bar(plotter, (0.03, 0.5), 4, "%.1f")

    names = ("before", "after", "movement")
    views = tuple(View(d, f"{name}, {d}") for d in ("front", "left") for name in names)
    corners = bounds([before.vertices, after.vertices])
    corners = ends.within(corners)
    draw(path, views, corners, size, paint, columns=len(names))


def picture_plan(
    path: str | os.PathLike[str],
    prediction: Prediction,
    *,
    size: tuple[int, int] = SIZE,
) -> None:
    """Writes a picture of a plan: bone segments where they go, and behind them where they were.

    The motion of each segment stands below, in words.

    Parameters
    ----------
    path : path
        Ends in `.png`.
    prediction : Prediction
    size : (int, int), pixels

    Raises
    ------
    CaseError
        (also `ValueError`) PyVista or OpenGL is missing, another ending.

    Examples
    --------
    >>> import cmfsim.pictures
    >>> cmfsim.pictures.picture_plan("plan.png", prediction)  # doctest: +SKIP
    """
    segments, after = prediction.patient.segments, prediction.bones
    moved = [
        replace(s, surface=SurfaceData(after[s.name][1], after[s.name][0].triangles))
        for s in segments
    ]
    shifts = {
        name: np.linalg.norm(vertices - surface.vertices, axis=1)
        for name, (surface, vertices) in after.items()
    }
    still = {name for name, shift in shifts.items() if np.quantile(shift, 0.99) < STAYS}
    colours = segment_colours([s.name for s in segments])
    corners = bounds([s.surface.vertices for s in (*segments, *moved)])

    def paint(plotter: Any, view: View) -> None:
        del view
        for before, now in zip(segments, moved, strict=True):
            add_bone(plotter, now, colours[now.name])
            if now.name not in still:
                shape = polydata(before.surface.vertices, before.surface.triangles)
                plotter.add_mesh(shape, color=GHOST_COLOUR, opacity=0.3, smooth_shading=True)

    views = tuple(View(name, name) for name in ("right", "front", "left"))
    legend = [*colours.items(), ("before", GHOST_COLOUR)]
    plan = {name: m["clinical"] for name, m in prediction.summary.get("plan", {}).items()}
    draw(path, views, corners, size, paint, legend=legend, words=plan_lines(plan))
