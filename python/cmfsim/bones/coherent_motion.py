"""Bone motions vertex by vertex, as rigid pieces, how bone bends, and bone that was removed.

The jaw of a skull may be cut and moved within one surface. Each piece then moves rigidly, the mesh
stretches between them, vertices of a fitted template slide along the bone, and those of resected
bone are squeezed onto what is left. `coherent_motion` finds the pieces and tells these apart: what
lies along the normals is seen in the scans and followed, what lies along the surface is followed as
far as bending explains it, and only a patch that sank into its own piece, and did not move as one,
counts as removed.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim._core import Surface, rigid_fit
from cmfsim.bones.motion import RemovedBone, triangle_areas
from cmfsim.bones.shape_fit import LEAST_SIGMA, TO_SIGMA, TUKEY, vertex_areas
from cmfsim.errors import BoundaryInputError, third_party
from cmfsim.surfaces.topology import connected_labels, edges_of
from cmfsim.values.checks import Floats
from cmfsim.values.frozen import Frozen
from cmfsim.values.motion import rigid_motion
from cmfsim.values.surface_data import MovedSurface

__all__ = ["CoherentMotion", "RigidPiece", "coherent_motion"]

Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]

# Deviations from a rigid motion are judged by their root mean square over this length, mm: the
# standard deviation of the weights along the surface.
JUDGED = 4.0
# A part of the bone moved otherwise than the pieces known if its deviation along the normals, or
# a third of that along the surface, is more than this, mm: the accuracy of a segmented bone.
DEVIATES = 0.5
# A deviation counts at most this much, mm: one vertex far off says no more.
MOST_DEVIATION = 3.0
# Where bone bends, or vertices slid, this many times the median deviation.
UNUSUAL = 2.0
# That median counts at most this many times that of so many small neighbourhoods, each about its
# own rigid motion: pieces that moved apart deviate from one motion all over.
BENDS, NEIGHBOURHOODS = 4.0, 16
# It is a piece if its own rigid motion leaves this share of that, on this share of its area.
EXPLAINED, EXPLAINED_AREA = 0.5, 0.6
# A smaller part, mm², is not a piece of its own.
LEAST_PIECE = 300.0
MOST_PIECES = 12
# Of a part that no single motion explains, so many places are tried, with what lies this near, mm.
PARTS, PART = 4, 25.0
# Rounds in which vertices choose a piece, and pieces are fitted to their vertices.
ROUNDS = 8
# They are the same when this share of the area changes its piece.
SAME = 1e-3
# How much less a deviation along the surface counts than one along the normal.
ALONG = 3.0
# Pieces pass into one another over this length, mm, and closer than this to another piece vertices
# are followed as they are: the mesh stretches between pieces.
PASSES, BETWEEN = 2.0, 4.0
# Shares of a vertex's own piece within the second: the first is reached 6.6 mm from a border.
NEAR_ANOTHER, WELL_WITHIN = 0.95, 0.995
# What varies over more than this length along the surface, mm, is followed as it is.
SLOW = 16.0
# Neighbourhood over which noise is averaged, mm: bone does not bend within it; and noise that is
# tolerated, mm rms: a tenth of the accuracy of a segmented bone.
AVERAGED, QUIET = 3.0, 0.03
# The weight of a vertex between pieces in such averages.
LEAST_WEIGHT = 1e-6
# Vertices that a rigid motion is fitted to, steps of the fit, and the last one, mm.
MOST_FITTED, STEPS, LAST_STEP = 8000, 30, 1e-4

# A patch of bone was removed if a vertex of it went further than the first from where its piece
# went, mm, and lies deeper than the second inside the bone before; the patch reaches as far as its
# vertices are off by the third: three times the noise of a segmented bone.
REMOVED, REMOVED_DEPTH, REMOVED_RIM = 1.5, 0.75, 0.75
# The motion of a piece is known if the median deviation along its normals is below this, mm.
KNOWN = 0.35
# Such a patch ends abruptly: this far around it, the median deviation of vertices is at most this
# share of the largest in the patch. A bone that bends deviates all around.
RING, RING_SHARE = 6.0, 0.35
# A larger patch, mm², moved: no operation grinds away so much of a surface.
MOST_REMOVED = 1500.0
# Smaller ones, mm², are corners and rims.
LEAST_PATCH = 20.0
# A patch lies within a piece, away from others, if so much of its surroundings is of that piece.
WITHIN = 0.9
# Of a patch that was ground off, nearly all went inwards; a piece of bone has two sides.
INWARDS = -0.7
# Slip beyond this many times the usual one may be bone that was squeezed onto a stump.
SLID = 2.0
# A small patch that went inwards moved as a piece only if its own motion leaves this much, mm.
AS_ONE = 0.3


@dataclass(frozen=True, eq=False)
class RigidPiece(Frozen):
    """A part of a bone that moved as one.

    Attributes
    ----------
    matrix : (4, 4) float64, mm
        Its rigid motion.
    area : float, mm²
    vertices : (n,) int64
        Of the surface, that lie in it.
    """

    matrix: Floats
    area: float
    vertices: Integers

    def as_dict(self) -> dict[str, Any]:
        """Plain values with units in their names, as JSON holds them."""
        return {"matrix": self.matrix.tolist(), "area_mm2": self.area}


@dataclass(frozen=True, eq=False)
class CoherentMotion:
    """The motion of a bone in pieces.

    Attributes
    ----------
    motion : MovedSurface
        Without noise, slip and removed bone.
    pieces : tuple of RigidPiece
        The largest first.
    removed : tuple of RemovedBone
        The largest first.
    slip : float, mm
        How far vertices slid along the bone: the rms of what was taken off.
    noise : float, mm
        The rms of the noise that was averaged out; 0 where it is too small to matter.
    spread : float, mm
        The usual rms deviation of a small neighbourhood from its own rigid motion.
    """

    motion: MovedSurface
    pieces: tuple[RigidPiece, ...]
    removed: tuple[RemovedBone, ...]
    slip: float
    noise: float
    spread: float


def coherent_motion(motion: MovedSurface) -> CoherentMotion:
    """The motion of a bone in rigid pieces.

    Parameters
    ----------
    motion : MovedSurface
        Without triangles that have no area (`sound_motion`).

    Returns
    -------
    CoherentMotion

    Raises
    ------
    BoundaryError
        (also `ValueError`) scipy is missing.

    Notes
    -----
    Rigid motions are fitted by steps in which a deviation along the surface counts a third of one
    along the normal, with Tukey's biweight (Huber 1981). A connected part whose deviation from all
    pieces is unusual becomes a piece if one rigid motion explains it; vertices then choose the
    piece that explains their surroundings best, and the pieces are fitted again.
    """
    paired = _Paired(motion)
    nearby = _usual_nearby(paired)
    matrices, piece = _pieces(paired, nearby)
    deviation = _Deviation(paired, matrices, piece)
    removed = _removed(paired, matrices, piece, deviation)
    rest, noise = paired.denoised(deviation.rest, removed, deviation.inner)
    rest, slip = _followed(paired, rest, deviation)
    found = []
    for number, matrix in enumerate(matrices):
        mine = np.flatnonzero(piece == number)
        found.append(RigidPiece(matrix, float(paired.areas[mine].sum()), mine))
    return CoherentMotion(
        MovedSurface(motion.surface, deviation.rigid + rest),
        tuple(found),
        removed,
        slip,
        noise,
        float(np.sqrt(nearby)),
    )


class _Paired:
    """A surface before and after, with averages along it."""

    def __init__(self, motion: MovedSurface) -> None:
        self.motion = motion
        self.here, self.there = motion.surface.vertices, motion.moved_vertices
        self.triangles = motion.surface.triangles.astype(np.int64)
        self.ends = edges_of(self.triangles).ends
        self.areas = np.maximum(vertex_areas(motion.surface), 1e-9)
        self.surface = Surface(motion.surface.vertices, motion.surface.triangles)
        self.normals = self.surface.vertex_normals

    @cached_property
    def _walk(self) -> tuple[Any, float]:
        """The matrix of one step along edges, weighted by area, and how far it goes, mm²."""
        sparse = third_party(
            "scipy.sparse", "motions by vertices are compared", "imaging", BoundaryInputError
        )
        n, (a, b) = len(self.here), self.ends.T
        rows, columns = np.concatenate([a, b, np.arange(n)]), np.concatenate([b, a, np.arange(n)])
        weights = self.areas[columns]
        matrix = sparse.csr_array((weights, (rows, columns)), shape=(n, n))
        total = np.bincount(rows, weights, n)
        matrix = sparse.diags_array(1.0 / total) @ matrix
        far = ((self.here[a] - self.here[b]) ** 2).sum(axis=1)
        spread = np.bincount(
            np.concatenate([a, b]),
            np.concatenate([far * self.areas[b], far * self.areas[a]]),
            n,
        )
        # Two dimensions: the variance along one axis is half of the mean square.
        return matrix, max(0.5 * float(np.median(spread / total)), 1e-6)

    def averaged(self, values: Floats, length: float) -> Floats:
        """Values averaged over a length along the surface (standard deviation), mm."""
        matrix, step = self._walk
        for _ in range(max(round(length**2 / step), 1)):
            values = matrix @ values
        return values

    def cost(self, matrix: Floats) -> Floats:
        """The mean square deviation from a rigid motion round each vertex, mm²."""
        off = self.there - _carried(matrix, self.here)
        square = _square(off, self.normals @ matrix[:3, :3].T)
        return self.averaged(np.minimum(square, MOST_DEVIATION**2), JUDGED)

    def fitted(self, chosen: Mask) -> Floats:
        """The rigid motion of most of some vertices, normals counting more, (4, 4) mm."""
        some = np.flatnonzero(chosen)
        if len(some) > MOST_FITTED:
            some = np.sort(np.random.default_rng(0).permutation(some)[:MOST_FITTED])
        here, there = self.here[some], self.there[some]
        normals, areas = self.normals[some], self.areas[some]
        matrix = rigid_fit(here, there, weights=areas).matrix
        for _ in range(STEPS):
            turned = normals @ matrix[:3, :3].T
            moved = _carried(matrix, here)
            square = _square(there - moved, turned)
            reach = TUKEY * max(TO_SIGMA * float(np.sqrt(np.median(square))), LEAST_SIGMA)
            weight = areas * np.maximum(1.0 - square / reach**2, 0.0) ** 2
            step = _step(moved, turned, there - moved, weight)
            matrix = step @ matrix
            if float(np.abs(_carried(step, moved) - moved).max()) < LAST_STEP:
                break
        return matrix

    def denoised(
        self, rest: Floats, gone: tuple[RemovedBone, ...], inner: Floats
    ) -> tuple[Floats, float]:
        """Deviations averaged over neighbours, those of removed bone like those round it.

        Also the rms of the noise, mm; deviations with hardly any are returned as they are.
        """
        if gone:
            rest = rest.copy()
        for patch in gone:
            inside = np.zeros(len(rest), dtype=bool)
            inside[patch.vertices] = True
            ring = _ring(self.here, inside)
            rest[inside] = np.average(rest[ring], axis=0, weights=self.areas[ring])
        smooth = self.averaged_within(rest, inner, AVERAGED)
        square = ((rest - smooth) ** 2).sum(axis=1)
        noise = float(np.sqrt(np.average(square, weights=self.areas * (inner + LEAST_WEIGHT))))
        if noise <= QUIET:
            return rest, 0.0
        return rest + inner[:, None] * (smooth - rest), noise

    def averaged_within(self, values: Floats, inner: Floats, length: float) -> Floats:
        """Values averaged over a length, those between pieces counting less."""
        weight = inner + LEAST_WEIGHT
        total = self.averaged(weight, length)
        averaged: Floats = self.averaged(values * weight[:, None], length) / total[:, None]
        return averaged


def _square(off: Floats, normals: Floats) -> Floats:
    """The square of deviations, along the surface as a third, mm²."""
    out = (off * normals).sum(axis=1)
    slid = (off**2).sum(axis=1) - out**2
    square: Floats = out**2 + np.maximum(slid, 0.0) / ALONG**2
    return square


def _step(points: Floats, normals: Floats, off: Floats, weight: Floats) -> Floats:
    """The small rigid motion that takes points to where they went, normals counting more."""
    middle = np.average(points, axis=0, weights=weight + 1e-300)
    arms = points - middle
    n = len(points)
    rows = np.zeros((n, 3, 6))
    rows[:, 0, 1], rows[:, 0, 2] = arms[:, 2], -arms[:, 1]
    rows[:, 1, 0], rows[:, 1, 2] = -arms[:, 2], arms[:, 0]
    rows[:, 2, 0], rows[:, 2, 1] = arms[:, 1], -arms[:, 0]
    rows[:, :, 3:] = np.eye(3)
    tangent = weight / ALONG**2
    normal = weight - tangent
    by_normal = np.einsum("na,nab->nb", normals, rows)
    left = np.einsum("n,nb,nc->bc", normal, by_normal, by_normal)
    left += np.einsum("n,nab,nac->bc", tangent, rows, rows)
    right = by_normal.T @ (normal * (off * normals).sum(axis=1))
    right += np.einsum("n,nab,na->b", tangent, rows, off)
    found = np.linalg.lstsq(left, right, rcond=1e-12)[0]
    angle = float(np.linalg.norm(found[:3]))
    if angle > 0:
        return rigid_motion(found[3:], np.degrees(angle), found[:3], middle)
    return rigid_motion(found[3:])


def _pieces(paired: _Paired, nearby: float) -> tuple[list[Floats], Integers]:
    """The rigid motions of the pieces and the piece of each vertex."""
    pieces = [paired.fitted(np.ones(len(paired.here), dtype=bool))]
    costs = [paired.cost(pieces[0])]
    tried = np.zeros(len(paired.here), dtype=bool)
    while len(pieces) < MOST_PIECES:
        best = np.min(costs, axis=0)
        usual = min(_median(best, paired.areas), BENDS * nearby)
        off = (best > max(DEVIATES**2, UNUSUAL**2 * usual)) & ~tried
        patch = _largest(paired, off)
        area = float(paired.areas[patch].sum())
        if area < LEAST_PIECE:
            break
        own, left, explained = _explaining(paired, patch, best)
        if explained < LEAST_PIECE or _is_ground(paired, pieces[0], patch, left, usual):
            tried |= patch
            continue
        more, its_costs = _shared_out(paired, [*pieces, own], [*costs, left])
        if len(more) <= len(pieces):
            # Other pieces explain its vertices: it would be found again without end.
            tried |= patch
            continue
        pieces, costs = more, its_costs
        tried[:] = False
    piece = np.argmin(costs, axis=0)
    areas = np.bincount(piece, paired.areas, minlength=len(pieces))
    order = np.argsort(-areas, kind="stable")
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    return [pieces[n] for n in order], rank[piece]


def _largest(paired: _Paired, chosen: Mask) -> Mask:
    """The largest connected patch of some vertices."""
    label = connected_labels(paired.ends[chosen[paired.ends].all(axis=1)], len(paired.here))
    if not chosen.any():
        return chosen
    sums = np.bincount(label[chosen], paired.areas[chosen])
    patch: Mask = chosen & (label == int(np.argmax(sums)))
    return patch


def _neighbourhoods(points: Floats, first: int, count: int) -> Iterator[Mask]:
    """Which points lie near each of some that are far from one another, beginning with one."""
    centre, away = first, np.full(len(points), np.inf)
    for _ in range(count):
        off = np.linalg.norm(points - points[centre], axis=1)
        yield off < PART
        away = np.minimum(away, off)
        centre = int(np.argmax(away))


def _usual_nearby(paired: _Paired) -> float:
    """The usual mean square deviation from rigid motions of small neighbourhoods, mm²."""
    found = []
    for part in _neighbourhoods(paired.here, 0, NEIGHBOURHOODS):
        if paired.areas[part].sum() < LEAST_PIECE:
            continue
        own = paired.fitted(part)
        rest = paired.there[part] - _carried(own, paired.here[part])
        square = _square(rest, paired.normals[part] @ own[:3, :3].T)
        found.append(float(np.average(square, weights=paired.areas[part])))
    return float(np.median(found)) if found else np.inf


def _explaining(paired: _Paired, patch: Mask, best: Floats) -> tuple[Floats, Floats, float]:
    """The rigid motion that explains most of a patch, its costs, and the area explained, mm².

    That of the whole patch is tried, and those of its parts: several pieces may touch.
    """
    parts = [patch]
    where = np.flatnonzero(patch)
    for near in _neighbourhoods(paired.here[where], int(np.argmax(best[where])), PARTS):
        part = np.zeros(len(patch), dtype=bool)
        part[where[near]] = True
        if paired.areas[part].sum() >= LEAST_PIECE:
            parts.append(part)
    found: list[tuple[Floats, Floats, float]] = []
    for part in parts:
        own = paired.fitted(part)
        left = paired.cost(own)
        sound = patch & (left <= EXPLAINED**2 * best)
        area = float(paired.areas[sound & part].sum())
        if area >= EXPLAINED_AREA * paired.areas[part].sum():
            found.append((own, left, float(paired.areas[sound].sum())))
    return max(found, key=lambda one: one[2], default=(np.eye(4), best, 0.0))


def _is_ground(paired: _Paired, matrix: Floats, patch: Mask, left: Floats, usual: float) -> bool:
    """Whether a small patch that went inwards did not move as one, but was ground off."""
    mean = float(np.average(left[patch], weights=paired.areas[patch]))
    return mean > max(AS_ONE**2, usual) and _may_be_ground(paired, matrix, patch)


def _may_be_ground(paired: _Paired, matrix: Floats, patch: Mask) -> bool:
    """Whether a patch is small and went inwards all over."""
    areas = paired.areas * patch
    off = paired.there - _carried(matrix, paired.here)
    out = (off * (paired.normals @ matrix[:3, :3].T)).sum(axis=1)
    return bool(
        areas.sum() <= MOST_REMOVED and (areas * out).sum() <= INWARDS * (areas * np.abs(out)).sum()
    )


def _shared_out(
    paired: _Paired, pieces: list[Floats], costs: list[Floats]
) -> tuple[list[Floats], list[Floats]]:
    """Pieces fitted to the vertices that each explains best, until these stay the same."""
    before = None
    for _ in range(ROUNDS):
        piece = np.argmin(costs, axis=0)
        areas = np.bincount(piece, paired.areas, minlength=len(pieces))
        if before is not None and paired.areas[piece != before].sum() < SAME * areas.sum():
            break
        kept = [n for n in range(len(pieces)) if areas[n] >= LEAST_PIECE]
        pieces = [paired.fitted(piece == n) for n in kept]
        costs = [paired.cost(matrix) for matrix in pieces]
        before = piece if len(kept) == len(areas) else None
    return pieces, costs


class _Deviation:
    """How the vertices after lie off the rigid motion of their pieces."""

    def __init__(self, paired: _Paired, pieces: list[Floats], piece: Integers) -> None:
        share = np.eye(len(pieces))[piece]
        passing = paired.averaged(share, PASSES)
        carried = np.stack([_carried(matrix, paired.here) for matrix in pieces], axis=1)
        self.rigid: Floats = (passing[:, :, None] * carried).sum(axis=1)
        turns = np.array([matrix[:3, :3] for matrix in pieces])[piece]
        self.normals: Floats = np.einsum("nij,nj->ni", turns, paired.normals)
        # The share of its own piece round each vertex; and 1 well within a piece, 0 near another.
        self.own: Floats = paired.averaged(share, BETWEEN).max(axis=1)
        self.inner: Floats = np.clip((self.own - NEAR_ANOTHER) / (WELL_WITHIN - NEAR_ANOTHER), 0, 1)
        self.rest: Floats = paired.there - self.rigid

    def split(self, rest: Floats) -> tuple[Floats, Floats]:
        """Deviations along the normals and along the surface, (n, 3) each."""
        out = (rest * self.normals).sum(axis=1, keepdims=True) * self.normals
        return out, rest - out


def _followed(paired: _Paired, rest: Floats, deviation: _Deviation) -> tuple[Floats, float]:
    """Deviations without slip, and the rms of what was subtracted, mm.

    What varies slowly is followed: bone bends like that, and its shape does not tell. The rest of
    the deviations is alike in all directions, so its mean square is twice as large along the
    surface as along the normal; what exceeds that is slip. The share that is kept is that of
    Wiener's filter.
    """
    slow = paired.averaged_within(rest, deviation.inner, SLOW)
    out, along = deviation.split(rest - slow)
    squares = np.column_stack([(out**2).sum(axis=1), (along**2).sum(axis=1)])
    means = paired.averaged_within(squares, deviation.inner, SLOW)
    kept = np.minimum(2.0 * means[:, 0] / np.maximum(means[:, 1], 1e-12), 1.0)
    taken = (deviation.inner * (1.0 - kept))[:, None] * along
    slip = float(np.sqrt(np.average((taken**2).sum(axis=1), weights=paired.areas)))
    return rest - taken, slip


def _removed(
    paired: _Paired, pieces: list[Floats], piece: Integers, deviation: _Deviation
) -> tuple[RemovedBone, ...]:
    """The patches of bone that are gone."""
    here, triangles = paired.here, paired.triangles
    out, along = deviation.split(deviation.rest)
    slid = np.linalg.norm(along, axis=1)
    # What vertices slide is no sign of missing bone.
    usual = np.sqrt(_median(slid**2, paired.areas))
    excess = np.maximum(slid - SLID * usual, 0.0)
    off = np.sqrt((out**2).sum(axis=1) + excess**2)
    loose = off > REMOVED_RIM
    depth = np.zeros(len(here))
    far = np.flatnonzero(loose)
    # In the frame before: the present place of a vertex relative to its piece.
    turns = np.array([matrix[:3, :3] for matrix in pieces])[piece[far]]
    shifts = np.array([matrix[:3, 3] for matrix in pieces])[piece[far]]
    seen = np.einsum("nji,nj->ni", turns, paired.there[far] - shifts)
    inside = paired.surface.winding_number(seen) > 0.5
    closest = paired.surface.closest(seen[inside])[0]
    depth[far[inside]] = np.linalg.norm(closest - seen[inside], axis=1)
    # Only bone whose motion is known shows what is missing from it.
    out_of_place = np.linalg.norm(out, axis=1)
    for number in range(len(pieces)):
        if _median(out_of_place[piece == number], paired.areas[piece == number]) > KNOWN:
            loose[piece == number] = False
    seed = loose & (off > REMOVED) & (depth > REMOVED_DEPTH)
    if not seed.any():
        return ()
    label = connected_labels(paired.ends[loose[paired.ends].all(axis=1)], len(here))
    areas = triangle_areas(here, triangles)
    found = []
    for number in np.unique(label[seed]):
        patch = (label == number) & loose
        area = float(areas[patch[triangles].any(axis=1)].sum())
        worst = int(np.argmax(np.where(patch, off, 0.0)))
        ring = _ring(here, patch)
        # Between two pieces the mesh is stretched or squeezed; there vertices are followed.
        if not LEAST_PATCH <= area <= MOST_REMOVED or not ring.any():
            continue
        own = piece == piece[worst]
        if deviation.own[patch].min() < WITHIN or own[ring].mean() < WITHIN:
            continue
        if float(np.median(off[ring])) > RING_SHARE * off[worst]:
            continue
        if not _may_be_ground(paired, pieces[int(piece[worst])], patch):
            continue
        found.append(
            RemovedBone(area, float(off[worst]), here[worst].copy(), np.flatnonzero(patch))
        )
    return tuple(sorted(found, key=lambda patch: -patch.area))


def _ring(here: Floats, patch: Mask) -> Mask:
    """The vertices around a patch."""
    box = (here >= here[patch].min(axis=0) - RING) & (here <= here[patch].max(axis=0) + RING)
    ring: Mask = box.all(axis=1) & ~patch
    return ring


def _median(values: Floats, weights: Floats) -> float:
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])


def _carried(matrix: Floats, points: Floats) -> Floats:
    moved: Floats = points @ matrix[:3, :3].T + matrix[:3, 3]
    return moved
