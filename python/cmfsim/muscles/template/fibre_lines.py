"""Fibre lines of flat muscles, in the middle between their two faces."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.errors import MeshInputError
from cmfsim.values.checks import Floats
from cmfsim.values.surface_data import SurfaceData

# Lines across a muscle, and points along each; a line's points lie a few millimetres apart.
LINES, POINTS = 9, 25
# Share of the width at either side that no line runs in: there the muscle is too thin to be met.
RIM = 0.06
# Share of a fan's length about its tip that lines end before: there they would all meet.
TIP = 0.04
# Area in the view, as a share of the largest triangle's, below which a triangle is seen edge on.
SIDEWAYS = 1e-12
# Places of a line that must lie on the muscle: fewer tell no direction.
LEAST_POINTS = 3


def fan_lines(
    surface: SurfaceData, tip: ArrayLike, normal: ArrayLike, *, lines: int = LINES
) -> tuple[Floats, ...]:
    """Lines from a broad origin that meet at a tip, such as those of temporalis at the coronoid.

    normal: (3,). Direction that the fan is looked at along.
    Returns: tuple of (n, 3), mm, from origin to tip, in the middle of the muscle.
    Raises `MeshError`: Less than two lines meet the muscle.
    """
    view = _View(surface, normal)
    centre = view.flat(np.asarray(tip, dtype=np.float64)[None])[0]
    offset = view.places - centre
    reach = np.linalg.norm(offset, axis=1)
    # Angles from the fan's own middle, so that no fan is cut by the turn at 180 degrees.
    middle = np.arctan2(*(offset[reach > 0.3 * reach.max()].sum(axis=0)[::-1]))
    far = reach > 0.2 * reach.max()
    angle = np.angle(np.exp(1j * (np.arctan2(offset[:, 1], offset[:, 0]) - middle)))[far]
    low, high = np.quantile(angle, (0.01, 0.99))
    rim = RIM * (high - low)
    found = []
    for turn in np.linspace(low + rim, high - rim, lines) + middle:
        ray = np.array([np.cos(turn), np.sin(turn)])
        steps = np.linspace(1.0, TIP, 2 * POINTS) * reach.max()
        found.append(view.lifted(centre + steps[:, None] * ray))
    return _kept(found)


def lane_lines(
    surface: SurfaceData, along: ArrayLike, normal: ArrayLike, *, lines: int = LINES
) -> tuple[Floats, ...]:
    """Parallel lines along a sheet, from origin to insertion, such as those of buccinator forwards.

    normal: (3,). Direction that the sheet is looked at along. Returns and raises as `fan_lines`.
    """
    view = _View(surface, normal)
    ahead = view.axes @ np.asarray(along, dtype=np.float64)
    ahead /= np.linalg.norm(ahead)
    across = np.array([-ahead[1], ahead[0]])
    place = view.places @ np.column_stack([ahead, across])
    low, high = place.min(axis=0), place.max(axis=0)
    rim = RIM * (high - low)[1]
    steps = np.linspace(low[0], high[0], 2 * POINTS)
    rows = np.linspace(low[1] + rim, high[1] - rim, lines)
    return _kept([view.lifted(steps[:, None] * ahead + row * across) for row in rows])


class _View:
    """A surface looked at along an axis: places in the plane, and the middle of it in depth."""

    def __init__(self, surface: SurfaceData, normal: ArrayLike) -> None:
        axis = np.asarray(normal, dtype=np.float64)
        axis = axis / np.linalg.norm(axis)
        helper = np.eye(3)[np.argmin(np.abs(axis))]
        first = np.cross(axis, helper)
        first /= np.linalg.norm(first)
        self.axes = np.array([first, np.cross(axis, first)])
        self._axis = axis
        vertices = surface.vertices
        self.places = self.flat(vertices)
        self._depths = vertices @ axis
        self._triangles = surface.triangles

    def flat(self, points: Floats) -> Floats:
        """Where points lie in the plane, (n, 2)."""
        flat: Floats = points @ self.axes.T
        return flat

    def lifted(self, places: Floats) -> Floats:
        """The middle of the muscle over the longest run of places that lie on it, (n, 3)."""
        corners = self.places[self._triangles]
        depths = self._depths[self._triangles]
        edge, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        area = edge[:, 0] * other[:, 1] - edge[:, 1] * other[:, 0]
        # Triangles seen from the side cover nothing.
        seen = np.abs(area) > SIDEWAYS * np.abs(area).max()
        corners, depths, area = corners[seen], depths[seen], area[seen]
        edge, other = edge[seen], other[seen]
        runs: list[list[Floats]] = [[]]
        for place in places:
            offset = place - corners[:, 0]
            v = (offset[:, 0] * other[:, 1] - offset[:, 1] * other[:, 0]) / area
            w = (edge[:, 0] * offset[:, 1] - edge[:, 1] * offset[:, 0]) / area
            over: NDArray[np.bool_] = (v >= 0.0) & (w >= 0.0) & (v + w <= 1.0)
            if np.count_nonzero(over) < 2:
                runs.append([])
                continue
            met = depths[over]
            rise, other_rise = met[:, 1] - met[:, 0], met[:, 2] - met[:, 0]
            depth = met[:, 0] + v[over] * rise + w[over] * other_rise
            # The layer that is met first and last: of a sheet, its two faces.
            middle = 0.5 * (depth.min() + depth.max())
            runs[-1].append(place @ self.axes + middle * self._axis)
        return np.array(max(runs, key=len)).reshape(-1, 3)


def _kept(found: list[Floats]) -> tuple[Floats, ...]:
    lines = tuple(line for line in found if len(line) >= LEAST_POINTS)
    if len(lines) < 2:
        raise MeshInputError(
            f"{len(lines)} fibre lines meet two faces of the muscle: two are needed; check that "
            "it is closed, and that the normal is that of the sheet"
        )
    return lines
