"""A window in which a case can be turned about, or one picture of it."""

import os
import sys
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cmfsim.errors import CaseInputError
from cmfsim.pictures import canvas
from cmfsim.pictures.anatomy import SKIN_COLOUR
from cmfsim.values.anatomy import segment_colours
from cmfsim.values.checks import AnyPath, Floats
from cmfsim.values.prediction import Prediction
from cmfsim.values.surface_data import SurfaceData, joined_surface

WINDOW = (1300, 900)
# Of the letter that shows and hides each part, and its place in the window, pixels.
ROW, LEFT = 30, 12
MUSCLE_COLOUR, GHOST_COLOUR = "#b8564b", "#7f8c9a"
# Bones show through the skin.
OVER_BONES = 0.45


@dataclass(frozen=True, eq=False)
class ViewPart:
    """A surface of a view.

    colour: "#rrggbb"; unused where there are values.
    opacity: 0 to 1.
    values: (v,) or None, at the vertices, shown in colours from 0 to the largest.
    shown: Initial state; the box next to its name shows and hides it.
    """

    name: str
    surface: SurfaceData
    colour: str
    opacity: float = 1.0
    values: Floats | None = None
    shown: bool = True


def prediction_parts(
    found: Mapping[str, Mapping[str, tuple[SurfaceData, Floats]]],
) -> list[ViewPart]:
    """The surfaces of `read_parts` or of `Prediction.parts`, as a window shows them."""
    before, after = found["skin"]["skin"]
    moved = np.linalg.norm(after - before.vertices, axis=1)
    parts = [
        ViewPart("skin after", SurfaceData(after, before.triangles), SKIN_COLOUR, OVER_BONES),
        ViewPart("skin before", before, SKIN_COLOUR, OVER_BONES, shown=False),
        ViewPart(
            "movement", SurfaceData(after, before.triangles), "#21918c", values=moved, shown=False
        ),
    ]
    bones = found.get("bones", {})
    colours = segment_colours(list(bones))
    for name, (surface, place) in bones.items():
        parts.append(ViewPart(name, SurfaceData(place, surface.triangles), colours[name]))
        if not np.array_equal(place, surface.vertices):
            parts.append(ViewPart(f"{name} before", surface, GHOST_COLOUR, 0.4, shown=False))
    muscles = [surface for surface, _ in found.get("muscles", {}).values()]
    if muscles:
        parts.append(ViewPart("muscles", joined_surface(muscles), MUSCLE_COLOUR, shown=False))
    return parts


def prediction_blocks(prediction: Prediction) -> Any:
    """The surfaces and the tissue of a prediction as PyVista has them; see `to_pyvista`."""
    pv, result = canvas.pyvista_module(), prediction.result
    blocks = pv.MultiBlock()
    for parts in prediction.parts.values():
        for name, (surface, after) in parts.items():
            blocks[name] = canvas.polydata(after, surface.triangles)
            blocks[name].point_data["displacement"] = after - surface.vertices
    moved = result.nodes + result.displacements
    tissue = pv.UnstructuredGrid({pv.CellType.TETRA: result.tets.astype(np.int64)}, moved)
    tissue.point_data["displacement"] = result.displacements
    tissue.point_data["force"] = result.forces
    blocks["tissue"] = tissue
    return blocks


def view_parts(
    parts: Sequence[ViewPart], *, title: str = "cmfsim", screenshot: AnyPath | None = None
) -> None:
    """Opens a window with surfaces that can be turned, shown and hidden, or writes a picture of it.

    screenshot: Ends in `.png`: nothing is opened.
    Raises `CaseError`: Nothing to show; PyVista, OpenGL or a screen is missing.

    Examples
    --------
    >>> from cmfsim.pictures import ViewPart, view_parts
    >>> view_parts([ViewPart("skin", prediction.skin, "#e3b7a0")])  # doctest: +SKIP
    """
    if not parts:
        raise CaseInputError("there is no surface to show")
    path = None if screenshot is None else Path(screenshot)
    if path is not None and path.suffix.lower() != ".png":
        raise CaseInputError(f"{path.name}: a picture is written as .png, not {path.suffix!r}")
    if path is None and not has_screen():
        raise CaseInputError(
            "there is no screen for a window: write a picture instead (--screenshot FILE.png, or "
            'screenshot="FILE.png" in Python)'
        )
    width, height = WINDOW
    pv = canvas.pyvista_module()
    canvas.check_can_draw("the window" if path is None else path.name)
    corners = canvas.bounds([part.surface.vertices for part in parts])
    with canvas.silent_vtk(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        plotter = pv.Plotter(off_screen=path is not None, window_size=[width, height], title=title)
        try:
            plotter.set_background("white")
            plotter.enable_anti_aliasing("ssaa")
            canvas.look_at(plotter, canvas.View("left front", ""), corners, width / height)
            # A picture names what it shows; a window has a box for every part.
            named = [part for part in parts if part.shown or path is None]
            for part in parts:
                _add(plotter, part)
            for row, part in enumerate(named):
                low = height - (row + 1) * ROW - LEFT
                plotter.add_text(part.name, position=(LEFT + ROW, low), font_size=9, color="black")
                if path is None:
                    # A box that shows and hides the part.
                    plotter.add_checkbox_button_widget(
                        plotter.renderer.actors[part.name].SetVisibility,
                        value=part.shown,
                        position=(LEFT, low),
                        size=ROW - 8,
                        color_on=part.colour,
                    )
            plotter.reset_camera_clipping_range()
            if path is None:
                plotter.show()
            else:
                image = np.array(plotter.screenshot(return_img=True))[:, :, :3]
                for row, part in enumerate(named):
                    top = (row + 1) * ROW + LEFT - ROW + 4
                    colour = [int(part.colour[k : k + 2], 16) for k in (1, 3, 5)]
                    image[top : top + ROW - 10, LEFT : LEFT + ROW - 10] = colour
                canvas.write_picture(path, image)
        finally:
            plotter.close()


def has_screen() -> bool:
    """Whether windows can be opened here, according to the environment."""
    if sys.platform.startswith(("win", "darwin")):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _add(plotter: Any, part: ViewPart) -> None:
    shape = canvas.polydata(part.surface.vertices, part.surface.triangles)
    looks = {"smooth_shading": True, "ambient": 0.15, "opacity": part.opacity, "name": part.name}
    if part.values is None:
        plotter.add_mesh(shape, color=part.colour, **looks)
    else:
        shape.point_data[part.name] = part.values
        top = max(float(np.max(part.values)), 1e-6)
        bar = {"title": "mm", "vertical": True, "fmt": "%.1f", "color": "black"}
        plotter.add_mesh(
            shape,
            scalars=part.name,
            cmap="viridis",
            clim=(0.0, top),
            show_scalar_bar=part.shown,
            scalar_bar_args=bar,
            **looks,
        )
    plotter.renderer.actors[part.name].SetVisibility(part.shown)
