"""Lips of a virtual patient: an open mouth, and frictionless, one-sided contact as they meet.

The slit in the skin of the phantom ends in front of the teeth, as on a CT. Lips that touch and
slide need separate surfaces: here the slit extends from corner to corner and back to the space
between the tooth rows. Everything is a level function, so that the surfaces of the mesh are smooth.

Their contact belongs to the true face. It is a penalty on distances between deformed triangles, and
shares neither the seam, nor the active set, nor any code with the models under test.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim._core import Surface, signed_distance_image
from cmfsim.errors import CaseInputError, third_party
from cmfsim.lab.virtual.mechanics.equilibrium import penalty
from cmfsim.phantom.model import PhantomHead
from cmfsim.phantom.parameters import JawWarp
from cmfsim.phantom.skull import UPPER_ARCH
from cmfsim.values.anatomy import Anatomy
from cmfsim.values.checks import Floats

# The slit between the lips in the canonical head, mm: distance from the midline and height of its
# line, as in the phantom's skin. Its thickness is constant almost to the corner, because the mesh
# does not resolve a slit that narrows like the skin's.
DISTANCE = np.array([0.0, 12.0, 25.0])
LINE = np.array([-44.4, -44.0, -44.5])
# It is rounded from here to its end, mm from the midline: the corner of the mouth.
ROUNDED_FROM, CORNER = 20.0, 23.5
# Smallest gap between the lips of the phantom, mm: a narrower slit closes in the mesh.
LEAST_GAP = 1.0
# Extent of the lips above and below the line of the mouth, to the side, and past the middle of the
# tooth rows, mm. The parts that may touch the other lip are smaller by a margin, so that no closest
# point is at a border.
LIP_HEIGHT, LIP_SIDE, LIP_BACK = 16.0, 25.0, 4.0
MARGIN = 4.0
# Spacing of the surfaces of the tooth rows, and the range of their distances, mm.
TEETH_SPACING, TEETH_REACH = 1.0, 12.0


@dataclass(frozen=True, eq=False)
class MouthSlit:
    """The slit between the lips of a phantom with a gap between them of `LEAST_GAP` or more."""

    head: PhantomHead

    def __post_init__(self) -> None:
        gap = self.head.parameters.lip_gap
        if gap < LEAST_GAP:
            raise CaseInputError(
                f"lip_gap is {gap:g} mm: {LEAST_GAP:g} mm or more is needed where lips are "
                "separate, because the mesh does not resolve a narrower slit"
            )

    def _drawn(self, points: Floats) -> tuple[Floats, Floats, Floats]:
        """Distance from the midline, front-to-back position, height in the canonical head, mm."""
        p = self.head.parameters
        u, v, w = self.head.warp.inverse(*points.T)
        u, v, w = JawWarp(p, soft=True).inverse(np.abs(u), v, w)
        return np.asarray(u), np.asarray(v), np.asarray(w)

    def height(self, points: Floats) -> Floats:
        """Height of points (k, 3) above the line of the mouth, (k,) mm; negative below it."""
        u, _, w = self._drawn(points)
        height: Floats = self.head.parameters.scale * (w - np.interp(u, DISTANCE, LINE))
        return height

    def level(self, points: Floats) -> Floats:
        """The level of the slit at points (k, 3), (k,) mm: positive between the lips."""
        p = self.head.parameters
        u, v, w = self._drawn(points)
        past = np.clip((u - ROUNDED_FROM) / (CORNER - ROUNDED_FROM), 0.0, 1.0)
        half = 0.5 * p.lip_gap * np.sqrt(1.0 - past**2) - np.maximum(u - CORNER, 0.0)
        level = half - np.abs(w - np.interp(u, DISTANCE, LINE))
        # It ends in the middle of the upper tooth row.
        slit: Floats = p.scale * np.minimum(level, _arch(u) - v)
        return slit

    def lips(self, points: Floats, margin: float = 0.0) -> NDArray[np.int8]:
        """The lip to which points (k, 3) belong, (k,): 1 the upper, −1 the lower, 0 none.

        Only points further inside than the margin, mm, count.
        """
        u, v, _ = self._drawn(points)
        height = self.height(points)
        near = (u < LIP_SIDE - margin) & (np.abs(height) < LIP_HEIGHT - margin)
        near &= v < _arch(u) + LIP_BACK - margin
        return np.where(near, np.sign(height), 0.0).astype(np.int8)


def _arch(u: Floats) -> Floats:
    """Position from front to back of the middle line of the upper tooth row, mm."""
    x, y = np.array(UPPER_ARCH).T
    position: Floats = np.interp(u, x, y)
    return position


def with_open_mouth(head: PhantomHead, anatomy: Anatomy, bite: float) -> Anatomy:
    """The anatomy without tissue in the slit between the lips and between the tooth rows.

    bite: mm. There is no tissue where the distances to both tooth rows add up to less than this.
    """
    slit = MouthSlit(head)
    skin = anatomy.skin
    spacing, lowest = skin.spacing, skin.lowest
    rows = [head.surface(name, TEETH_SPACING) for name in ("upper_teeth", "lower_teeth")]
    places = np.vstack([row.vertices for row in rows])
    low, high = places.min(axis=0) - TEETH_REACH, places.max(axis=0) + TEETH_REACH
    # The slit begins in front of the lips.
    low[1] -= 2.0 * TEETH_REACH
    first = np.maximum(np.floor((low - lowest) / spacing).astype(int), 0)
    last = np.minimum(np.ceil((high - lowest) / spacing).astype(int) + 1, skin.values.shape)
    start = lowest + first * spacing
    shape = (int(last[0] - first[0]), int(last[1] - first[1]), int(last[2] - first[2]))
    axes = [start[a] + spacing[a] * np.arange(shape[a]) for a in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    air = slit.level(points).reshape(shape)
    between = np.full(shape, float(bite))
    (sx, sy, sz), (x, y, z) = spacing.tolist(), start.tolist()
    for row in rows:
        surface = Surface(row.vertices, row.triangles)
        between += signed_distance_image(surface, shape, (sx, sy, sz), (x, y, z), band=TEETH_REACH)
    # Half, because the sum of two distances changes twice as fast as one of them.
    air = np.maximum(air, 0.5 * between)
    values = np.array(skin.values)
    index = tuple(slice(a, b) for a, b in zip(first, last, strict=True))
    values[index] = np.minimum(values[index], -air.astype(values.dtype))
    return replace(anatomy, skin=skin.with_values(values))


# Pressure per depth of penetration, MPa/mm: under the pressures between lips (a few kPa), they
# penetrate by less than a tenth of a millimetre. With a stiffer contact, Newton's method stalls
# where rough surfaces slide.
STIFFNESS = 0.2
# Depth over which the stiffness grows to its full value, mm.
ONSET = 0.05
# Number of triangles, those with the nearest centroids, searched for a node's closest point.
CANDIDATES = 32
# A node deeper than this, mm, lies behind the other lip, not in it: lips are more than twice as
# thick, and a Newton step that leads further is shortened.
DEEPEST = 4.0
# Smallest cosine between the direction to the border of a lip's surface and the normal there for
# which a node counts as behind the surface.
BEHIND = 0.7
# Barycentric weights below this count as zero: the closest point is on an edge or at a corner.
ON_EDGE = 1e-9


@dataclass(frozen=True, eq=False)
class Lip:
    """The surface of one lip: boundary triangles (t, 3), outward normals.

    nodes: (k,). Those of the triangles that may touch the other lip.
    area: (k,), mm². Boundary area around each.
    """

    triangles: NDArray[np.int64]
    nodes: NDArray[np.int64]
    area: Floats

    @classmethod
    def of(cls, triangles: NDArray[Any], area: Floats, nodes: NDArray[Any] | None = None) -> "Lip":
        """The lip of boundary triangles (t, 3), whose nodes may all touch the other lip by default.

        area: (n,), mm², of every node of the mesh.
        """
        chosen = np.unique(triangles if nodes is None else nodes).astype(np.int64)
        return cls(triangles.astype(np.int64), chosen, area[chosen])

    @cached_property
    def neighbours(self) -> NDArray[np.int64]:
        """The triangle across the edge opposite each corner, (t, 3); −1 at the border."""
        t = len(self.triangles)
        ends = [np.roll(self.triangles, shift, axis=1) for shift in (-1, 1)]
        edges = np.sort(np.stack(ends, axis=2), axis=2).reshape(-1, 2)
        number = np.unique(edges, axis=0, return_inverse=True)[1].reshape(-1)
        order = np.argsort(number, kind="stable")
        pairs = np.flatnonzero(number[order][1:] == number[order][:-1])
        found = np.full(3 * t, -1, dtype=np.int64)
        one, other = order[pairs], order[pairs + 1]
        found[one], found[other] = other // 3, one // 3
        return found.reshape(t, 3)

    @cached_property
    def border_nodes(self) -> NDArray[np.int64]:
        """Nodes of edges that belong to a single triangle."""
        bare = self.neighbours < 0
        ends = [self.triangles[np.roll(bare, shift, axis=1)] for shift in (1, 2)]
        return np.unique(np.concatenate(ends))


def lips_of(
    slit: MouthSlit, nodes: Floats, boundary: NDArray[Any], area: Floats
) -> tuple[Lip, Lip]:
    """The upper and the lower lip: boundary triangles (t, 3) whose nodes all belong to one of them.

    area: (n,), mm². Boundary area around each node (n, 3).
    """
    side, inner = slit.lips(nodes)[boundary], slit.lips(nodes, MARGIN)
    lips = []
    for name, which in (("upper", 1), ("lower", -1)):
        triangles = boundary[(side == which).all(axis=1)]
        meeting = np.intersect1d(triangles, np.flatnonzero(inner == which))
        if not len(meeting):
            raise CaseInputError(f"the mesh has no surface of the {name} lip")
        lips.append(Lip.of(triangles, area, meeting))
    return lips[0], lips[1]


@dataclass(frozen=True, eq=False)
class _Touch:
    """Nodes of one lip that are inside the other, with their closest points on it.

    corners: (c, 4) int64. The node, and the three of the triangle.
    parts: (c, 4). 1, and the negative weights of the closest point: parts @ places is the vector
        from the closest point to the node.
    normal: (c, 3). Unit vectors along which the distance grows.
    swing: (c, 3, 3). Projections onto the directions in which a moving node rotates the normal:
        none on a face, one on an edge, two at a corner.
    depth, area: (c,), mm and mm².
    """

    corners: NDArray[np.int64]
    parts: Floats
    normal: Floats
    swing: Floats
    depth: Floats
    area: Floats


@dataclass(frozen=True, eq=False)
class LipContact:
    """Two lips that push each other apart, without friction; nodes (n, 3) mm at rest are apart.

    The nodes of each lip are pushed out of the other with half the pressure, so that neither lip is
    the master. The stiffness, MPa/mm, grows to its full value over the depth `onset`, mm.
    """

    points: Floats
    upper: Lip
    lower: Lip
    stiffness: float = STIFFNESS
    onset: float = ONSET

    def penetration(self, displacements: Floats) -> float:
        """Largest depth of a node inside the other lip, mm."""
        return max(float(touch.depth.max(initial=0.0)) for touch in self._touches(displacements))

    def touching(self, displacements: Floats) -> int:
        """Number of nodes, of both lips, that press on the other lip."""
        return sum(int(np.count_nonzero(t.depth > 0.0)) for t in self._touches(displacements))

    def energy(self, displacements: Floats, part: float) -> float:
        """∫ ∫ pressure d(depth) d(area), N·mm, half of it from each lip."""
        del part
        total = 0.0
        for touch in self._touches(displacements):
            total += 0.5 * float(touch.area @ penalty(touch.depth, self.onset)[0])
        return self.stiffness * total

    def forces(self, displacements: Floats, part: float) -> tuple[Floats, Floats]:
        """The gradient of the energy, (n, 3) N; blocks of single nodes are in `coupling`."""
        del part
        force = np.zeros_like(self.points)
        for touch in self._touches(displacements):
            weight = -self._pressing(touch)
            shares = (weight[:, None] * touch.parts)[:, :, None] * touch.normal[:, None, :]
            np.add.at(force, touch.corners, shares)
        return force, np.zeros((len(self.points), 3, 3))

    def _pressing(self, touch: _Touch) -> Floats:
        """Half of the contact force on each node, (c,) N: the other lip adds its half."""
        return 0.5 * self.stiffness * touch.area * penalty(touch.depth, self.onset)[1]

    def coupling(self, displacements: Floats, part: float) -> Any:
        """∂ forces / ∂ displacements, (3n, 3n) N/mm, with the closest feature of each node frozen.

        On a face, the normal is frozen as well; on an edge or at a corner it rotates and stiffens.
        """
        del part
        rows, columns, data = [], [], []
        for touch in self._touches(displacements):
            rise = 0.5 * self.stiffness * touch.area * penalty(touch.depth, self.onset)[2]
            along = rise[:, None, None] * touch.normal[:, :, None] * touch.normal[:, None, :]
            lever = self._pressing(touch) / np.maximum(touch.depth, np.finfo(np.float64).tiny)
            along += lever[:, None, None] * touch.swing
            pairs = touch.parts[:, :, None] * touch.parts[:, None, :]
            rows.append(np.repeat(touch.corners, 4, axis=1).ravel())
            columns.append(np.tile(touch.corners, (1, 4)).ravel())
            data.append((pairs.reshape(-1, 16, 1, 1) * along[:, None]).reshape(-1, 3, 3))
        n = len(self.points)
        return _block_matrix(np.concatenate(rows), np.concatenate(columns), np.concatenate(data), n)

    def _touches(self, displacements: Floats) -> tuple[_Touch, _Touch]:
        """The nodes of the upper lip in the lower, and those of the lower in the upper."""
        places = self.points + displacements
        return (_touch(places, self.upper, self.lower), _touch(places, self.lower, self.upper))


def _touch(places: Floats, lip: Lip, other: Lip) -> _Touch:
    """The nodes of a lip that are inside the other."""
    triangle, weights = _closest(places[lip.nodes], places, other.triangles)
    at = other.triangles[triangle]
    way = places[lip.nodes] - np.einsum("ck,cki->ci", weights, places[at])
    normal = _outward(places, other, triangle, weights)
    distance = np.linalg.norm(way, axis=1)
    behind = -(way * normal).sum(axis=1)
    # A node closest to the border is inside only if it is nearly straight behind it.
    least = np.where(_on_border(other, triangle, weights), BEHIND * distance, 0.0)
    inside = (behind > least) & (distance < DEEPEST)
    at, weights, depth = at[inside], weights[inside], distance[inside]
    # On the surface itself, the direction is undefined and the force zero.
    along = -way[inside] / np.maximum(depth, np.finfo(np.float64).tiny)[:, None]
    nodes = lip.nodes[inside]
    swing = _swing(along, places[at], weights)
    return _Touch(
        np.column_stack([nodes, at]),
        np.column_stack([np.ones(len(nodes)), -weights]),
        along,
        swing,
        depth,
        lip.area[inside],
    )


def _swing(normal: Floats, corners: Floats, weights: Floats) -> Floats:
    """The projections of `_Touch.swing`, (c, 3, 3), at points of triangles (c, 3, 3)."""
    none = weights <= ON_EDGE
    count = none.sum(axis=1)
    found = np.eye(3) - normal[:, :, None] * normal[:, None, :]
    found[count == 0] = 0.0
    edge = np.flatnonzero(count == 1)
    opposite = none[edge].argmax(axis=1)
    way = corners[edge, (opposite + 2) % 3] - corners[edge, (opposite + 1) % 3]
    way /= np.maximum(np.linalg.norm(way, axis=1), np.finfo(np.float64).tiny)[:, None]
    found[edge] -= way[:, :, None] * way[:, None, :]
    return found


def _closest(
    points: Floats, places: Floats, triangles: NDArray[np.int64]
) -> tuple[NDArray[np.int64], Floats]:
    """The triangle closest to each point, and the weights of its closest point.

    Only the `CANDIDATES` triangles with the nearest centroids are searched.
    """
    spatial = third_party("scipy.spatial", "contact of virtual patients is found", "study")
    tree = spatial.cKDTree(places[triangles].mean(axis=1))
    count = min(CANDIDATES, len(triangles))
    tried = tree.query(points, k=count)[1].reshape(len(points), count)
    best = np.full(len(points), np.inf)
    triangle = np.zeros(len(points), dtype=np.int64)
    weights = np.zeros((len(points), 3))
    for candidate in tried.T:
        corners = places[triangles[candidate]]
        found = _weights(points, corners)
        apart = np.linalg.norm(points - np.einsum("ck,cki->ci", found, corners), axis=1)
        # The lower index wins a tie, so that the result does not depend on the order.
        closer = (apart < best) | ((apart == best) & (candidate < triangle))
        best[closer], triangle[closer] = apart[closer], candidate[closer]
        weights[closer] = found[closer]
    return triangle, weights


def _weights(points: Floats, corners: Floats) -> Floats:
    """Barycentric weights of the points of triangles (c, 3, 3) closest to points (c, 3).

    The projection onto the plane if it is inside the triangle, otherwise the closest edge point.
    """
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    normal = np.cross(b - a, c - a)
    square = (normal * normal).sum(axis=1)
    square = np.maximum(square, np.finfo(np.float64).tiny)
    beta = (np.cross(points - a, c - a) * normal).sum(axis=1) / square
    gamma = (np.cross(b - a, points - a) * normal).sum(axis=1) / square
    weights = np.column_stack([1.0 - beta - gamma, beta, gamma])
    outside = np.flatnonzero((weights < 0.0).any(axis=1))
    best = np.full(len(outside), np.inf)
    for first in range(3):
        last = (first + 1) % 3
        start, edge = corners[outside, first], corners[outside, last] - corners[outside, first]
        length = np.maximum((edge * edge).sum(axis=1), np.finfo(np.float64).tiny)
        t = np.clip(((points[outside] - start) * edge).sum(axis=1) / length, 0.0, 1.0)
        apart = np.linalg.norm(points[outside] - start - t[:, None] * edge, axis=1)
        closer = apart < best
        best[closer] = apart[closer]
        found = np.zeros((len(outside), 3))
        found[:, first], found[:, last] = 1.0 - t, t
        weights[outside[closer]] = found[closer]
    return weights


def _outward(places: Floats, lip: Lip, triangle: NDArray[np.int64], weights: Floats) -> Floats:
    """Outward unit vectors at points of triangles, (c, 3), also right on edges and corners.

    Angle-weighted normals (Bærentzen & Aanæs 2005): of one face in its interior, of both faces on
    an edge, of all adjacent faces at a corner.
    """
    triangles = lip.triangles
    corners = places[triangles]
    edges = np.roll(corners, -1, axis=1) - corners
    face = np.cross(edges[:, 0], edges[:, 1])
    face /= np.maximum(np.linalg.norm(face, axis=1), np.finfo(np.float64).tiny)[:, None]
    unit = edges / np.maximum(np.linalg.norm(edges, axis=2), np.finfo(np.float64).tiny)[:, :, None]
    cosine = -(unit * np.roll(unit, 1, axis=1)).sum(axis=2)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    at_node = np.zeros_like(places)
    np.add.at(at_node, triangles, angle[:, :, None] * face[:, None, :])
    found = face[triangle]
    none = weights <= ON_EDGE
    on_corner = none.sum(axis=1) == 2
    corner = triangles[triangle, weights.argmax(axis=1)]
    found[on_corner] = at_node[corner[on_corner]]
    on_edge = np.flatnonzero(none.sum(axis=1) == 1)
    neighbour = lip.neighbours[triangle[on_edge], none[on_edge].argmax(axis=1)]
    two = neighbour >= 0
    found[on_edge[two]] += face[neighbour[two]]
    length = np.linalg.norm(found, axis=1, keepdims=True)
    normals: Floats = found / np.maximum(length, np.finfo(np.float64).tiny)
    return normals


def _on_border(lip: Lip, triangle: NDArray[np.int64], weights: Floats) -> NDArray[np.bool_]:
    """Whether points of triangles lie on the border of the surface, (c,)."""
    none = weights <= ON_EDGE
    edge = (none & (lip.neighbours[triangle] < 0)).any(axis=1)
    corner = lip.triangles[triangle, weights.argmax(axis=1)]
    border: NDArray[np.bool_] = edge | ((none.sum(axis=1) == 2) & np.isin(corner, lip.border_nodes))
    return border


def _block_matrix(rows: NDArray[np.int64], columns: NDArray[np.int64], data: Floats, n: int) -> Any:
    """The sum of 3 × 3 blocks at rows and columns, (3n, 3n), scipy BSR."""
    sparse = third_party("scipy.sparse", "contact of virtual patients is solved", "study")
    key, place = np.unique(rows * n + columns, return_inverse=True)
    blocks = np.zeros((len(key), 3, 3))
    np.add.at(blocks, place.reshape(-1), data)
    starts = np.searchsorted(key // n, np.arange(n + 1))
    return sparse.bsr_array((blocks, key % n, starts), shape=(3 * n, 3 * n))
