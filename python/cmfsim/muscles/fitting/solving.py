"""The displacement that moves muscles out of bone, skin and air: B-splines, least squares."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError, third_party
from cmfsim.muscles.fitting.room import Room
from cmfsim.values.checks import Floats
from cmfsim.values.image_data import ImageData
from cmfsim.values.surface_data import SurfaceData

# Number of coefficients of the quadratic B-spline that influence a point, along each axis.
REACH = 3


def sparse(name: str = "scipy.sparse") -> Any:
    """The package scipy.sparse, or a package inside it."""
    return third_party(name, "muscles are fitted", "imaging", CaseInputError)


@dataclass(frozen=True, eq=False)
class Lattice:
    """The positions of the coefficients of a displacement: only those that influence a muscle.

    origin: (3,), mm.
    spacing: mm.
    shape: (3,) int.
    number: (nx, ny, nz) int. The index of each coefficient; −1 where there is none.
    """

    origin: Floats
    spacing: float
    shape: NDArray[np.intp]
    number: NDArray[np.intp]

    @classmethod
    def round(cls, points: Floats, spacing: float) -> "Lattice":
        """The lattice that determines the displacement at the given points.

        points: (n, 3), mm.
        spacing: mm.
        """
        low, high = points.min(axis=0), points.max(axis=0)
        cells = np.ceil((high - low) / spacing).astype(np.intp) + 1
        # Centred: mirrored points get a mirrored lattice.
        origin = 0.5 * (low + high) - 0.5 * cells * spacing
        shape = cells + REACH - 1
        reached = np.zeros(shape, dtype=bool)
        held = np.zeros(shape, dtype=bool)
        held[tuple(np.floor((points - origin) / spacing).astype(np.intp).T)] = True
        first = np.argwhere(held)
        for i, j, k in np.ndindex(REACH, REACH, REACH):
            reached[first[:, 0] + i, first[:, 1] + j, first[:, 2] + k] = True
        number = np.full(shape, -1, dtype=np.intp)
        number[reached] = np.arange(np.count_nonzero(reached))
        return cls(origin, spacing, shape, number)

    @cached_property
    def size(self) -> int:
        """The number of coefficients, each a vector."""
        return int(self.number.max()) + 1

    def basis(self, points: Floats, derivative: int | None = None) -> Any:
        """The matrix from coefficients to the displacement at points, or to its derivative.

        points: (n, 3), mm.
        derivative: The axis along which to differentiate; by default, the displacement itself.
        Returns: (n, size) scipy.sparse.csr_matrix.
        """
        at = (points - self.origin) / self.spacing
        first = np.floor(at).astype(np.intp)
        weights = [
            _slopes(at[:, a] - first[:, a]) / self.spacing
            if a == derivative
            else _values(at[:, a] - first[:, a])
            for a in range(3)
        ]
        offset = np.arange(REACH)
        columns = self.number[
            first[:, 0, None, None, None] + offset[:, None, None],
            first[:, 1, None, None, None] + offset[:, None],
            first[:, 2, None, None, None] + offset,
        ].reshape(len(points), -1)
        data = np.einsum("na,nb,nc->nabc", *weights).reshape(len(points), -1)
        rows = np.arange(0, data.size + 1, REACH**3)
        shape = (len(points), self.size)
        return sparse().csr_matrix((data.ravel(), columns.ravel(), rows), shape=shape)

    def differences(self) -> tuple[Any, Any]:
        """First and second differences of neighbouring coefficients, in mm per mm and per mm².

        Returns: second : (…, size) scipy.sparse.csr_matrix. Rows are weighted by a cell's volume,
            so the sum of squares is an integral over space.
        """
        root = self.spacing**1.5
        first = [self._stencil([((0, 0, 0), -1.0), (e, 1.0)]) for e in _UNITS]
        second = [
            self._stencil([((0, 0, 0), 1.0), (e, -2.0), (tuple(2 * x for x in e), 1.0)])
            for e in _UNITS
        ]
        for a in range(3):
            for b in range(a):
                both = tuple(x + y for x, y in zip(_UNITS[a], _UNITS[b], strict=True))
                corners = [((0, 0, 0), 1.0), (_UNITS[a], -1.0), (_UNITS[b], -1.0), (both, 1.0)]
                # The mixed derivative occurs twice in the sum over all pairs.
                second.append(self._stencil([(o, np.sqrt(2.0) * w) for o, w in corners]))
        stack = sparse().vstack
        return (
            stack(first, format="csr") * (root / self.spacing),
            stack(second, format="csr") * (root / self.spacing**2),
        )

    def _stencil(self, parts: list[tuple[tuple[int, ...], float]]) -> Any:
        """A difference at each position where the lattice has all of its coefficients."""
        reach = np.max([offset for offset, _ in parts], axis=0)
        last = self.shape - reach
        views = []
        for offset, _ in parts:
            i, j, k = (slice(o, o + n) for o, n in zip(offset, last, strict=True))
            views.append(self.number[i, j, k])
        held = np.all([view >= 0 for view in views], axis=0)
        columns = np.stack([view[held] for view in views], axis=1)
        data = np.broadcast_to([w for _, w in parts], columns.shape)
        rows = np.arange(0, columns.size + 1, len(parts))
        shape = (len(columns), self.size)
        return sparse().csr_matrix((data.ravel(), columns.ravel(), rows), shape=shape)


_UNITS = ((1, 0, 0), (0, 1, 0), (0, 0, 1))


def _values(part: Floats) -> Floats:
    """The three quadratic B-splines at a fraction of a cell."""
    return np.stack([0.5 * (1 - part) ** 2, 0.5 + part * (1 - part), 0.5 * part**2], axis=1)


def _slopes(part: Floats) -> Floats:
    """Their derivatives with respect to that fraction."""
    return np.stack([part - 1.0, 1.0 - 2.0 * part, part], axis=1)


_log = logging.getLogger(__name__)

# Gap between a muscle's surface and the skin or bone, mm. Half a voxel, so that a muscle placed
# correctly is still correct on the mesh.
GAP = 0.25
# Points further outside than this are ignored, mm: the head differs from the template there, or
# ends.
FURTHEST = 10.0
# Weights relative to 1 mm of penetration on 1 mm² of a muscle's surface. Strain: a muscle 10 mm
# thick that is strained by 0.1 costs as much as its two surfaces misplaced by 0.2 mm.
STRAIN = 0.15
# Weight of curvature times the lattice's spacing, relative to strain.
BENDING = 1.0
# Weight of a change of volume, expressed as a displacement of the surface: outweighs penetration.
VOLUME = 200.0
# Weight of an attachment that is off its bone: less than that of a point outside the tissue.
ATTACHMENT = 0.15
ITERATIONS = 5
# Of the conjugate gradients in each iteration; the next iteration corrects what is left.
TOLERANCE = 1e-3
MOST_CG_STEPS = 400


@dataclass(frozen=True, eq=False)
class Volumes:
    """Surfaces whose vertices are numbered consecutively, surface after surface.

    triangles: tuple of (t, 3) int, of each surface.
    begins: The first vertex of each surface, then the number of all vertices.
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


@dataclass(frozen=True, eq=False)
class Targets:
    """Vertices spread over the surfaces of muscles, and where they should be.

    vertices: (n,) int.
    area: (n,), mm². Area of the surface that each vertex represents.
    outward: (n, 3). Unit vectors away from the template's bone next to it.
    attached: (n,) bool. Whether it lies on that bone.
    depth: (n,), mm. How deep in bone it lies in the template; 0 outside.
    """

    vertices: NDArray[np.intp]
    area: Floats
    outward: Floats
    attached: NDArray[np.bool_]
    depth: Floats


@dataclass(frozen=True, eq=False)
class Problem:
    """Muscles as placed by landmarks, the room available to them, and the displacement allowed.

    vertices: (v, 3), mm, of all muscles.
    basis: (v, size) sparse matrix, from the coefficients of the lattice to displacements of the
        vertices.
    """

    vertices: Floats
    volumes: Volumes
    targets: Targets
    room: Room
    lattice: Lattice
    basis: Any

    def solved(self, stiffness: float) -> Floats:
        """The coefficients of the best displacement for all muscles.

        Gauss-Newton iterations on the sum of squares of the distance of vertices from their room or
        from their bone, along the gradient of that distance; of the change of each muscle's volume;
        and of strain and bending of space.

        stiffness: A factor on the energy of strain and bending.
        Returns: (size, 3), mm.
        """
        lattice, targets = self.lattice, self.targets
        basis = self.basis[targets.vertices]
        energy = stiffness * _energy(lattice)
        volume_rows, scale = self._volume_rows()
        before = self.volumes.enclosed(self.vertices)
        found = np.zeros((lattice.size, 3))
        for iteration in range(ITERATIONS):
            u = basis @ found
            residual, direction, weight = _wanted(
                self.room, targets, self.vertices[targets.vertices] + u
            )
            used = weight > 0.0
            rows = _rows(basis[used], direction[used], np.sqrt(weight[used]))
            aim = np.sqrt(weight) * (residual + np.einsum("na,na->n", direction, u))
            change = self.volumes.enclosed(self.vertices + self.basis @ found) - before
            keep = volume_rows @ found.ravel() - scale * change
            right = rows.T @ aim[used] + volume_rows.T @ keep
            found = _least(rows, volume_rows, energy, right, found)
            out = np.sqrt(np.average(residual[used] ** 2)) if used.any() else 0.0
            _log.debug("fit %d: %d points, %.2f mm", iteration, np.count_nonzero(used), out)
        return found

    def _volume_rows(self) -> tuple[Any, Floats]:
        """The derivative of each muscle's volume with respect to the coefficients, and its weight.

        Both are divided by the root of the muscle's area: volume over area is a displacement, which
        counts in proportion to the area. Open surfaces have no volume to preserve.
        """
        slopes, areas = self.volumes.slopes(self.vertices)
        scale = np.sqrt(VOLUME / areas) * np.array(self.volumes.is_closed)
        begins = self.volumes.begins
        rows = [
            (self.basis[begins[i] : begins[i + 1]].T @ self.volumes.part(slopes, i)).ravel() * s
            for i, s in enumerate(scale)
        ]
        return sparse().csr_matrix(np.array(rows)), scale


def _energy(lattice: Lattice) -> Any:
    """Strain and bending of space, per axis of the displacement: a symmetric matrix."""
    first, second = lattice.differences()
    bending = BENDING * lattice.spacing**2
    return STRAIN * (first.T @ first + bending * (second.T @ second))


def _wanted(room: Room, targets: Targets, points: Floats) -> tuple[Floats, Floats, Floats]:
    """How far each point should move, in which direction, and with which weight."""
    distance, gradient = sampled(room.tissue, points)
    bone, bone_gradient = sampled(room.bone, points)
    # A point inside bone moves to the side on which the template has the muscle: in a thin ramus,
    # the nearest side may be the other one.
    behind = (bone < 0.0) & (np.einsum("na,na->n", gradient, targets.outward) < 0.0)
    gradient = np.where(behind[:, None], targets.outward, gradient)
    distance = np.where(behind, -_way_out(room.bone, points, targets.outward, behind), distance)
    # A muscle may be as deep in bone as it is in the template.
    residual = GAP - targets.depth - distance
    weight = np.where(residual > 0.0, targets.area, 0.0)
    # Attachments are drawn to their bone from both sides.
    off = targets.attached & (residual <= 0.0) & (bone < FURTHEST)
    residual = np.where(off, np.minimum(GAP - targets.depth - bone, 0.0), residual)
    gradient = np.where(off[:, None], bone_gradient, gradient)
    weight = np.where(off, ATTACHMENT * targets.area, weight)
    weight[~room.known(points) | (np.abs(residual) > FURTHEST)] = 0.0
    return residual, gradient, weight


def _way_out(
    level: ImageData, points: Floats, direction: Floats, asked: NDArray[np.bool_]
) -> Floats:
    """The path along a direction to where a distance is positive, mm; 0 where not asked for."""
    way = np.zeros(len(points))
    inside = np.flatnonzero(asked)
    step = 0.5 * float(level.spacing[0])
    while len(inside) and way[inside].max() <= FURTHEST + step:
        way[inside] += step
        places = points[inside] + way[inside, None] * direction[inside]
        inside = inside[level.sample(places) < 0.0]
    return way


def sampled(level: ImageData, points: Floats) -> tuple[Floats, Floats]:
    """A distance at points and its unit gradient."""
    step = 0.5 * float(level.spacing[0])
    offsets = step * np.vstack([np.zeros(3), np.eye(3), -np.eye(3)])
    around = level.sample((points[None] + offsets[:, None]).reshape(-1, 3)).reshape(7, -1)
    gradient = (around[1:4] - around[4:]).T
    size = np.linalg.norm(gradient, axis=1)
    return around[0], gradient / np.maximum(size, np.finfo(float).eps)[:, None]


def _rows(basis: Any, direction: Floats, weight: Floats) -> Any:
    """One row per point: its displacement along a direction. Columns: x, y, z of a coefficient."""
    wide = np.repeat(3 * basis.indices, 3).reshape(-1, 3) + np.arange(3)
    each = np.diff(basis.indptr)
    data = basis.data[:, None] * np.repeat(weight[:, None] * direction, each, axis=0)
    shape = (basis.shape[0], 3 * basis.shape[1])
    return sparse().csr_matrix((data.ravel(), wide.ravel(), 3 * basis.indptr), shape=shape)


def _least(rows: Any, volume_rows: Any, energy: Any, right: Floats, start: Floats) -> Floats:
    """The solution of (RᵀR + VᵀV + E) x = b by conjugate gradients, near a first guess.

    E acts on each axis in the same way. RᵀR, with 243 entries per row, is never formed. Every sum
    has one order, whatever the number of threads.
    """
    back, volume_back = rows.T.tocsr(), volume_rows.T.tocsr()
    diagonal = np.asarray(rows.multiply(rows).sum(axis=0)).ravel()
    diagonal += np.asarray(volume_rows.multiply(volume_rows).sum(axis=0)).ravel()
    diagonal += np.repeat(energy.diagonal(), 3)
    scale = 1.0 / np.maximum(diagonal, np.finfo(float).eps)

    def product(x: Floats) -> Floats:
        bent = (energy @ x.reshape(start.shape)).ravel()
        result: Floats = back @ (rows @ x) + volume_back @ (volume_rows @ x) + bent
        return result

    x = start.ravel()
    residual = right - product(x)
    limit = TOLERANCE**2 * _dot(right, right)
    ahead = scale * residual
    along, slope = ahead, _dot(residual, ahead)
    for _ in range(MOST_CG_STEPS):
        if _dot(residual, residual) <= limit:
            break
        pulled = product(along)
        step = slope / _dot(along, pulled)
        x = x + step * along
        residual = residual - step * pulled
        ahead = scale * residual
        before, slope = slope, _dot(residual, ahead)
        along = ahead + (slope / before) * along
    return x.reshape(start.shape)


def _dot(a: Floats, b: Floats) -> float:
    """The sum of products in one order: BLAS splits it between its threads."""
    return float(np.einsum("a,a->", a, b))
