"""Partners of one skin's vertices on another, and how far apart they are (paper 3.2)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmfsim._core import Surface, ThinPlateSpline
from cmfsim.surfaces.barycentric import barycentric
from cmfsim.surfaces.topology import edges_of
from cmfsim.values.checks import Floats
from cmfsim.values.surface_data import SurfaceData, used_nodes

# A partner lies on the border if its distance from the border's edge, as a share of the height of
# its triangle, is below this: more than the rounding of a closest point at 1000 mm.
ON_EDGE = 1e-7
# Places in front of a vertex, mm, at which other skin covers it: the skin of closed lips touches or
# is a voxel apart, and no wall of tissue is thinner than a step.
IN_FRONT = (0.25, 1.0, 2.0, 3.0)


class Skin:
    """A surface ready to be searched, with the border that it may have."""

    def __init__(self, surface: SurfaceData | Surface) -> None:
        self.core = (
            surface
            if isinstance(surface, Surface)
            else Surface(surface.vertices, surface.triangles, crease_angle=surface.crease_angle)
        )
        self.vertices: Floats = self.core.vertices
        self.triangles: NDArray[np.int64] = self.core.triangles.astype(np.int64)
        border = np.sort(edges_of(self.triangles).border, axis=1)
        self._border_edges = np.sort(border @ np.array([len(self.vertices), 1]))
        self._on_border = np.zeros(len(self.vertices), dtype=bool)
        self._on_border[border] = True

    def vertex_areas(self) -> Floats:
        """A third of the area of the triangles round each vertex, (v,) mm²."""
        a, b, c = (self.vertices[self.triangles[:, i]] for i in range(3))
        third = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6.0
        return np.asarray(
            np.bincount(
                self.triangles.ravel(), weights=np.repeat(third, 3), minlength=len(self.vertices)
            ),
            dtype=np.float64,
        )

    def covered(self) -> NDArray[np.bool_]:
        """Which vertices have other skin within 3 mm in front of them, such as between lips, (v,).

        No camera sees them, and the two surfaces of a scan are fused there.
        """
        a, b, c = (self.vertices[self.triangles[:, i]] for i in range(3))
        weighted = np.cross(b - a, c - a)
        normals = np.zeros_like(self.vertices)
        for axis in range(3):
            normals[:, axis] = np.bincount(
                self.triangles.ravel(),
                weights=np.repeat(weighted[:, axis], 3),
                minlength=len(self.vertices),
            )
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0.0)
        # Where the vertex itself is nearest to the farthest place, nothing stands between them.
        farthest = IN_FRONT[-1]
        places = self.vertices + farthest * normals
        nearest, outward, _ = self.core.closest(places)
        covered: NDArray[np.bool_] = ((places - nearest) * outward).sum(axis=1) < 0.0
        apart = np.linalg.norm(places - nearest, axis=1)
        doubtful = ~covered & (apart < (1.0 - ON_EDGE) * farthest)
        for distance in IN_FRONT[:-1]:
            asked = np.flatnonzero(doubtful & ~covered)
            places = self.vertices[asked] + distance * normals[asked]
            nearest, outward, _ = self.core.closest(places)
            covered[asked] = ((places - nearest) * outward).sum(axis=1) < 0.0
        return covered

    def part(self, chosen: NDArray[np.bool_]) -> "Skin | None":
        """The triangles all of whose vertices are chosen; None if there is none."""
        kept = self.triangles[chosen[self.triangles].all(axis=1)]
        if not len(kept):
            return None
        used, triangles = used_nodes(kept)
        return Skin(SurfaceData(self.vertices[used], triangles))

    def at_border(self, points: Floats, triangles: NDArray[np.integer]) -> NDArray[np.bool_]:
        """Which points, each on the triangle named, lie on the border."""
        corners = self.triangles[triangles]
        near = np.zeros(len(points), dtype=bool)
        candidates = np.flatnonzero(self._on_border[corners].any(axis=1))
        if not len(candidates):
            return near
        corner = corners[candidates]
        weights = barycentric(self.vertices[corner], points[candidates])
        off = weights <= ON_EDGE
        single = off.sum(axis=1) >= 2
        at_vertex = single & self._on_border[corner[np.arange(len(corner)), weights.argmax(axis=1)]]
        on_edge = np.zeros(len(corner), dtype=bool)
        for opposite in range(3):
            ends = np.sort(np.delete(corner, opposite, axis=1), axis=1)
            key = ends @ np.array([len(self.vertices), 1])
            on_edge |= off[:, opposite] & np.isin(key, self._border_edges)
        near[candidates] = at_vertex | on_edge
        return near


@dataclass(frozen=True, eq=False)
class Matches:
    """Vertices of one skin with their partners on another.

    vertices: (k,) int64. Those that were kept.
    partners: (k, 3), mm.
    signed: (k,), mm. Distance to the partner; negative where the vertex lies behind the other skin.
    n_border, n_far: Left out because the partner lies on the other skin's border; or too far away.
    """

    vertices: NDArray[np.int64]
    partners: Floats
    signed: Floats
    n_border: int
    n_far: int


def match_skins(
    skin: Skin,
    chosen: NDArray[np.bool_],
    other: Skin,
    *,
    warp: ThinPlateSpline | None,
    max_distance: float | None,
    exclude_borders: bool,
) -> Matches:
    """The partners of the chosen vertices on another skin.

    With a warp the partner is the point of the other skin closest to the warped vertex, else to the
    vertex itself. The distance is that of the unwarped vertex; its sign is the side of the other
    skin on which the vertex lies, seen from the place nearest to it: a partner further off may lie
    round a bend.
    """
    vertices = np.flatnonzero(chosen)
    places = skin.vertices[vertices]
    nearest, normals, triangles = other.core.closest(places)
    behind = ((places - nearest) * normals).sum(axis=1) < 0.0
    partners = nearest
    if warp is not None:
        partners, _, triangles = other.core.closest(warp(places))
    apart = np.linalg.norm(places - partners, axis=1)
    border = np.zeros(len(vertices), dtype=bool)
    if exclude_borders:
        border = other.at_border(partners, triangles)
    far = np.zeros(len(vertices), dtype=bool)
    if max_distance is not None:
        far = ~border & (apart > max_distance)
    kept = ~border & ~far
    return Matches(
        vertices[kept],
        partners[kept],
        np.where(behind, -apart, apart)[kept],
        int(border.sum()),
        int(far.sum()),
    )
