"""Bone motions vertex by vertex, as rigid pieces, how bone bends, and bone that was removed.

The jaw of a skull may be cut and moved within one surface. Each piece then moves rigidly, the mesh
stretches between them, vertices of a fitted template slide along the bone, and those of resected
bone are squeezed onto what is left. `coherent_motion` finds the pieces and tells these apart: what
lies along the normals is seen in the scans and followed, what lies along the surface is followed as
far as bending explains it, and only a patch that sank into its own piece, and did not move as one,
counts as removed.
"""

import logging
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cmfsim._core import IcpFit, Surface
from cmfsim.bones.motion import RemovedBone, missing_patches
from cmfsim.bones.pairs.rigid_pieces import PASSES, QUIET, PairedBone, median, rigid_pieces
from cmfsim.bones.pairs.shape_fit import ShapeFit, fit_shape
from cmfsim.errors import RegistrationError, RegistrationInputError
from cmfsim.registration import icp
from cmfsim.values.checks import Floats, Frozen, Plain, as_number, as_positive, in_files
from cmfsim.values.motion import carried
from cmfsim.values.surface_data import MovedSurface, SurfaceData

_LOG = logging.getLogger(__name__)

# Points of the quick search for a start, and its steps from each candidate.
QUICK_POINTS = 400
QUICK_STEPS = 20
# Points of the quick fits in which the size may change.
SIZED_POINTS = 1500
# The search has converged when a step moves no point by more than this share of the segment's size,
# some micrometres: below it, a bone of another size only swaps partners, and a robust fit follows.
REST = 1e-4
# At the end, the largest RMS distance of the partners, mm, and the least share of the vertices that
# have one: a worse fit is an error.
MAX_RMS, LEAST_SHARE = 1.0, 0.3
MOST_STEPS = 300


@dataclass(frozen=True)
class MatchOptions:
    """Options of the registration of a bone segment to the post-operative bone.

    Attributes
    ----------
    trim : float
        Share of the segment's vertices, those furthest from the bone, that are ignored in the
        search: cut faces, plates, bone that was ground away. 0 to below 1.
    reach : float, mm
        The search also starts this far to each side along each axis, for segments that moved far
        enough to be matched to neighbouring bone; 0: only from the place before the operation.
    max_angle : float, degrees
        Largest angle between normals of partners: prevents matching the inner to the outer side of
        a bone.

    Raises
    ------
    RegistrationError, CaseError
        (also `ValueError`) A value out of its range; not a number.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.MatchOptions(trim=0.4).reach
    6.0
    """

    trim: float = 0.3
    reach: float = 6.0
    max_angle: float = 60.0

    def __post_init__(self) -> None:
        as_positive("max_angle", self.max_angle)
        if as_number("reach", self.reach) < 0.0:
            raise RegistrationInputError(f"reach is {self.reach:g} mm: must not be below 0")
        if not 0.0 <= as_number("trim", self.trim) < 1.0:
            raise RegistrationInputError(f"trim is {self.trim:g}: must be from 0 to below 1")


def lay_on(name: str, segment: SurfaceData, bone: Surface, options: MatchOptions) -> ShapeFit:
    """The fit of a segment, called by its name, to the bone after, or a `RegistrationError`."""
    try:
        moving = Surface(segment.vertices, segment.triangles, crease_angle=segment.crease_angle)
        found = icp(
            moving,
            bone,
            initial=_start(segment.vertices, bone, options),
            trim=options.trim,
            max_angle=options.max_angle,
            max_iterations=MOST_STEPS,
            tolerance=REST,
        )
        start = _sized_start(segment, bone, found.matrix, options)
        fit = fit_shape(segment, bone, start, max_angle=options.max_angle)
    except RegistrationError as error:
        raise RegistrationError(
            f"segment {name!r} cannot be registered to the post-operative bone: {error}"
        ) from error
    share = float(fit.kept.mean())
    if fit.rms > MAX_RMS or share < LEAST_SHARE:
        raise RegistrationError(
            f"segment {name!r} does not fit the post-operative bone: {fit.rms:.2f} mm rms over "
            f"{share:.0%} of its vertices, at the best size (allowed {MAX_RMS:g} mm, at "
            f"least {LEAST_SHARE:.0%}); check that the scans are aligned, that the "
            "segment is cut as it was in the operation, and that the scan shows the whole bone; "
            "a larger trim ignores plates and new bone"
        )
    _LOG.info("segment %s: %.3f mm rms, %.0f %% kept", name, fit.rms, 100 * share)
    return fit


def _sized_start(
    segment: SurfaceData, bone: Surface, matrix: Floats, options: MatchOptions
) -> Floats:
    """The best start of a fit in which the size may change.

    A bone of another size may be closest when it is rotated by some degrees, so the pose found at
    the same size competes with those that a quick fit finds from the place before the operation.
    """
    best, least = matrix, np.inf
    for start in (matrix, *_starts(options)):
        try:
            fit = fit_shape(
                segment, bone, start, max_angle=options.max_angle, most_points=SIZED_POINTS
            )
        except RegistrationError:
            # From there the fit shrinks to a part of the bone, or finds none.
            continue
        nearest = np.sort(fit.off)[: max(int((1.0 - options.trim) * len(fit.off)), 1)]
        if float(nearest.mean()) < least:
            best, least = fit.matrix, float(nearest.mean())
    return best


def _starts(options: MatchOptions) -> list[Floats]:
    """Starts of a search, (4, 4) mm: at the segment's position, and to each side of it."""
    shifts = [np.zeros(3)]
    if options.reach > 0.0:
        shifts += [sign * options.reach * axis for axis in np.eye(3) for sign in (-1.0, 1.0)]
    starts = np.tile(np.eye(4), (len(shifts), 1, 1))
    starts[:, :3, 3] = shifts
    return list(starts)


def _start(vertices: Floats, bone: Surface, options: MatchOptions) -> Floats:
    """The best of several short searches, from where the segment was and from either side."""
    # Points from all over the segment, in whatever order the file has the vertices.
    order = np.random.default_rng(0).permutation(len(vertices))[:QUICK_POINTS]
    points = vertices[order]
    best: IcpFit | None = None
    for start in _starts(options):
        fit = icp(
            points,
            bone,
            initial=start,
            trim=options.trim,
            max_iterations=QUICK_STEPS,
            # Reaching the step limit is expected: the search continues from the best.
            tolerance=0.0,
        )
        if best is None or fit.rms < best.rms:
            best = fit
    return np.eye(4) if best is None else best.matrix


Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]

# Next to other pieces vertices are followed as they are: the mesh stretches there. Shares of a
# vertex's own piece over this length, mm, and between them; the first is reached 6.6 mm from a
# border.
BETWEEN = 4.0
NEAR_ANOTHER, WELL_WITHIN = 0.95, 0.995
# Unless the pieces take it less than this apart, mm.
APART = 2.0
# What varies over more than this length along the surface, mm, is judged for a piece as a whole.
SLOW = 16.0
# Neighbourhood over which noise is averaged, mm: bone does not bend within it.
AVERAGED = 3.0
# The weight of a vertex between pieces in such averages.
LEAST_WEIGHT = 1e-6
# The motion of a piece is known if the median deviation along its normals is below this, mm.
KNOWN = 0.35
# A patch of removed bone ends abruptly: this far around it, the median deviation of vertices is at
# most this share of the largest in the patch. A bone that bends deviates all around.
RING, RING_SHARE = 6.0, 0.35
# Vertices further than this from where their surroundings went, mm, are none of these.
OUT_OF_LINE = 0.75
# A larger patch, mm², moved: no operation grinds away so much of a surface.
MOST_REMOVED = 1500.0
# Smaller ones, mm², are corners and rims.
LEAST_PATCH = 20.0
# A patch lies within a piece, away from others, if so much of its surroundings is of that piece;
# its vertices lie well within.
WITHIN = 0.9
# What vertices slide along curved bone is no sign of missing bone: a patch is deeper than so many
# times their slip, rms. For slip of two directions, that is the second times the median.
SLID, TO_RMS = 1.5, 1.2
# A piece of bone is at most this thick, mm: if it moved, its other side went outwards.
THICK = 12.0
# Of a patch that was ground off, nearly all went inwards; a piece of bone has two sides.
INWARDS = -0.7


@dataclass(frozen=True, eq=False)
class RigidPiece(Plain, Frozen):
    """A part of a bone that moved as one, by a rigid motion (4, 4): its area, mm², and vertices."""

    matrix: Floats
    area: float = field(metadata=in_files("area_mm2"))
    vertices: Integers = field(metadata=in_files(None))


@dataclass(frozen=True, eq=False)
class CoherentMotion:
    """The motion of a bone in pieces, without noise, slip and removed bone; largest first.

    slip: mm. How far vertices slid along the bone: the rms of what was taken off.
    noise: mm. The rms of the noise that was averaged out; 0 where it is too small to matter.
    """

    motion: MovedSurface
    pieces: tuple[RigidPiece, ...]
    removed: tuple[RemovedBone, ...]
    slip: float
    noise: float


def coherent_motion(motion: MovedSurface) -> CoherentMotion:
    """The motion of a bone in rigid pieces (see `rigid_pieces`), of a motion of `sound_motion`.

    What deviates from the pieces is slip as far as bending does not explain it (Wiener's filter);
    bone is removed where the bone after lies off the place to which the surroundings went.
    """
    paired = PairedBone(motion)
    matrices, piece = rigid_pieces(paired)
    deviation = _Deviation(paired, matrices, piece)
    removed = _removed(paired, matrices, piece, deviation)
    rest, noise = _denoised(paired, deviation.rest, removed, deviation.inner)
    rest, slip = _followed(paired, rest, deviation, piece)
    found = []
    for number, matrix in enumerate(matrices):
        mine = np.flatnonzero(piece == number)
        found.append(RigidPiece(matrix, float(paired.areas[mine].sum()), mine))
    return CoherentMotion(
        MovedSurface(motion.surface, deviation.rigid + rest), tuple(found), removed, slip, noise
    )


def _denoised(
    paired: PairedBone, rest: Floats, gone: tuple[RemovedBone, ...], inner: Floats
) -> tuple[Floats, float]:
    """Deviations averaged over neighbours, those of removed bone like those round it.

    Also the rms of the noise, mm; deviations with hardly any are returned as they are.
    """
    if gone:
        rest = rest.copy()
    for patch in gone:
        inside = _inside(patch, len(rest))
        ring = _ring(paired.here, inside, RING)
        rest[inside] = np.average(rest[ring], axis=0, weights=paired.areas[ring])
    smooth = paired.averaged_within(rest, inner + LEAST_WEIGHT, AVERAGED)
    square = ((rest - smooth) ** 2).sum(axis=1)
    noise = float(np.sqrt(np.average(square, weights=paired.areas * (inner + LEAST_WEIGHT))))
    if noise <= QUIET:
        return rest, 0.0
    return rest + inner[:, None] * (smooth - rest), noise


class _Deviation:
    """How the vertices after lie off the rigid motion of their pieces."""

    def __init__(self, paired: PairedBone, pieces: list[Floats], piece: Integers) -> None:
        share = np.eye(len(pieces))[piece]
        passing = paired.averaged(share, PASSES)
        taken = np.stack([carried(matrix, paired.here) for matrix in pieces], axis=1)
        self.rigid: Floats = (passing[:, :, None] * taken).sum(axis=1)
        turns = np.array([matrix[:3, :3] for matrix in pieces])[piece]
        self.normals: Floats = np.einsum("nij,nj->ni", turns, paired.normals)
        # The share of its own piece round each vertex; and 1 well within a piece, 0 near another.
        near = paired.averaged(share, BETWEEN)
        self.own: Floats = near.max(axis=1)
        inner = np.clip((self.own - NEAR_ANOTHER) / (WELL_WITHIN - NEAR_ANOTHER), 0, 1)
        # How far apart the pieces round a vertex take it, mm.
        own = taken[np.arange(len(piece)), piece]
        apart = np.linalg.norm(taken - own[:, None], axis=2)
        self.apart: Floats = np.where(near > 1.0 - WELL_WITHIN, apart, 0.0).max(axis=1)
        self.inner: Floats = np.maximum(inner, 1.0 - np.minimum(self.apart / APART, 1.0))
        self.rest: Floats = paired.there - self.rigid

    def split(self, rest: Floats) -> tuple[Floats, Floats]:
        """Deviations along the normals and along the surface, (n, 3) each."""
        out = (rest * self.normals).sum(axis=1, keepdims=True) * self.normals
        return out, rest - out

    def squares(self, rest: Floats) -> tuple[Floats, Floats]:
        """Deviations along the surface, and the squares of those along normal and surface."""
        out, along = self.split(rest)
        return along, np.column_stack([(out**2).sum(axis=1), (along**2).sum(axis=1)])


def _followed(
    paired: PairedBone, rest: Floats, deviation: _Deviation, piece: Integers
) -> tuple[Floats, float]:
    """Deviations without slip, and the rms of what was subtracted, mm.

    A shell bends along its normals and hardly stretches, so the mean square of its deviations is at
    most as large along the surface as along the normal; what exceeds that is slip. The share that
    is kept is that of Wiener's filter: of what varies slowly for each piece, of the remainder place
    by place.
    """
    weight = deviation.inner + LEAST_WEIGHT
    slow = paired.averaged_within(rest, weight, SLOW)
    along, squares = deviation.squares(slow)
    means = np.stack([np.bincount(piece, paired.areas * weight * square) for square in squares.T])
    taken = (1.0 - _kept(*means))[piece, None] * along
    along, squares = deviation.squares(rest - slow)
    taken += (1.0 - _kept(*paired.averaged_within(squares, weight, SLOW).T))[:, None] * along
    taken *= deviation.inner[:, None]
    slip = float(np.sqrt(np.average((taken**2).sum(axis=1), weights=paired.areas)))
    return rest - taken, slip


def _kept(normal: Floats, along: Floats) -> Floats:
    """The share of deviations along the surface that is kept, of mean squares."""
    kept: Floats = np.minimum(normal / np.maximum(along, 1e-12), 1.0)
    return kept


def _removed(
    paired: PairedBone, pieces: list[Floats], piece: Integers, deviation: _Deviation
) -> tuple[RemovedBone, ...]:
    """The patches of bone that are gone from within their piece."""
    surface = paired.motion.surface
    after = Surface(paired.there, surface.triangles)
    along = np.linalg.norm(deviation.split(deviation.rest)[1], axis=1)
    slid = TO_RMS * np.sqrt(median(along**2, paired.areas))
    # Bone is missing from where its surroundings went.
    weight = deviation.inner
    for _ in range(2):
        slow = paired.averaged_within(deviation.rest, weight + LEAST_WEIGHT, SLOW)
        out = ((deviation.rest - slow) * deviation.normals).sum(axis=1)
        weight = deviation.inner * (np.abs(out) < OUT_OF_LINE)
    # Only bone whose motion is known shows what is missing from it.
    known = [
        median(np.abs(out[piece == number]), paired.areas[piece == number]) <= KNOWN
        for number in range(len(pieces))
    ]
    # Between pieces that moved apart the mesh is stretched or squeezed: vertices are followed.
    together = deviation.apart <= 0.5 * APART
    within = (deviation.own >= WELL_WITHIN) | together
    found = []
    for patch in missing_patches(surface, after, deviation.rigid + slow, shown=np.inf):
        inside = _inside(patch, len(piece))
        number = int(piece[patch.vertices[0]])
        ring = _ring(paired.here, inside, RING)
        if (
            patch.area >= LEAST_PATCH
            and patch.depth >= SLID * slid
            and known[number]
            and within[inside].all()
            and (together | (piece == number))[ring].mean() >= WITHIN
            and float(np.median(np.abs(out[ring]))) <= RING_SHARE * patch.depth
            and _may_be_ground(paired, pieces[number], inside)
            and not _has_another_side(paired, inside, out)
        ):
            found.append(patch)
    return tuple(found)


def _has_another_side(paired: PairedBone, patch: Mask, out: Floats) -> bool:
    """Whether bone near a patch went outwards: the other side of a piece that moved."""
    raised = _ring(paired.here, patch, THICK) & (out > OUT_OF_LINE)
    return bool(paired.areas[raised].sum() >= 0.5 * paired.areas[patch].sum())


def _inside(patch: RemovedBone, count: int) -> Mask:
    """Which vertices lie in a patch."""
    inside = np.zeros(count, dtype=bool)
    inside[patch.vertices] = True
    return inside


def _ring(here: Floats, patch: Mask, reach: float) -> Mask:
    """The vertices around a patch."""
    box = (here >= here[patch].min(axis=0) - reach) & (here <= here[patch].max(axis=0) + reach)
    ring: Mask = box.all(axis=1) & ~patch
    return ring


def _may_be_ground(paired: PairedBone, matrix: Floats, patch: Mask) -> bool:
    """Whether a patch is small and went inwards all over."""
    areas = paired.areas * patch
    off = paired.there - carried(matrix, paired.here)
    out = (off * (paired.normals @ matrix[:3, :3].T)).sum(axis=1)
    return bool(
        areas.sum() <= MOST_REMOVED and (areas * out).sum() <= INWARDS * (areas * np.abs(out)).sum()
    )
