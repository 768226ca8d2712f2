"""Pictures of a plan and of the face that it is predicted to give."""

import base64
import html
import os
import tempfile
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError
from cmfsim.pictures.anatomy import SKIN_COLOUR, add_bone, segment_colours
from cmfsim.pictures.canvas import SIZE, Picture, Shown, View, add_scale_bar, bounds, draw, polydata
from cmfsim.pictures.skin_ends import SkinEnds, skin_ends, trimmed
from cmfsim.values.clinical_motion import plan_lines
from cmfsim.values.prediction import Prediction
from cmfsim.values.surface_data import SurfaceData

# Of six views in two rows, pixels.
TWO_ROWS = (1650, 1240)
# The same in a notebook.
NOTEBOOK = (990, 744)
# Skin shines a little.
SKIN_SHADING = {"smooth_shading": True, "ambient": 0.12, "specular": 0.12, "specular_power": 12}
# Movement that fills the colour scale at least, mm.
LEAST_SCALE = 0.01
# Of bone where it was before the operation.
GHOST_COLOUR = "#7f8c9a"
# A segment that moves less than this, mm, is drawn where it was: two surfaces in one place flicker.
STAYS = 0.5


def add_skin(plotter: Any, shape: Any, colours: NDArray[np.uint8] | None) -> None:
    """Adds skin to a view, with the colours of its vertices where there are any."""
    if colours is None:
        plotter.add_mesh(shape, color=SKIN_COLOUR, **SKIN_SHADING)
    else:
        shape.point_data["colour"] = colours
        plotter.add_mesh(shape, scalars="colour", rgb=True, **SKIN_SHADING)


def picture_prediction(
    path: str | os.PathLike[str], prediction: Prediction, *, size: tuple[int, int] = TWO_ROWS
) -> None:
    """Writes a picture of a face before and after, and how far each point of it moves.

    path: Ends in `.png`.
    size: pixels.
    Raises `CaseError`: PyVista or OpenGL is missing, another ending.

    Examples
    --------
    >>> import cmfsim.pictures
    >>> cmfsim.pictures.picture_prediction("prediction.png", prediction)  # doctest: +SKIP
    """
    prediction_picture(prediction, size=size)(path)


def prediction_picture(prediction: Prediction, *, size: tuple[int, int] = TWO_ROWS) -> Picture:
    """The picture that `picture_prediction` writes, to be drawn later."""
    return partial(
        picture_faces,
        before=prediction.face_before,
        after=prediction.face,
        ends=skin_ends(prediction.skin_before),
        # The mesh's own skin ends in a ragged rim; a whole head goes on past the picture.
        is_trimmed=prediction.patient.face is None,
        size=size,
        colours=prediction.face_colours,
    )


def picture_faces(
    path: str | os.PathLike[str],
    *,
    before: SurfaceData,
    after: SurfaceData,
    ends: SkinEnds,
    is_trimmed: bool,
    size: tuple[int, int],
    colours: NDArray[np.uint8] | None = None,
) -> None:
    """Writes a picture of a face before and after; see `picture_prediction`."""
    moved = np.linalg.norm(after.vertices - before.vertices, axis=1)
    largest = max(float(moved.max()), LEAST_SCALE)

    def paint(plotter: Any, view: View) -> None:
        surface = before if view.caption.startswith("before") else after
        shape = polydata(surface.vertices, surface.triangles)
        shape.point_data["movement"] = moved
        if is_trimmed:
            shape = trimmed(shape, ends)
        if not view.caption.startswith("movement"):
            add_skin(plotter, shape, colours)
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


def prediction_html(prediction: Prediction) -> str:
    """What a notebook shows of a prediction: its lines, and its picture if one can be drawn."""
    lines = f"<pre>{html.escape(repr(prediction))}</pre>"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "prediction.png"
        try:
            picture_prediction(path, prediction, size=NOTEBOOK)
        except CaseInputError:
            return lines
        data = base64.b64encode(path.read_bytes()).decode()
    return f'{lines}<img alt="prediction" src="data:image/png;base64,{data}">'


def picture_plan(
    path: str | os.PathLike[str], prediction: Prediction, *, size: tuple[int, int] = SIZE
) -> None:
    """Writes a picture of a plan: bone segments where they go, and behind them where they were.

    The motion of each segment stands below, in words.

    path: Ends in `.png`.
    size: pixels.
    Raises `CaseError`: PyVista or OpenGL is missing, another ending.

    Examples
    --------
    >>> import cmfsim.pictures
    >>> cmfsim.pictures.picture_plan("plan.png", prediction)  # doctest: +SKIP
    """
    plan_picture(prediction, size=size)(path)


def plan_picture(prediction: Prediction, *, size: tuple[int, int] = SIZE) -> Picture:
    """The picture that `picture_plan` writes, to be drawn later."""
    after = prediction.bones
    plan = {name: m["clinical"] for name, m in prediction.summary.get("plan", {}).items()}
    return partial(
        picture_motions,
        before={s.name: s.surface for s in prediction.patient.segments},
        after={
            s.name: SurfaceData(after[s.name][1], after[s.name][0].triangles)
            for s in prediction.patient.segments
        },
        still=[
            name
            for name, (surface, vertices) in after.items()
            if np.quantile(np.linalg.norm(vertices - surface.vertices, axis=1), 0.99) < STAYS
        ],
        words=plan_lines(plan),
        size=size,
    )


def picture_motions(
    path: str | os.PathLike[str],
    *,
    before: Mapping[str, SurfaceData],
    after: Mapping[str, SurfaceData],
    still: Sequence[str],
    words: Sequence[str],
    size: tuple[int, int],
) -> None:
    """Writes a picture of segments of bone before and after; see `picture_plan`."""
    colours = segment_colours(list(before))
    corners = bounds([s.vertices for s in (*before.values(), *after.values())])
    shown = Shown()

    def ghost(plotter: Any, surface: SurfaceData) -> Any:
        shape = polydata(surface.vertices, surface.triangles)
        return plotter.add_mesh(shape, color=GHOST_COLOUR, opacity=0.3, smooth_shading=True)

    def paint(plotter: Any, view: View) -> None:
        del view
        for name, now in after.items():
            shown.add(plotter, name, partial(add_bone, plotter, now, colours[name]))
            if name not in still:
                shown.add(plotter, f"{name} before", partial(ghost, plotter, before[name]))

    views = tuple(View(name, name) for name in ("right", "front", "left"))
    legend = [*colours.items(), ("before", GHOST_COLOUR)]
    draw(path, views, corners, size, paint, legend=legend, words=words)
