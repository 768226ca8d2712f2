"""What a head shows of bone and skin: points with normals, and where the image cuts it off."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cmfsim.registration.proposed.pose import surface_samples
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


# Points on bone and skin that a fit is made with.
BONE_POINTS, SKIN_POINTS = 3000, 2500
# Points this near to a flat end, with a normal this far along it, lie on the cut, mm.
AT_END, ALONG_END = 1.5, 0.9
# A round field of view ends a head in an upright cylinder: tries, distance of its points from it in
# mm, agreement of their normals, and the share of the points that must lie on it.
TRIES, ON_CYLINDER, RADIAL, LEAST_SHARE = 400, 0.7, 0.97, 0.08
RADII = (45.0, 160.0)


@dataclass(frozen=True)
class Cylinder:
    """The wall of a round field of view: an upright axis and a radius, mm."""

    x: float
    y: float
    radius: float

    def depth(self, points: Floats) -> Floats:
        """How far inside points lie, (n,) mm."""
        result: Floats = self.radius - np.hypot(points[:, 0] - self.x, points[:, 1] - self.y)
        return result


@dataclass(frozen=True, eq=False)
class HeadSamples:
    """Points of a head of unknown pose, LPS mm, with outward unit normals, (n, 3) each.

    bone, bone_normals: (n, 3).
    skin, skin_normals: (k, 3). None where there is no skin.
    low, high: (3,), mm, between them the image shows the head; infinite where it does not end.
    field: The round field of view that cuts the head.
    """

    bone: Floats
    bone_normals: Floats
    skin: Floats
    skin_normals: Floats
    low: Floats
    high: Floats
    field: Cylinder | None = None

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

    def shows(self, points: Floats, margin: float) -> NDArray[np.bool_]:
        """Whether points lie in the image, farther than a margin from its ends, (n,)."""
        within = (points > self.low + margin) & (points < self.high - margin)
        inside: NDArray[np.bool_] = np.logical_and.reduce(within, axis=1)
        if self.field is not None:
            inside &= self.field.depth(points) > margin
        return inside

    def without_ends(self) -> "HeadSamples":
        """Without the points on the ends of the image, which are no surface of the head."""
        kept = []
        for points, normals in ((self.bone, self.bone_normals), (self.skin, self.skin_normals)):
            on_end = np.zeros(len(points), dtype=bool)
            for sign, ends in ((-1.0, self.low), (1.0, self.high)):
                near = sign * (ends - points) < AT_END
                on_end |= (near & (sign * normals > ALONG_END)).any(axis=1)
            if self.field is not None:
                on_end |= self.field.depth(points) < AT_END
            kept.append((points[~on_end], normals[~on_end]))
        (bone, bone_normals), (skin, skin_normals) = kept
        return replace(
            self, bone=bone, bone_normals=bone_normals, skin=skin, skin_normals=skin_normals
        )


def samples_of(bones: SurfaceData, skin: SurfaceData | None) -> HeadSamples:
    """The samples of surfaces in LPS: of all bone, divided or not, and of the skin."""
    bone, bone_normals = surface_samples(bones, BONE_POINTS)
    none = np.zeros((0, 3))
    on_skin = (none, none) if skin is None else surface_samples(skin, SKIN_POINTS)
    low, high = _ends([bones] if skin is None else [bones, skin])
    field = None if skin is None else _round_field(*on_skin)
    return HeadSamples(bone, bone_normals, *on_skin, low, high, field).without_ends()


def _ends(surfaces: Sequence[SurfaceData]) -> tuple[Floats, Floats]:
    low, high = np.full(3, -np.inf), np.full(3, np.inf)
    for cut in cut_planes(surfaces):
        (high if cut.sign > 0.0 else low)[cut.axis] = cut.place
    return low, high


def _round_field(points: Floats, normals: Floats) -> Cylinder | None:
    """The upright cylinder that many points of a skin lie on, to less than a millimetre."""
    upright = np.abs(normals[:, 2]) < 0.15
    if upright.sum() < LEAST_SHARE * len(points):
        return None
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
    best, cylinder = LEAST_SHARE * len(points), None
    for middle in middles[even]:
        away = p - middle
        distance = np.linalg.norm(away, axis=1)
        radial = (away * n).sum(axis=1) > RADIAL * distance
        if radial.sum() <= best:
            continue
        radius = float(np.median(distance[radial]))
        count = float((radial & (np.abs(distance - radius) < ON_CYLINDER)).sum())
        if count > best:
            best, cylinder = count, Cylinder(float(middle[0]), float(middle[1]), radius)
    return cylinder
