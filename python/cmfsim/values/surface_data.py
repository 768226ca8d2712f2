"""Triangle surfaces, several as one, and surfaces before and after a motion."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim._core import Surface
from cmfsim.errors import CaseInputError
from cmfsim.values.checks import (
    Floats,
    Frozen,
    Indices,
    as_index_rows,
    as_number,
    as_rows,
    brief,
    keep,
)


def used_nodes(cells: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The nodes that cells use, (k,) ascending, and the cells (c, 3) or (c, 4) in those numbers.

    Both int64. Cells may be signed or not, none negative, of nodes or of a surface's vertices.
    """
    used = np.zeros(int(cells.max(initial=0)) + 1, dtype=bool)
    used[cells] = True
    number = np.cumsum(used, dtype=np.int64) - 1
    return np.flatnonzero(used).astype(np.int64), number[cells]


def are_among(keys: NDArray[np.int64], others: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which keys of edges (k,) are among others, which ascend: a third of the time of `np.isin`.

    `keys` must be empty if `others` is.
    """
    places = np.minimum(np.searchsorted(others, keys), len(others) - 1)
    found: NDArray[np.bool_] = others[places] == keys
    return found


def area_vectors(vertices: Floats, triangles: NDArray[np.integer]) -> Floats:
    """The normal of each triangle, as long as its area, (t, 3) mm²."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    return np.asarray(0.5 * np.cross(b - a, c - a))


def triangle_areas(vertices: Floats, triangles: NDArray[np.integer]) -> Floats:
    """The area of each triangle, (t,) mm²."""
    return np.asarray(np.linalg.norm(area_vectors(vertices, triangles), axis=1))


def vertex_areas(vertices: Floats, triangles: NDArray[np.integer]) -> Floats:
    """A third of the area of the triangles round each vertex, (v,) mm²."""
    thirds = np.repeat(triangle_areas(vertices, triangles) / 3.0, 3)
    return np.bincount(triangles.ravel(), thirds, len(vertices)).astype(np.float64)


@dataclass(frozen=True, eq=False)
class SurfaceData(Frozen):
    """A triangle surface.

    Attributes
    ----------
    vertices : (v, 3) float64, mm
    triangles : (t, 3) uint32
        Outward normals by the right-hand rule.
    crease_angle : float, degrees
        Edges sharper than this keep the normals of their triangles apart.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.SurfaceData([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]).vertices.shape
    (3, 3)
    """

    vertices: Floats
    triangles: Indices
    crease_angle: float

    __repr__ = brief

    def __init__(
        self, vertices: ArrayLike, triangles: ArrayLike, crease_angle: float = 60.0
    ) -> None:
        places = as_rows("surface vertices", vertices, 3)
        corners = as_index_rows("surface triangles", triangles, 3, len(places), "vertices")
        crease_angle = as_number("crease_angle", crease_angle)
        keep(self, vertices=places, triangles=corners, crease_angle=crease_angle)

    @cached_property
    def searched(self) -> Surface:
        """The surface of the core, made once: its search tree takes longer than most searches."""
        return Surface(self.vertices, self.triangles, crease_angle=self.crease_angle)

    def has_triangles_of(self, other: "SurfaceData") -> bool:
        """Whether another surface has the same triangles, so that its vertices are this one's."""
        same = len(self.vertices) == len(other.vertices)
        return same and np.array_equal(self.triangles, other.triangles)

    def __getstate__(self) -> dict[str, Any]:
        """The fields alone: the core's surface stays where it was made."""
        return {field.name: getattr(self, field.name) for field in fields(self)}


def joined_surface(surfaces: Sequence[SurfaceData]) -> SurfaceData:
    """Several surfaces as one, each a piece of its own."""
    starts = np.cumsum([0, *(len(surface.vertices) for surface in surfaces)])[:-1]
    triangles = [
        surface.triangles.astype(np.int64) + start
        for surface, start in zip(surfaces, starts, strict=True)
    ]
    vertices = [surface.vertices for surface in surfaces]
    return SurfaceData(np.concatenate(vertices), np.concatenate(triangles))


@dataclass(frozen=True, eq=False)
class MovedSurface(Frozen):
    """A motion of a segment given by a surface before and after.

    Attributes
    ----------
    surface : SurfaceData
    moved_vertices : (v, 3) float64, mm
        Position of each vertex of `surface` after the motion.

    Examples
    --------
    >>> import cmfsim
    >>> bone = cmfsim.SurfaceData([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    >>> cmfsim.MovedSurface(bone, bone.vertices + [0, 0, 2.0]).moved_vertices[0].tolist()
    [0.0, 0.0, 2.0]
    """

    surface: SurfaceData
    moved_vertices: Floats

    def __init__(self, surface: SurfaceData, moved_vertices: ArrayLike) -> None:
        moved = as_rows("moved_vertices", moved_vertices, 3)
        count = len(surface.vertices)
        if len(moved) != count:
            raise CaseInputError(
                f"moved_vertices has {len(moved)} rows, but the surface has {count} vertices"
            )
        keep(self, surface=surface, moved_vertices=moved)
