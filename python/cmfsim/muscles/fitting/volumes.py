"""The volumes of closed muscles, and their derivatives with respect to the vertices."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmfsim.values.checks import Floats
from cmfsim.values.surface_data import SurfaceData


@dataclass(frozen=True, eq=False)
class Volumes:
    """Surfaces whose vertices are numbered consecutively, surface after surface.

    Attributes
    ----------
    triangles : tuple of (t, 3) int
        Of each surface.
    is_closed : tuple of bool
    begins : tuple of int
        The first vertex of each surface, then the number of all vertices.
    """

    triangles: tuple[NDArray[np.intp], ...]
    is_closed: tuple[bool, ...]
    begins: tuple[int, ...]

    @classmethod
    def of(cls, surfaces: Sequence[SurfaceData]) -> "Volumes":
        """The volumes of surfaces whose vertices are concatenated in this order."""
        begins = np.cumsum([0, *(len(s.vertices) for s in surfaces)])
        triangles = [s.triangles.astype(np.intp) for s in surfaces]
        return cls(tuple(triangles), tuple(map(_is_closed, triangles)), tuple(begins.tolist()))

    def part(self, values: Floats, surface: int) -> Floats:
        """The rows of an array that belong to a surface."""
        return values[self.begins[surface] : self.begins[surface + 1]]

    def enclosed(self, vertices: Floats) -> Floats:
        """The volume of each surface, (k,) mm³; a cone closes an open one."""
        volumes = []
        for i, triangles in enumerate(self.triangles):
            own = self.part(vertices, i)
            a, b, c = (own[triangles[:, corner]] - own[0] for corner in range(3))
            volumes.append(float(np.einsum("na,na->", a, np.cross(b, c))) / 6.0)
        return np.array(volumes)

    def slopes(self, vertices: Floats) -> tuple[Floats, Floats]:
        """The derivative of volume with respect to each vertex, (n, 3) mm², and areas, (k,) mm²."""
        slopes, areas = np.zeros_like(vertices), np.zeros(len(self.triangles))
        for i, triangles in enumerate(self.triangles):
            own = self.part(vertices, i)
            a, b, c = (own[triangles[:, corner]] for corner in range(3))
            cross = np.cross(b - a, c - a)
            areas[i] = 0.5 * np.linalg.norm(cross, axis=1).sum()
            # A third of the area vectors of the triangles round a vertex.
            for axis in range(3):
                weights = np.repeat(cross[:, axis] / 6.0, 3)
                sums = np.bincount(triangles.ravel(), weights, minlength=len(own))
                self.part(slopes, i)[:, axis] = sums
        return slopes, areas


def _is_closed(triangles: NDArray[np.intp]) -> bool:
    """Whether each edge is traversed once in either direction."""
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    n = int(triangles.max()) + 1
    forth, back = edges[:, 0] * n + edges[:, 1], edges[:, 1] * n + edges[:, 0]
    return bool(np.array_equal(np.sort(forth), np.sort(back)))
