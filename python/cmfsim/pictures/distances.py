"""Errors (as in Figure 10 of Kim et al. 2010), the band of a prediction, and contacts of teeth."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.errors import CaseInputError
from cmfsim.pictures.canvas import (
    SIZE,
    Picture,
    View,
    add_scale_bar,
    add_sizes,
    bounds,
    draw,
    polydata,
)
from cmfsim.pictures.faces import SkinEnds, skin_ends, trimmed
from cmfsim.values.checks import AnyPath, Floats, as_floats, as_positive
from cmfsim.values.prediction import Prediction
from cmfsim.values.skin_band import SkinBand
from cmfsim.values.surface_data import SurfaceData

# Ends of the colour bar, mm (Kim et al. 2010, Figure 10).
DISTANCE_LIMIT = 5.0
# From behind (blue) over nothing (near white) to in front (red), at equal steps: dark ends that are
# told apart without seeing red or green, and no colour between that looks like a border.
COLOURS = ("#1d3f87", "#3f7fbf", "#92c0df", "#f3f1ec", "#eeb08c", "#d2604d", "#84172a")
NOT_EVALUATED = "#cfcac2"
# Left round the vertices with a value, as a share of their extent.
MARGIN = 0.12
STEPS = 256
# Of one face among many, pixels.
CELL = (440, 370)
GRID_LEGEND = (
    "blue: prediction behind the skin after the operation, red: in front, grey: not evaluated"
)
# Of the contacts of tooth rows: ends of the colour bar, mm.
GAP_LIMIT = 2.0
# Of the bone about the crowns that is shown, mm.
ROW_AROUND = 5.0
# Room beside the rows, mm.
ROW_BESIDE = 14.0
ROWS_SIZE = (1500, 800)
ROW_VIEWS = (
    View("below", "upper teeth from below, the patient's left on the right"),
    View("above", "lower teeth from above, the patient's left on the left"),
)

Gaps = np.ma.MaskedArray[Any, np.dtype[np.float64]]


def picture_distances(
    path: AnyPath,
    skin: SurfaceData,
    distances: ArrayLike,
    *,
    limit: float = DISTANCE_LIMIT,
    regions: Mapping[str, float] | None = None,
    size: tuple[int, int] = SIZE,
) -> None:
    """Writes a picture of signed distances on a skin: from the right, the front and the left.

    path: Ends in `.png`.
    skin: The predicted skin.
    distances: (v,), mm, at its vertices, negative (blue) where the prediction lies behind the
        post-operative skin. A masked array leaves the masked vertices grey: `SkinComparison.field`.
    limit: mm. Ends of the colour bar; larger distances have the colours of its ends.
    regions: mm. Signed means to print, each with its colour.
    size: pixels.
    Raises `CaseError`: PyVista or OpenGL is missing, another number of distances, none to show,
        another ending.

    Examples
    --------
    >>> import cmfsim.pictures
    >>> means = {name: s.signed_mean for name, s in report.regions.items()}  # doctest: +SKIP
    >>> cmfsim.pictures.picture_distances(
    ...     "error.png", skin, report.field(len(skin.vertices)), regions=means
    ... )  # doctest: +SKIP
    """
    as_positive("limit", limit)
    vertices = skin.vertices
    values, shown = _values(distances, len(vertices))
    low, high = bounds([vertices[shown]])
    ends = skin_ends(skin)
    corners = ends.within(np.array([low - MARGIN * (high - low), high + MARGIN * (high - low)]))
    legend = [
        (f"{name} {mean:+.2f} mm", distance_colour(mean, limit))
        for name, mean in (regions or {}).items()
    ]
    if not shown.all():
        legend.append(("not evaluated", NOT_EVALUATED))

    def paint(plotter: Any, view: View) -> None:
        surface = polydata(vertices, skin.triangles)
        surface["distance"] = np.where(shown, values, np.nan)
        distance_mesh(plotter, trimmed(surface, ends), limit)
        if view.direction == "left":
            add_scale_bar(plotter, (0.84, 0.27), 5, "%+.1f")

    views = (
        View("right", "right"),
        View("front", "front   blue: prediction behind, red: in front"),
        View("left", "left"),
    )
    draw(path, views, corners, size, paint, legend=legend)


def picture_distance_grid(
    path: AnyPath, faces: Mapping[str, Mapping[str, tuple[SurfaceData, ArrayLike]]]
) -> None:
    """Writes a picture of signed distances on many faces: a row a patient, a column a model.

    All faces are drawn from the front and at one scale; the mean size of the distances is printed
    below each.

    path: Ends in `.png`.
    faces: mapping of str to mapping of str to (SurfaceData, (v,)), by patient, then by model: the
        predicted skin with the signed distances of its vertices, mm, masked where nothing was
        evaluated. A model that a patient lacks leaves its place empty.
    Raises `CaseError`: PyVista or OpenGL is missing, no face, another number of distances than
        vertices, none to show, another ending.

    Examples
    --------
    >>> import cmfsim.pictures
    >>> cmfsim.pictures.picture_distance_grid(
    ...     "figure10.png",
    ...     {"P1": {"H": (skin_h, errors_h), "M+S": (skin_ms, errors_ms)}},
    ... )  # doctest: +SKIP
    """
    models = list(dict.fromkeys(model for by_model in faces.values() for model in by_model))
    if not models:
        raise CaseInputError("there are no faces to draw")
    panels: dict[str, tuple[Any, SkinEnds] | None] = {}
    half = np.zeros(3)
    for patient, by_model in faces.items():
        for model in models:
            if model not in by_model:
                panels[f"{patient}  {model}: no result"] = None
                continue
            surface, ends, extent, mean = _centred(*by_model[model])
            panels[f"{patient}  {model}   mean {mean:.2f} mm"] = surface, ends
            half = np.maximum(half, extent)
    last = next(reversed(panels))

    def paint(plotter: Any, view: View) -> None:
        panel = panels[view.caption]
        if panel is not None:
            distance_mesh(plotter, trimmed(*panel), DISTANCE_LIMIT)
        if view.caption == last:
            add_scale_bar(plotter, (0.87, 0.3), 5, "%+.1f")

    half = (1.0 + 2.0 * MARGIN) * half
    views = [View("front", caption) for caption in panels]
    size = (CELL[0] * len(models), CELL[1] * len(faces))
    box = np.array([-half, half])
    draw(path, views, box, size, paint, columns=len(models), words=(GRID_LEGEND,))


def _centred(skin: SurfaceData, distances: ArrayLike) -> tuple[Any, SkinEnds, Floats, float]:
    """A skin about the middle of its evaluated part, its ends, half that extent, its mean."""
    vertices = skin.vertices
    values, shown = _values(distances, len(vertices))
    low, high = bounds([vertices[shown]])
    moved = SurfaceData(vertices - 0.5 * (low + high), skin.triangles)
    surface = polydata(moved.vertices, skin.triangles)
    surface["distance"] = np.where(shown, values, np.nan)
    return surface, skin_ends(moved), 0.5 * (high - low), float(np.abs(values[shown]).mean())


def distance_mesh(
    plotter: Any, surface: Any, limit: float, colours: Sequence[str] = COLOURS
) -> None:
    """Adds a surface coloured by its "distance"."""
    # Heavy, and `draw` has found it.
    import pyvista as pv  # noqa: PLC0415

    steps = np.linspace(-limit, limit, STEPS)
    table = np.array([(*_rgb(x, limit, colours), 255) for x in steps], dtype=np.uint8)
    lookup = pv.LookupTable(values=table)
    lookup.scalar_range = (-limit, limit)
    lookup.nan_color = NOT_EVALUATED
    plotter.add_mesh(
        surface,
        scalars="distance",
        cmap=lookup,
        smooth_shading=True,
        ambient=0.45,
        diffuse=0.6,
        specular=0.0,
        show_scalar_bar=False,
    )


def distance_colour(distance: float, limit: float = DISTANCE_LIMIT) -> str:
    """The colour of a signed distance, as "#rrggbb"."""
    return "#" + "".join(f"{channel:02x}" for channel in _rgb(distance, limit))


def _rgb(distance: float, limit: float, colours: Sequence[str] = COLOURS) -> tuple[int, int, int]:
    place = (np.clip(distance / limit, -1.0, 1.0) + 1.0) / 2.0 * (len(colours) - 1)
    stops = np.array([[int(c[k : k + 2], 16) for k in (1, 3, 5)] for c in colours], dtype=float)
    channels = [np.interp(place, np.arange(len(colours)), stops[:, k]) for k in range(3)]
    red, green, blue = (round(float(c)) for c in channels)
    return red, green, blue


def _values(distances: ArrayLike, count: int) -> tuple[Floats, NDArray[np.bool_]]:
    """The distances at all vertices, and which of them are to be shown."""
    shown = ~np.ma.getmaskarray(np.ma.asarray(distances))
    if shown.shape != (count,):
        raise CaseInputError(
            f"distances have shape {shown.shape}, but the skin has {count} vertices"
        )
    if not shown.any():
        raise CaseInputError("every distance is masked, so there is nothing to show")
    return as_floats("distances", np.ma.filled(np.ma.asarray(distances, dtype=float), 0.0)), shown


def band_picture(prediction: Prediction) -> Picture:
    """The picture of half the width of a band, to be drawn later.

    It shows the right, the front and the left. Where no calibration case has data, the skin is
    grey; without a calibration, each view states that. Raises `CaseError`: there is no band.
    """
    if prediction.band is None:
        raise CaseInputError("the prediction has no band: use predict_with_band")
    return partial(picture_half_width, skin=prediction.skin, band=prediction.band)


def picture_half_width(path: AnyPath, *, skin: SurfaceData, band: SkinBand) -> None:
    """Writes a picture of half the width of a band; see `band_picture`."""
    half = band.half_width
    vertices = skin.vertices
    known = ~np.ma.getmaskarray(half)
    # What lies beyond the face, as at the cut of the neck, would have the scale to itself.
    face = band.regions.get("face", known) & known
    largest = float(half[face if face.any() else known].max())
    low, high = bounds([vertices[known]])
    ends = skin_ends(skin)
    corners = ends.within(np.array([low - MARGIN * (high - low), high + MARGIN * (high - low)]))
    words = f"± mm, {100 * band.coverage:g} %" if band.calibrated else "± mm, UNCALIBRATED"
    legend = [] if known.all() else [("no calibration", NOT_EVALUATED)]

    def paint(plotter: Any, view: View) -> None:
        surface = polydata(vertices, skin.triangles)
        surface.point_data["band"] = np.ma.filled(half, np.nan)
        shape = trimmed(surface, ends)
        add_sizes(plotter, shape, "band", largest, nan_color=NOT_EVALUATED)
        if view.direction == "left":
            add_scale_bar(plotter, (0.84, 0.27), 4, "%.1f")

    views = tuple(View(name, f"{name}   {words}") for name in ("right", "front", "left"))
    draw(path, views, corners, SIZE, paint, legend=legend)


def contacts_picture(upper: tuple[SurfaceData, Gaps], lower: tuple[SurfaceData, Gaps]) -> Picture:
    """The picture of both tooth rows, to be drawn later.

    Each row is its surface with the signed distance of its vertices from the other row, mm:
    negative where they overlap, masked beyond the crowns.
    """
    return partial(picture_contacts, upper=_cropped(*upper), lower=_cropped(*lower))


def picture_contacts(
    path: AnyPath, *, upper: tuple[SurfaceData, Gaps], lower: tuple[SurfaceData, Gaps]
) -> None:
    """Writes a picture of the contacts: the upper row from below, the lower row from above."""
    corners = bounds([upper[0].vertices, lower[0].vertices])
    # Room for the scale.
    corners[:, 0] += [-ROW_BESIDE, ROW_BESIDE]

    def paint(plotter: Any, view: View) -> None:
        surface, gaps = upper if view.direction == "below" else lower
        shape = polydata(surface.vertices, surface.triangles)
        shape["distance"] = np.ma.filled(gaps, np.nan)
        distance_mesh(plotter, shape, GAP_LIMIT, COLOURS[::-1])
        if view.direction == "above":
            add_scale_bar(plotter, (0.89, 0.3), 5, "%+.1f")

    words = ("Red, negative: overlap. White: contact. Blue, positive: gap.",)
    legend = [("no crown", NOT_EVALUATED)]
    draw(path, ROW_VIEWS, corners, ROWS_SIZE, paint, words=words, legend=legend)


def _cropped(surface: SurfaceData, gaps: Gaps) -> tuple[SurfaceData, Gaps]:
    """The part of a row's surface about its crowns."""
    crowns = surface.vertices[~np.ma.getmaskarray(gaps)]
    low, high = crowns.min(axis=0) - ROW_AROUND, crowns.max(axis=0) + ROW_AROUND
    near = ((surface.vertices >= low) & (surface.vertices <= high)).all(axis=1)
    triangles = surface.triangles[near[surface.triangles].all(axis=1)]
    used, corners = np.unique(triangles, return_inverse=True)
    return SurfaceData(surface.vertices[used], corners.reshape(-1, 3)), gaps[used]
