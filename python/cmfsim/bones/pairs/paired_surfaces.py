"""The motion between surfaces with the same triangles, judged by shape instead of by vertices.

When a template is fitted to each scan, its vertices slide along the bone, and those of resected
bone are squeezed onto the stump. Neither is motion. If the bone has the same shape before and
after, moved and perhaps scaled, the rigid motion of that shape is the motion.

Registration ignores what does not fit, so that a piece that moved differently, or was removed, does
not distort the motion of the rest. The whole segment then gets the motion of the rest, and the user
must know of such a patch.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim._core import Surface, rigid_fit
from cmfsim.bones.motion import RemovedBone, missing_patches
from cmfsim.bones.pairs.shape_fit import LEAST_SIGMA, TO_SIGMA, TUKEY, ShapeFit, fit_shape
from cmfsim.errors import BoundaryInputError, RegistrationError, third_party
from cmfsim.surfaces.depth import distances
from cmfsim.surfaces.topology import connected_labels, edges_of
from cmfsim.values.checks import Floats, Plain, in_files
from cmfsim.values.motion import carried
from cmfsim.values.surface_data import SurfaceData, triangle_areas, vertex_areas

# A vertex is off if it lies further from the bone than this, mm, three times the accuracy of a
# segmented bone, and than this many times the rms of the fit: noise does so to 1 vertex in 10 000.
OFF, OFF_RMS = 1.5, 4.0
# The least area of a patch, mm²: 1 cm², a tenth of what a chin segment shows. Windows that a scan
# leaves in thin walls, plates and screws are smaller.
LEAST_STRAY = 100.0
# What lies within this of another segment before the operation, mm, is a cut face or a joint: no
# scan shows the former, and the surfaces of two segments lie one or two voxels of a CT apart.
CUT_FACE = 1.5
# Bone further away than this, mm, is not taken for a displaced patch: few segments move as far.
REACH = 10.0
# Bone whose normal differs by more than 60° (cosine) is another side: a resected chin lies near the
# stump, not on it. A patch is present if this share of its vertices has bone with a like normal.
FACING, SHOWN_SHARE = 0.5, 0.5
# The least area of a vertex, mm²: one of triangles without area weighs next to nothing.
LEAST_AREA = 1e-9
# Error of averages from polynomials that are left out, as a share of the largest value.
LEFT_OUT = 1e-9
# A vertex lies on the post-operative bone if it is this near, mm: the surface of each of the two
# scans is accurate to half a millimetre.
LIES = 1.0
# A patch off the bone is a piece that moved otherwise if its own vertices' rigid motion lays this
# share of them this near to the bone after, mm: two and a half times noise of 0.3 mm. The end of a
# bone, squeezed flat on to the stump, stands off it by its height. Crumbs at its rim do not count.
OWN, OWN_SHARE = 0.75, 0.8
# How much it bent is averaged over this length, mm: noise is not bending. Vertices that do not
# count have the second weight.
AVERAGED, LEAST_WEIGHT = 3.0, 1e-6
# Rounds of weights for the motion to begin with: a fifth of the vertices that went 4 mm elsewhere
# are left out by then.
TRIM_ROUNDS = 20
# The motion is that of one rigid bone if so much of the area lies on the bone after or was removed,
# and so much lies on it. The rest are thin walls and rims of cuts.
RIGID_SHARE, LEAST_LYING = 0.95, 0.6


@dataclass(frozen=True, eq=False)
class StrayPatch(Plain):
    """A patch of a segment that lies off the bone after the operation, by vertices before.

    area: mm², of the surface before.
    distance: mm, from the post-operative bone, after the segment's motion; median of the vertices.
    place: (3,), mm. The vertex nearest to the middle of the patch, before.
    has_bone: Whether bone lies within reach that may be this patch, displaced, or what is left of
        it after grinding; else it was removed, lies outside the scan, or moved further.
    """

    area: float = field(metadata=in_files("area_mm2"))
    distance: float = field(metadata=in_files("distance_mm"))
    place: Floats = field(metadata=in_files("place_mm"))
    has_bone: bool
    vertices: NDArray[np.int64] = field(metadata=in_files(None))


def stray_patches(
    segment: SurfaceData,
    bone: Surface,
    matrix: Floats,
    rms: float,
    beside: Sequence[SurfaceData] = (),
) -> tuple[tuple[StrayPatch, ...], Floats]:
    """The patches of a segment that lie off the bone after, largest first, and each vertex's mm.

    matrix: (4, 4), mm. The motion of the segment.
    rms: mm. Residual of the fit over the vertices that it keeps.
    beside: The other segments before: what touches them was cut, and is not searched for.
    """
    here = segment.vertices
    triangles = segment.triangles.astype(np.int64)
    turn, shift = matrix[:3, :3], matrix[:3, 3]
    moved = here @ turn.T + shift
    closest, facing, _ = bone.closest(moved)
    off: Floats = np.linalg.norm(closest - moved, axis=1)
    stray = off > max(OFF, OFF_RMS * rms)
    for other in beside:
        if not stray.any():
            break
        asked = np.flatnonzero(stray)
        away = distances(here[asked], Surface(other.vertices, other.triangles))
        stray[asked[away <= CUT_FACE]] = False
    if not stray.any():
        return (), off
    normals = Surface(segment.vertices, segment.triangles).vertex_normals
    alike = ((normals @ turn.T) * facing).sum(axis=1) >= FACING
    ends = edges_of(triangles).ends
    label = connected_labels(ends[stray[ends].all(axis=1)], len(here))
    whole = triangles[stray[triangles].all(axis=1)]
    areas = triangle_areas(here, whole)
    sums = np.bincount(label[whole[:, 0]], weights=areas, minlength=len(here))
    found = []
    for number in np.flatnonzero(sums >= LEAST_STRAY):
        patch = np.flatnonzero((label == number) & stray)
        shown = (off[patch] <= REACH) & alike[patch]
        middle = np.linalg.norm(here[patch] - here[patch].mean(axis=0), axis=1)
        found.append(
            StrayPatch(
                float(sums[number]),
                float(np.median(off[patch])),
                here[patch[np.argmin(middle)]].copy(),
                bool(shown.mean() >= SHOWN_SHARE),
                patch,
            )
        )
    return tuple(sorted(found, key=lambda patch: -patch.area)), off


class AlongSurface:
    """A surface along which values are averaged: vertices' areas, mm², above 0, and edges."""

    def __init__(self, surface: SurfaceData) -> None:
        self.here = surface.vertices
        self.ends = edges_of(surface.triangles.astype(np.int64)).ends
        self.areas = np.maximum(vertex_areas(surface.vertices, surface.triangles), LEAST_AREA)

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
            np.concatenate([a, b]), np.concatenate([far * self.areas[b], far * self.areas[a]]), n
        )
        # Two dimensions: the variance along one axis is half of the mean square.
        return matrix, max(0.5 * float(np.median(spread / total)), 1e-6)

    def averaged(self, values: Floats, length: float) -> Floats:
        """Values averaged over a length along the surface (standard deviation), mm."""
        matrix, step = self._walk
        return _walked(matrix, max(round(length**2 / step), 1), values)

    def averaged_within(self, values: Floats, weight: Floats, length: float) -> Floats:
        """Values averaged over a length, weighted by positive weights."""
        total = self.averaged(weight, length)
        shape = (len(weight), *(1,) * (values.ndim - 1))
        averaged: Floats = self.averaged(values * weight.reshape(shape), length) / total.reshape(
            shape
        )
        return averaged


def _walked(matrix: Any, steps: int, values: Floats) -> Floats:
    """Values after so many steps of a walk.

    A power of a matrix with eigenvalues from -1 to 1, as those of a reversible walk, is a sum of
    Chebyshev polynomials weighted by binomial coefficients, of which the first suffice (Sachdeva &
    Vishnoi 2014, theorem 3.3): 105 products do for 256 steps.
    """
    degree = math.ceil(math.sqrt(2.0 * steps * math.log(2.0 / LEFT_OUT)))
    if degree >= steps:
        for _ in range(steps):
            values = matrix @ values
        return values
    before, now = values, matrix @ values
    sums = np.zeros_like(values)
    for k in range(degree + 1):
        if (steps - k) % 2 == 0:
            sums += (2.0 if k else 1.0) * (math.comb(steps, (steps - k) // 2) / 2**steps) * before
        before, now = now, 2.0 * (matrix @ now) - before
    return sums


@dataclass(frozen=True, eq=False)
class PairedShape:
    """A bone registered by shape to the same mesh after the operation.

    is_rigid: Whether the bone moved rigidly, apart from a change of size and removed bone.
    bent: (n,), mm. How far the bone after lies off along the normals, on average over neighbours,
        with the change of size removed: how it bent. 0 where it was removed.
    slip: mm. How far vertices slid along the surface, median.
    slid_free: (n, 3), mm. The vertices after without slip and change of size.
    """

    fit: ShapeFit
    is_rigid: bool
    bent: Floats
    slip: float
    slid_free: Floats
    removed: tuple[RemovedBone, ...]
    stray: tuple[StrayPatch, ...]


def paired_shape(before: SurfaceData, after: SurfaceData) -> PairedShape:
    """The registration by shape of a bone to the same mesh after; raises as `fit_shape`.

    Raises `MeshError`: A triangle without area after.
    """
    here, there = before.vertices, after.vertices
    bone = Surface(after.vertices, after.triangles, crease_angle=after.crease_angle)
    fit = fit_shape(before, bone, _trimmed_motion(here, there))
    scaled = fit.carried(here)
    closest, normals, _ = bone.closest(scaled)
    # The mesh shows all the bone that is left, so whatever lies off it is known to be off.
    removed = missing_patches(before, bone, scaled, shown=np.inf)
    stray = stray_patches(before, bone, fit.similarity, fit.sigma)[0]
    on = fit.off <= LIES
    gone = np.zeros(len(here), dtype=bool)
    for patch in removed:
        gone[patch.vertices] = True
    areas = vertex_areas(before.vertices, before.triangles)
    total = areas.sum()
    moved = carried(fit.matrix, here)
    large = [patch.vertices for patch in removed if patch.area >= LEAST_STRAY]
    large += [patch.vertices for patch in stray]
    rest = np.where(gone[:, None], 0.0, closest - scaled)
    along = there - scaled
    along -= (along * normals).sum(axis=1, keepdims=True) * normals
    kept = fit.kept & ~gone
    return PairedShape(
        fit,
        bool(
            areas[on | gone].sum() >= RIGID_SHARE * total
            and areas[on & ~gone].sum() >= LEAST_LYING * total
            and not any(_is_displaced(here, there, bone, patch) for patch in large)
        ),
        _bent(before, ((closest - scaled) * normals).sum(axis=1), ~gone),
        float(np.median(np.linalg.norm(along[kept], axis=1))) if kept.any() else 0.0,
        moved + rest,
        removed,
        # Removed bone is reported once.
        () if removed else stray,
    )


def _bent(before: SurfaceData, off: Floats, kept: NDArray[np.bool_]) -> Floats:
    """Distances along normals, averaged over neighbours that count; 0 for the others, (n,) mm."""
    near, weights = np.clip(off, -LIES, LIES), np.where(kept, 1.0, LEAST_WEIGHT)
    mean = AlongSurface(before).averaged_within(near, weights, AVERAGED)
    return np.where(kept, mean, 0.0)


def _trimmed_motion(here: Floats, there: Floats) -> Floats:
    """The rigid motion of most vertices, robust against the others (Tukey's biweight)."""
    fit = rigid_fit(here, there)
    for _ in range(TRIM_ROUNDS):
        off = fit.residuals
        reach = TUKEY * max(TO_SIGMA * float(np.median(off)), LEAST_SIGMA)
        fit = rigid_fit(here, there, weights=(1.0 - np.minimum(off / reach, 1.0) ** 2) ** 2)
    return fit.matrix


def _is_displaced(here: Floats, there: Floats, bone: Surface, patch: NDArray[np.int64]) -> bool:
    """Whether a patch that the bone's motion leaves off the bone moved as one piece."""
    try:
        own = rigid_fit(here[patch], there[patch]).matrix
    except RegistrationError:
        # Squeezed to a point or a line.
        return False
    moved = carried(own, here[patch])
    return bool((distances(moved, bone) <= OWN).mean() >= OWN_SHARE)
