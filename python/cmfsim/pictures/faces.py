"""Pictures of a plan and of the face that it is predicted to give."""

import os
from dataclasses import replace
from typing import Any

import numpy as np

from cmfsim.case import BoneSegment
from cmfsim.pictures.anatomy import SKIN_COLOUR, add_bone, segment_colours
from cmfsim.pictures.canvas import SIZE, View, bounds, draw, polydata
from cmfsim.prediction import Prediction
from cmfsim.scene import MovedSurface, SurfaceData

__all__ = ["picture_plan", "picture_prediction"]

# Of pictures with six views, pixels.
WIDE = (2400, 700)
# Movement that fills the colour scale at least, mm.
LEAST_SCALE = 0.01
# Of bone where it was before the operation.
GHOST_COLOUR = "#7f8c9a"


def picture_prediction(
    path: str | os.PathLike[str],
    prediction: Prediction,
    *,
    size: tuple[int, int] = WIDE,
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
    before, after = prediction.skin_before, prediction.skin
    moved = np.linalg.norm(prediction.skin_displacements, axis=1)
    largest = max(float(moved.max()), LEAST_SCALE)

    def paint(plotter: Any, view: View) -> None:
        surface = before if view.caption.startswith("before") else after
        shape = polydata(surface.vertices, surface.triangles)
        if not view.caption.startswith("movement"):
            plotter.add_mesh(shape, color=SKIN_COLOUR, smooth_shading=True)
            return
        shape.point_data["movement, mm"] = moved
        plotter.add_mesh(
            shape,
            scalars="movement, mm",
            clim=(0.0, largest),
            cmap="viridis",
            smooth_shading=True,
            show_scalar_bar=view.direction == "front",
            scalar_bar_args={"n_labels": 4, "fmt": "%.1f", "color": "black"},
        )

    names = ("before", "after", "movement")
    views = tuple(View(d, f"{name}, {d}") for d in ("front", "left") for name in names)
    corners = bounds([before.vertices, after.vertices])
    draw(path, views, corners, size, paint, [])


def picture_plan(
    path: str | os.PathLike[str],
    prediction: Prediction,
    *,
    size: tuple[int, int] = SIZE,
) -> None:
    """Writes a picture of a plan: bone segments where they go, and behind them where they were.

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
    segments = prediction.patient.segments
    moved = [replace(s, surface=_moved(s, prediction.scene.plan.get(s.name))) for s in segments]
    colours = segment_colours([s.name for s in segments])
    corners = bounds([np.asarray(s.surface.vertices) for s in (*segments, *moved)])

    def paint(plotter: Any, view: View) -> None:
        del view
        for before, after in zip(segments, moved, strict=True):
            add_bone(plotter, after, colours[after.name])
            if before.surface is not after.surface:
                shape = polydata(before.surface.vertices, before.surface.triangles)
                plotter.add_mesh(shape, color=GHOST_COLOUR, opacity=0.3, smooth_shading=True)

    views = tuple(View(name, name) for name in ("right", "front", "left"))
    draw(path, views, corners, size, paint, [*colours.items(), ("before", GHOST_COLOUR)])


def _moved(segment: BoneSegment, motion: object) -> SurfaceData:
    """A segment's surface where its motion takes it; the same surface where it stays."""
    surface = segment.surface
    if isinstance(motion, MovedSurface):
        return SurfaceData(motion.moved_vertices, motion.surface.triangles)
    matrix = np.eye(4) if motion is None else np.asarray(motion, dtype=np.float64)
    if matrix.shape != (4, 4) or np.array_equal(matrix, np.eye(4)):
        return surface
    vertices = np.asarray(surface.vertices) @ matrix[:3, :3].T + matrix[:3, 3]
    return SurfaceData(vertices, surface.triangles, surface.crease_angle)
