"""Bone motions given vertex by vertex: the cuts that they show, and bone that is missing.

A skull whose jaw was cut and moved may be given as one surface, before and after. Across the cut,
neighbouring vertices move apart, and the triangles between them are torn: they cover no bone.
`torn_pieces` removes them and returns the pieces, each of which moved as one. If the mesh holds
together across the cut, `coherent_motion` finds the pieces.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cmfsim._core import Surface, SurfaceMotion, rigid_fit
from cmfsim.errors import BoundaryInputError, RegistrationError
from cmfsim.surfaces.checks import duplicate_triangles, has_three_corners, thin_triangles
from cmfsim.surfaces.depth import distances
from cmfsim.surfaces.topology import connected_labels, edges_of
from cmfsim.values.checks import Floats, Plain, in_files
from cmfsim.values.motion import carried
from cmfsim.values.surface_data import MovedSurface, SurfaceData, triangle_areas, used_nodes

# An edge is torn if its ends move apart by more than this, mm, and by more than this share of its
# length: noise of 0.3 mm per vertex does the first to one edge in 10 000, and a turn of 15° the
# second to none.
TEAR = 2.0
TEAR_SHARE = 0.3
# A piece with less of the area than this, mm², is a crumb of a tear, not a segment of bone.
LEAST_AREA = 150.0
# Two pieces moved as one if the motion of either takes the other's vertices this near, rms mm.
ALIKE = 1.0
# Vertices of a piece at which the motion of another piece is evaluated.
SAMPLES = 2000
# A patch of bone is missing if a vertex of it lies further than this from the bone after, mm; it
# reaches as far as its vertices are off by the second: three times the noise of a segmented bone.
REMOVED, REMOVED_RIM = 1.5, 0.75
# What lies further from the bone after than this, mm, is not shown by its scan; patches smaller
# than this, mm², are corners of a cut.
SHOWN, LEAST_PATCH = 10.0, 10.0
# With holes of this share of the area, measured by the sum of all area vectors, inside and outside
# can still be distinguished: they change the winding number by a hundredth.
CLOSED_SHARE = 0.01
Integers = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class RemovedBone(Plain):
    """A patch of bone that is missing after the operation, by vertices of the surface before.

    area: mm², of the surface before.
    depth: mm. The largest distance of a vertex, `place` before, from where the rest would take it.
    """

    area: float = field(metadata=in_files("area_mm2"))
    depth: float = field(metadata=in_files("depth_mm"))
    place: Floats = field(metadata=in_files("place_mm"))
    vertices: Integers = field(metadata=in_files(None))


def sound_motion(motion: MovedSurface) -> MovedSurface:
    """The motion without triangles that are degenerate, before or after, or duplicates.

    Surface files contain some; points near them move with the triangles around them.
    Raises `BoundaryError`: No triangle is left.
    """
    here, there = motion.surface.vertices, motion.moved_vertices
    triangles = motion.surface.triangles.astype(np.int64)
    triangles = triangles[has_three_corners(triangles)]
    keep = np.ones(len(triangles), dtype=bool)
    keep[duplicate_triangles(triangles)] = False
    for vertices in (here, there):
        keep[thin_triangles(vertices, triangles)[0]] = False
    if not keep.any():
        raise BoundaryInputError(
            "no triangle of the moved surface has an area both before and after: give the same "
            "bone before and after, in the same unit"
        )
    return _part(motion, triangles[keep])


def torn_pieces(motion: MovedSurface) -> tuple[MovedSurface, ...]:
    """The pieces of bone, each of which moved as one, the largest first; without torn triangles.

    A piece is connected by edges that are not torn. Those that moved alike are one piece, connected
    or not: islands of a skull stay with it. For a motion of `sound_motion`.
    """
    here, there = motion.surface.vertices, motion.moved_vertices
    triangles = motion.surface.triangles.astype(np.int64)
    ends = edges_of(triangles).ends
    before, after = here[ends[:, 1]] - here[ends[:, 0]], there[ends[:, 1]] - there[ends[:, 0]]
    apart = np.linalg.norm(after - before, axis=1)
    torn = (apart > TEAR) & (apart > TEAR_SHARE * np.linalg.norm(before, axis=1))
    label = connected_labels(ends[~torn], len(here))
    whole = (label[triangles] == label[triangles[:, :1]]).all(axis=1)
    sound = triangles[whole]
    if not len(sound):
        return (motion,)
    piece = label[sound[:, 0]]
    areas = np.bincount(piece, weights=triangle_areas(here, sound), minlength=label.max() + 1)
    order = np.argsort(-areas, kind="stable")
    large = [int(n) for n in order if areas[n] >= LEAST_AREA] or [int(order[0])]
    parts = [_part(motion, sound[piece == number]) for number in large]
    groups: list[list[int]] = []
    for number, part in enumerate(parts):
        alike = next((group for group in groups if moves_as_one(parts[group[0]], part)), None)
        if alike is None:
            groups.append([number])
        else:
            alike.append(number)
    if len(groups) == 1:
        # Fragments and torn triangles of a bone that moved as one are not pieces cut from it.
        return (motion,)
    return tuple(
        _part(motion, sound[np.isin(piece, [large[n] for n in group])]) for group in groups
    )


def moves_as_one(one: MovedSurface, other: MovedSurface) -> bool:
    """Whether the motion of either piece fits the other as well, rigid or bent."""
    return any(_misses(a, b) <= ALIKE for a, b in ((one, other), (other, one)))


def missing_patches(
    segment: SurfaceData, bone: Surface, moved: Floats, *, shown: float = SHOWN
) -> tuple[RemovedBone, ...]:
    """Patches of a segment that are missing from the bone after, registered, the largest first.

    bone: A surface that is not closed encloses nothing, so nothing is found with it.
    moved: (n, 3), mm, where the motion of the segment takes its vertices, with its change of size.
    shown: mm. What lies further from the post-operative bone may be outside its scan, not removed.
    """
    here = segment.vertices
    triangles = segment.triangles.astype(np.int64)
    off = distances(moved, bone)
    far = np.flatnonzero((off > REMOVED_RIM) & (off < shown))
    gone = np.zeros(len(here), dtype=bool)
    if _encloses(bone):
        gone[far[bone.winding_number(moved[far]) < 0.5]] = True
    if not (off[gone] > REMOVED).any():
        return ()
    ends = edges_of(triangles).ends
    label = connected_labels(ends[gone[ends].all(axis=1)], len(here))
    areas = triangle_areas(here, triangles)
    found = []
    for number in np.unique(label[gone & (off > REMOVED)]):
        patch = (label == number) & gone
        area = float(areas[patch[triangles].all(axis=1)].sum())
        worst = int(np.argmax(np.where(patch, off, 0.0)))
        if area >= LEAST_PATCH:
            found.append(
                RemovedBone(area, float(off[worst]), here[worst].copy(), np.flatnonzero(patch))
            )
    return tuple(sorted(found, key=lambda patch: -patch.area))


def _encloses(bone: Surface) -> bool:
    """Whether a surface is closed, but for triangles without area that were taken out of it."""
    if bone.is_closed:
        return True
    vertices, triangles = bone.vertices, bone.triangles
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    # The area vectors of a closed surface sum to zero.
    open_area = 0.5 * np.linalg.norm(np.cross(b - a, c - a).sum(axis=0))
    return bool(open_area <= CLOSED_SHARE * bone.area)


def _misses(one: MovedSurface, other: MovedSurface) -> float:
    """The rms error of the motion of one piece, applied to the vertices of another."""
    vertices, went = other.surface.vertices, other.moved_vertices
    step = -(-len(vertices) // SAMPLES)
    vertices, went = vertices[::step], went[::step]
    surface = one.surface
    bent = SurfaceMotion(Surface(surface.vertices, surface.triangles), one.moved_vertices)
    missed = [vertices + bent.displacement(vertices) - went]
    rigid = _rigid(surface.vertices, one.moved_vertices)
    if rigid is not None:
        missed.append(carried(rigid, vertices) - went)
    return min(float(np.sqrt((m**2).sum(axis=1).mean())) for m in missed)


def _rigid(here: Floats, there: Floats) -> Floats | None:
    """The best rigid motion; none where the vertices lie on a line."""
    try:
        return rigid_fit(here, there).matrix
    except RegistrationError:
        return None


def _part(motion: MovedSurface, triangles: Integers) -> MovedSurface:
    """The motion of some of its triangles, and of their vertices only."""
    used, corners = used_nodes(triangles)
    surface = SurfaceData(motion.surface.vertices[used], corners, motion.surface.crease_angle)
    return MovedSurface(surface, motion.moved_vertices[used])
