"""What a head shows of bone and skin: points with normals, and where the image cuts it off."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import third_party
from cmfsim.registration.proposed.pose import surface_samples
from cmfsim.values.checks import Floats
from cmfsim.values.shown_region import ShownRegion
from cmfsim.values.surface_data import (
    SurfaceData,
    are_among,
    area_vectors,
    triangle_areas,
    used_nodes,
)

# A surface is cut where so much of it lies in a plane at its end, or is missing there within an
# open border, mm²: the vertex of a round head has some 150 mm² there.
LEAST_CAP = 400.0
# Thickness of that plane, mm, and cosine of its normals to the axis.
CAP_DEPTH, CAP_NORMAL = 0.6, 0.95
# A layer that is so many times as thick has so many times the area at the end of a ball
# (Archimedes), the root of it at the side of a cylinder, as a neck is, and no more at a flat end.
# An oblique end has to be nearer to the last: the second is the root of the cylinder's.
THICKER, MOST_AREA = 5.0, 1.5
# Flat ends of other directions are faces of the convex hull of so many vertices; no triangle of
# such a face is smaller than this, mm².
HULL_POINTS, SMALL_FACE = 20_000, 10.0
ENDS = ("right", "left", "front", "back", "bottom", "top")
# The same next to padding, mm, and the cosine between planes that are the same.
PADDED_DEPTH, SAME = 2.0, 0.999


@dataclass(frozen=True, eq=False)
class CutPlane:
    """A plane at which a head is cut off.

    name: "right", "left", "front", "back", "bottom" or "top": where it ends the head.
    normal: (3,), unit, towards what is not shown.
    place: Along the normal, mm.
    """

    name: str
    normal: Floats
    place: float

    def inside(self, point: Floats) -> float:
        """How far a point lies within the head from the plane, mm; negative beyond it."""
        return self.place - float(point @ self.normal)


def cut_planes(
    surfaces: Sequence[SurfaceData], shown: ShownRegion | None = None
) -> tuple[CutPlane, ...]:
    """The planes at which surfaces end flat: borders of the image, padding, or a cut neck."""
    ends = [(sign * np.eye(3)[axis], CAP_DEPTH) for axis in range(3) for sign in (-1.0, 1.0)]
    shapes = [_SHAPES.get(s) or _SHAPES.setdefault(s, _Shape.of(s)) for s in surfaces]
    if shown is not None:
        # Voxels make steps of a plane that runs obliquely.
        ends += [(normal, PADDED_DEPTH) for normal in shown.normals]
    oblique = len(ends)
    ends += [(normal, CAP_DEPTH) for shape in shapes for normal in shape.flat_ends]
    found: list[CutPlane] = []
    for row, (normal, depth) in enumerate(ends):
        caps = [shape.cap(normal, depth) for shape in shapes]
        places = [place for place, area in caps if area > LEAST_CAP]
        if row >= oblique:
            # Where another surface goes on, as bone does beyond a mask of skin, nothing ends.
            places *= max(places, default=-np.inf) > max(place for place, _ in caps) - PADDED_DEPTH
        elif row >= len(ENDS) and shown is not None:
            near = shown.places[row - len(ENDS)] - depth
            places = [place for place in places if place > near]
        if places and not any(cut.normal @ normal > SAME for cut in found):
            # The outermost: a bone may end flat before the skin does.
            axis = int(np.argmax(np.abs(normal)))
            found.append(CutPlane(ENDS[2 * axis + int(normal[axis] > 0.0)], normal, max(places)))
    return tuple(found)


@dataclass(frozen=True, eq=False)
class _Shape:
    """A surface with what its flat ends are found from.

    vertices: (n, 3), mm.
    corners: (3, t). The rows of each triangle's vertices.
    areas: (t, 3), mm². The normal of each triangle, as long as its area.
    borders: (2, b). The rows of the ends of each open edge.
    """

    vertices: Floats
    corners: NDArray[np.int64]
    areas: Floats
    borders: NDArray[np.int64]

    @classmethod
    def of(cls, surface: SurfaceData) -> "_Shape":
        used, corners = used_nodes(surface.triangles)
        vertices = surface.vertices[used]
        starts, ends, count = corners.ravel(), corners[:, [1, 2, 0]].ravel(), len(vertices)
        is_open = ~are_among(starts * count + ends, np.sort(ends * count + starts))
        borders = np.stack([starts[is_open], ends[is_open]])
        areas = area_vectors(vertices, corners)
        return cls(vertices, np.ascontiguousarray(corners.T), areas, borders)

    def cap(self, normal: Floats, depth: float) -> tuple[float, float]:
        """Place of the end along a direction, and the area that lies flat, or is missing, there."""
        along = self.vertices @ normal
        near = along.max() - along < depth
        return float(along.max()), self._flat(normal, near) + self._missing(normal, near)

    @cached_property
    def flat_ends(self) -> tuple[Floats, ...]:
        """The directions, (3,), in which the surface ends flat or open, of its convex hull."""
        return tuple(self._flat_ends())

    def _flat_ends(self) -> Iterator[Floats]:
        spatial = third_party("scipy.spatial", "landmarks are proposed", "imaging")
        points = self.vertices[:: max(1, len(self.vertices) // HULL_POINTS)]
        try:
            hull = spatial.ConvexHull(points)
        except spatial.QhullError:
            # All points lie in a plane.
            return
        areas = triangle_areas(points, hull.simplices)
        normals, left = hull.equations[:, :3], np.ones(len(areas), dtype=bool)
        while left.any():
            normal = normals[left][np.argmax(areas[left])]
            alike = left & (normals @ normal > SAME)
            left &= ~alike
            if areas[alike].sum() > LEAST_CAP and self._ends_flat(normal):
                yield normal
            elif areas[left].max(initial=0.0) < SMALL_FACE:
                return

    def _ends_flat(self, normal: Floats) -> bool:
        along = self.vertices @ normal
        away = along.max() - along
        near = away < CAP_DEPTH
        missing = self._missing(normal, near)
        area = self._flat(normal, near) + missing
        if area <= LEAST_CAP:
            return False
        return self._flat(normal, away < THICKER * CAP_DEPTH) + missing < MOST_AREA * area

    def _flat(self, normal: Floats, near: NDArray[np.bool_]) -> float:
        """The area of the triangles between some vertices that face along a direction."""
        areas = self.areas[near[self.corners].all(axis=0)]
        sizes = np.linalg.norm(areas, axis=1)
        return float(sizes[areas @ normal > CAP_NORMAL * sizes].sum())

    def _missing(self, normal: Floats, near: NDArray[np.bool_]) -> float:
        """The area that open borders between some vertices enclose, seen along a direction."""
        starts, ends = self.borders[:, near[self.borders].all(axis=0)]
        if not len(starts):
            return 0.0
        # By Stokes' theorem; triangles run the other way round than the cap that they lack.
        first = self.vertices[starts[0]]
        one, two = (self.vertices[rows] - first for rows in (starts, ends))
        return max(-0.5 * float(np.cross(one, two).sum(axis=0) @ normal), 0.0)


# Those of surfaces in use: the skin is asked for its ends beside all bone, then beside some.
_SHAPES: WeakKeyDictionary[SurfaceData, _Shape] = WeakKeyDictionary()

# Points on bone and skin that a fit is made with.
BONE_POINTS, SKIN_POINTS = 3000, 2500
# Points this near to a flat end, with a normal this far along it, lie on the cut, mm.
AT_END, ALONG_END = 1.5, 0.9
# A plane whose normal has a larger share along z ends the head above.
UPWARDS = 0.7
# A round field of view ends a head in an upright cylinder: tries, distance of its points from it in
# mm, agreement of their normals, and the share of the points that must lie on it.
TRIES, ON_CYLINDER, RADIAL, LEAST_SHARE = 400, 0.7, 0.97, 0.08
RADII = (45.0, 160.0)
# Angle between the planes that stand for its wall: they lie within 0.1 mm of it.
WALL_STEP = np.deg2rad(4.0)


@dataclass(frozen=True, eq=False)
class HeadSamples:
    """Points of a head of unknown pose, LPS mm, with outward unit normals, (n, 3) each.

    bone, bone_normals: (n, 3).
    skin, skin_normals: (k, 3). None where there is no skin.
    shown: What the image shows of the head, mm.
    """

    bone: Floats
    bone_normals: Floats
    skin: Floats
    skin_normals: Floats
    shown: ShownRegion

    def fewer(self, count: int) -> "HeadSamples":
        """Some of the points, about `count` of bone and of skin."""
        bone, skin = (max(1, len(p) // count) for p in (self.bone, self.skin))
        return replace(
            self,
            bone=self.bone[::bone],
            bone_normals=self.bone_normals[::bone],
            skin=self.skin[::skin],
            skin_normals=self.skin_normals[::skin],
        )

    @property
    def ends_above(self) -> bool:
        """Whether a part of the head above may be missing."""
        return bool((self.shown.normals[:, 2] > UPWARDS).any())

    def shows(self, points: Floats, margin: float) -> NDArray[np.bool_]:
        """Whether points lie in the image, farther than a margin from its ends, (n,)."""
        inside: NDArray[np.bool_] = self.shown.depth(points) > margin
        return inside

    def without_ends(self) -> "HeadSamples":
        """Without the points on the ends of the image, which are no surface of the head."""
        kept = []
        for points, normals in ((self.bone, self.bone_normals), (self.skin, self.skin_normals)):
            near = self.shown.depths(points) < AT_END
            on_end = (near & (normals @ self.shown.normals.T > ALONG_END)).any(axis=1)
            kept.append((points[~on_end], normals[~on_end]))
        (bone, bone_normals), (skin, skin_normals) = kept
        return replace(
            self, bone=bone, bone_normals=bone_normals, skin=skin, skin_normals=skin_normals
        )


def samples_of(
    bones: SurfaceData, skin: SurfaceData | None, padded: ShownRegion | None = None
) -> HeadSamples:
    """The samples of surfaces in LPS: of all bone, divided or not, and of the skin.

    padded: What padding surrounds in the image that they were made from.
    """
    bone, bone_normals = surface_samples(bones, BONE_POINTS)
    none = np.zeros((0, 3))
    on_skin = (none, none) if skin is None else surface_samples(skin, SKIN_POINTS)
    cuts = cut_planes([bones] if skin is None else [bones, skin], padded)
    normals = np.array([cut.normal for cut in cuts]).reshape(-1, 3)
    shown = ShownRegion(normals, np.array([cut.place for cut in cuts]))
    if skin is not None:
        shown = shown.and_behind(_round_field(*on_skin))
    return HeadSamples(bone, bone_normals, *on_skin, shown).without_ends()


def _round_field(points: Floats, normals: Floats) -> ShownRegion:
    """The upright cylinder that many points of a skin lie on, to less than a millimetre."""
    around = np.arange(0.0, 2.0 * np.pi, WALL_STEP)
    wall = np.column_stack([np.cos(around), np.sin(around), np.zeros(len(around))])
    everything = ShownRegion(np.zeros((0, 3)), np.zeros(0))
    upright = np.abs(normals[:, 2]) < 0.15
    if upright.sum() < LEAST_SHARE * len(points):
        return everything
    p, n = points[upright, :2], normals[upright, :2]
    n = n / np.linalg.norm(n, axis=1)[:, None]
    generator = np.random.default_rng(0)
    first, second = generator.integers(len(p), size=(2, TRIES))
    # Where the normals of two points meet, at the same distance from both.
    cross = n[first, 0] * n[second, 1] - n[first, 1] * n[second, 0]
    usable = np.abs(cross) > 0.2
    first, second, cross = first[usable], second[usable], cross[usable]
    gap = p[second] - p[first]
    along = (gap[:, 0] * n[second, 1] - gap[:, 1] * n[second, 0]) / cross
    middles = p[first] + along[:, None] * n[first]
    radii = np.linalg.norm(p[second] - middles, axis=1)
    even = (along < 0.0) & (np.abs(radii + along) < 2.0) & (radii > RADII[0]) & (radii < RADII[1])
    best, cylinder = LEAST_SHARE * len(points), everything
    for middle in middles[even]:
        away = p - middle
        distance = np.linalg.norm(away, axis=1)
        radial = (away * n).sum(axis=1) > RADIAL * distance
        if radial.sum() <= best:
            continue
        radius = float(np.median(distance[radial]))
        count = float((radial & (np.abs(distance - radius) < ON_CYLINDER)).sum())
        if count > best:
            best, cylinder = count, ShownRegion(wall, wall[:, :2] @ middle + radius)
    return cylinder
