"""The band of a prediction painted on its skin."""

import os
from functools import partial
from typing import Any

import numpy as np

from cmfsim.errors import CaseInputError
from cmfsim.pictures.canvas import SIZE, Picture, View, add_scale_bar, bounds, draw, polydata
from cmfsim.pictures.distances import NOT_EVALUATED
from cmfsim.pictures.skin_ends import skin_ends, trimmed
from cmfsim.values.prediction import Prediction
from cmfsim.values.skin_band import SkinBand
from cmfsim.values.surface_data import SurfaceData

# Left round the face, as a share of its extent.
MARGIN = 0.12


def picture_band(
    path: str | os.PathLike[str], prediction: Prediction, *, size: tuple[int, int] = SIZE
) -> None:
    """Writes a picture of half the width of a band: from the right, the front and the left.

    Where no calibration case has data, the skin is grey. Without a calibration, each view states
    that.

    Parameters
    ----------
    path : path
        Ends in `.png`.
    prediction : Prediction
        With `band`.
    size : (int, int), pixels

    Raises
    ------
    CaseError
        (also `ValueError`) The prediction has no band; PyVista or OpenGL is missing, another
        ending.

    Examples
    --------
    >>> import cmfsim.pictures
    >>> cmfsim.pictures.picture_band("band.png", prediction)  # doctest: +SKIP
    """
    band_picture(prediction, size=size)(path)


def band_picture(prediction: Prediction, *, size: tuple[int, int] = SIZE) -> Picture:
    """The picture that `picture_band` writes, to be drawn later."""
    if prediction.band is None:
        raise CaseInputError("the prediction has no band: use predict_with_band")
    return partial(picture_half_width, skin=prediction.skin, band=prediction.band, size=size)


def picture_half_width(
    path: str | os.PathLike[str], *, skin: SurfaceData, band: SkinBand, size: tuple[int, int]
) -> None:
    """Writes a picture of half the width of a band; see `picture_band`."""
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
        plotter.add_mesh(
            trimmed(surface, ends),
            scalars="band",
            clim=(0.0, largest),
            cmap="viridis",
            nan_color=NOT_EVALUATED,
            smooth_shading=True,
            ambient=0.3,
            show_scalar_bar=False,
        )
        if view.direction == "left":
            add_scale_bar(plotter, (0.84, 0.27), 4, "%.1f")

    views = tuple(View(name, f"{name}   {words}") for name in ("right", "front", "left"))
    draw(path, views, corners, size, paint, legend=legend)
