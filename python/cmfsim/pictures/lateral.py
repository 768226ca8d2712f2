"""Profile tracings over a synthetic lateral view, before the operation and as planned.

The view is a parallel projection onto the midsagittal plane, without enlargement. Surfaces of bones
and skin absorb as thin shells: a ray is weakened by 1 / cos of the angle at which it meets each, so
that outlines are dark, as those of cortical bone are. What lies inside bones is not seen.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from cmfsim.pictures.charts import write_figure
from cmfsim.values.checks import Floats
from cmfsim.values.surface_data import SurfaceData, triangle_areas

# Inches of both panels, so that the letters of one are legible across a column of the chart.
PANELS, DPI = (6.4, 3.2), 220
# Smallest letters, points; width of a pixel of the view, mm.
LETTERS, PIXEL = 6.5, 0.6
# Of a shell that a ray meets at a right angle, in powers of e.
BONE, SKIN = 0.1, 0.05
# What is shown in front of, below and above the sites, mm, and the width of it to its height.
FRONT, BELOW, ABOVE, ASPECT = 22.0, 20.0, 22.0, 1.08
SCALE = 20.0
BEFORE, PLANNED, PALE = "#1f4e8c", "#c2261c", "#4a5663"
# The sites that are named, those of bone behind them, where no skin is, but for Gn, which lies
# between Pog and Me.
BONE_SITES = ("S", "N", "Po", "Or", "A", "B", "Pog", "Me", "Go", "U1", "L1")
SHOWN = (*BONE_SITES, "Gn", "Prn", "Sn", "Ls", "Li", "Pog'")
# How far above the site a name stands, points: the edge of a lower incisor lies behind and above
# that of the upper one.
RAISED = {"U1": 9.0, "L1": -4.0}
PLANES: Mapping[str, tuple[str, str]] = {
    "SN": ("S", "N"),
    "FH": ("Po", "Or"),
    "occlusal": ("OP-back", "OP-front"),
    "mandibular": ("Go", "Me"),
    "E-line": ("Prn", "Pog'"),
}


@dataclass(frozen=True, eq=False)
class LateralView:
    """What a lateral view shows of a head.

    bones: By segment; skin: LPS, mm.
    sites: (2,) mm each, forwards and up, by abbreviation.
    axes: (3, 3). Directions forwards, up and left, as rows.
    middle: Place of the midsagittal plane along the last, mm.
    """

    bones: Mapping[str, SurfaceData]
    skin: SurfaceData
    sites: Mapping[str, Floats]
    axes: Floats
    middle: float


def picture_lateral(
    path: str | os.PathLike[str], *, before: LateralView, planned: LateralView
) -> None:
    """Writes the tracing before the operation, and as planned over that before."""
    clouds = np.array([p for v in (before, planned) for n, p in v.sites.items() if n in SHOWN])
    low, high = clouds[:, 1].min() - BELOW, clouds[:, 1].max() + ABOVE
    front = clouds[:, 0].max() + FRONT
    window = np.array([[front - ASPECT * (high - low), front], [low, high]])

    def paint(figure: Any) -> None:
        panels = figure.subplots(1, 2, subplot_kw={"xlim": window[0], "ylim": window[1]})
        figure.get_layout_engine().set(w_pad=0.02, h_pad=0.04, wspace=0.0)
        shells: dict[bytes, Floats] = {}
        _panel(panels[0], before, BEFORE, window, shells)
        _panel(panels[1], planned, PLANNED, window, shells)
        _trace(panels[1], before, BEFORE, 0.6)
        panels[0].set_title("before", size=LETTERS + 1.0, color=BEFORE)
        panels[1].set_title("planned, over before", size=LETTERS + 1.0, color=PLANNED)

    write_figure(Path(path), PANELS, paint, dpi=DPI)


def _panel(
    panel: Any, view: LateralView, colour: str, window: Floats, shells: dict[bytes, Floats]
) -> None:
    """Draws one head with its tracing, sites and planes.

    shells: By place, shape and direction: most bone is the same in both panels.
    """
    depth: Floats = np.zeros((1, 1))
    for surface in (view.skin, *view.bones.values()):
        place = b"".join(a.tobytes() for a in (surface.vertices, surface.triangles, view.axes))
        if place not in shells:
            shells[place] = _shells(surface, view.axes, window)
        depth = depth + (SKIN if surface is view.skin else BONE) * shells[place]
    extent = [*window[0], *window[1]]
    panel.imshow(
        np.exp(-depth), cmap="gray", vmin=0.0, vmax=1.0, origin="lower", extent=extent,
        interpolation="bilinear",
    )  # fmt: skip
    _trace(panel, view, colour, 1.0)
    for name, ends in _planes(view.sites).items():
        along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
        line = ends + np.outer([-8.0, 8.0], along)
        panel.plot(*line.T, color=PALE, linewidth=0.6, linestyle=(0, (5, 2)))
        front = name == "mandibular"
        _write(panel, line[int(front)], name, PALE, (3.0 if front else -3.0, 0.0))
    for name in SHOWN:
        if name in view.sites:
            panel.plot(*view.sites[name], ".", color=colour, markersize=3.0)
            side = -3.0 if name in BONE_SITES else 3.0
            _write(panel, view.sites[name], name, colour, (side, RAISED.get(name, 0.0)))
    x, y = window[0][0] + 4.0, window[1][0] + 5.0
    for ink, width in (("white", 4.5), ("black", 1.5)):
        panel.plot([x, x + SCALE], [y, y], color=ink, linewidth=width, solid_capstyle="butt")
    words = f"{SCALE:g} mm, not enlarged"
    _write(panel, np.array([x + SCALE, y]), words, "black", (3.0, 0.0))
    panel.set_axis_off()


def _write(panel: Any, place: Floats, text: str, colour: str, away: tuple[float, float]) -> None:
    """Writes a name on a pale ground, so many points away from a place: forwards and up."""
    effects = import_module("matplotlib.patheffects")
    panel.annotate(
        text, place, xytext=away, textcoords="offset points",
        size=LETTERS, color=colour, ha="right" if away[0] < 0.0 else "left", va="center",
        clip_on=True, path_effects=[effects.withStroke(linewidth=1.6, foreground="white")],
    )  # fmt: skip


def _trace(panel: Any, view: LateralView, colour: str, width: float) -> None:
    """Draws where the midsagittal plane cuts skin and bones."""
    lines = import_module("matplotlib.collections").LineCollection
    for surface in (view.skin, *view.bones.values()):
        cut = _section(surface, view.axes, view.middle)
        panel.add_collection(lines(cut, colors=colour, linewidths=width))


def _planes(sites: Mapping[str, Floats]) -> dict[str, Floats]:
    """The ends of each plane whose sites are known, (2, 2) mm, by what is written at it."""
    found = {
        name: np.array([sites[one], sites[other]])
        for name, (one, other) in PLANES.items()
        if one in sites and other in sites
    }
    if "FH" not in found and "Or" in sites:
        # Forwards is along the Frankfort plane of the average head, registered to this one.
        found["FH, estimated"] = sites["Or"] + np.array([[-48.0, 0.0], [0.0, 0.0]])
    return found


def _section(surface: SurfaceData, axes: Floats, middle: float) -> Floats:
    """Where the midsagittal plane cuts a surface, (k, 2, 2) mm: the ends of each line."""
    side = surface.vertices @ axes[2] - middle
    flat = surface.vertices @ axes[:2].T
    triangles = surface.triangles
    in_front = (side > 0.0)[triangles]
    triangles = triangles[in_front.any(axis=1) & ~in_front.all(axis=1)]
    ends, others = triangles, np.roll(triangles, -1, axis=1)
    crossed = (side[ends] > 0.0) != (side[others] > 0.0)
    one, other = ends[crossed], others[crossed]
    share = (side[one] / (side[one] - side[other]))[:, None]
    cut: Floats = (flat[one] + share * (flat[other] - flat[one])).reshape(-1, 2, 2)
    return cut


def _shells(surface: SurfaceData, axes: Floats, window: Floats) -> Floats:
    """The area of a surface in front of each pixel, in areas of a pixel, from below upwards."""
    across, high = (int(size) for size in np.ceil(np.ptp(window, axis=1) / PIXEL))
    total = np.zeros(high * across)
    corners = surface.vertices[surface.triangles]
    areas = triangle_areas(surface.vertices, surface.triangles)
    flat = (corners @ axes[:2].T - window[:, 0]) / PIXEL
    longest = np.linalg.norm(flat - np.roll(flat, 1, axis=1), axis=2).max(axis=1)
    # Each triangle as points closer to each other than pixels are, with their share of it.
    parts = np.ceil(2.0 * longest).astype(int).clip(1)
    for count in np.unique(parts).tolist():
        own = parts == count
        shares = _lattice(count)
        points = (shares @ flat[own].transpose(1, 0, 2).reshape(3, -1)).reshape(-1, 2)
        weights = np.tile(areas[own] / len(shares), len(shares))
        column, row = np.floor(points).astype(np.int64).T
        inside = (column >= 0) & (column < across) & (row >= 0) & (row < high)
        places = (row * across + column)[inside]
        total += np.bincount(places, weights[inside], minlength=len(total))
    return total.reshape(high, across) / PIXEL**2


def _lattice(count: int) -> Floats:
    """The middles of count² equal parts of a triangle, as shares of its corners."""
    i, j = np.mgrid[:count, :count].reshape(2, -1)
    up = np.stack([i, j], axis=1)[i + j < count] + 1.0 / 3.0
    down = np.stack([i, j], axis=1)[i + j < count - 1] + 2.0 / 3.0
    two: Floats = np.concatenate([up, down]) / count
    return np.concatenate([two, 1.0 - two.sum(axis=1, keepdims=True)], axis=1)
