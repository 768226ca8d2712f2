"""Ends of a head at the borders of its image: planes at which surfaces are closed."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cmfsim.values.checks import Floats
from cmfsim.values.surface_data import SurfaceData

# A surface is cut where so much of it lies in a plane at its end, mm²: the vertex of a round head
# has some 150 mm² there.
LEAST_CAP = 400.0
# Thickness of that plane, mm, and cosine of its normals to the axis.
CAP_DEPTH, CAP_NORMAL = 0.6, 0.95
ENDS = (("right", "left"), ("front", "back"), ("bottom", "top"))


@dataclass(frozen=True)
class CutPlane:
    """A plane across an axis at which a head is cut off.

    name: "right", "left", "front", "back", "bottom" or "top" border of the image.
    sign: 1 where the head would go on towards higher coordinates.
    place: mm.
    """

    name: str
    axis: int
    sign: float
    place: float

    def inside(self, point: Floats) -> float:
        """How far a point lies within the head from the plane, mm; negative beyond it."""
        return self.sign * (self.place - float(point[self.axis]))


def cut_planes(surfaces: Sequence[SurfaceData]) -> tuple[CutPlane, ...]:
    """The planes at which surfaces end flat: borders of the image, or a cut neck."""
    found = []
    for axis, names in enumerate(ENDS):
        for sign, name in zip((-1.0, 1.0), names, strict=True):
            caps = [_cap(surface, axis, sign) for surface in surfaces]
            places = [place for place, area in caps if area > LEAST_CAP]
            if places:
                # The outermost: a bone may end flat before the skin does.
                found.append(CutPlane(name, axis, sign, sign * max(sign * p for p in places)))
    return tuple(found)


def _cap(surface: SurfaceData, axis: int, sign: float) -> tuple[float, float]:
    """Place of the end of a surface along an axis, and the area that lies flat there."""
    corners = surface.vertices[surface.triangles.astype(np.int64)]
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = 0.5 * np.linalg.norm(doubled, axis=1)
    end = float(sign * (sign * corners[:, :, axis]).max())
    near = (np.abs(corners[:, :, axis] - end) < CAP_DEPTH).all(axis=1)
    flat = sign * doubled[:, axis] > CAP_NORMAL * 2.0 * areas
    return end, float(areas[near & flat].sum())
