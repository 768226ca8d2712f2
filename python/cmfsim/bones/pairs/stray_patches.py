"""Patches of a segment that lie off the post-operative bone after registration.

The registration ignores what does not fit, so that a piece that moved differently, or was removed,
does not distort the motion of the rest. The whole segment then gets the motion of the rest, and the
user must know of such a piece.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim._core import Surface
from cmfsim.surfaces.topology import connected_labels, edges_of
from cmfsim.values.checks import Floats
from cmfsim.values.surface_data import SurfaceData

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


@dataclass(frozen=True, eq=False)
class StrayPatch:
    """A patch of a segment that lies off the bone after the operation.

    area: mm², of the surface before.
    distance: mm, from the post-operative bone, after the segment's motion; median of the patch's
        vertices.
    place: (3,), mm. The vertex nearest to the middle of the patch, before.
    has_bone: Whether bone lies within reach that may be this patch, displaced, or what is left of
        it after grinding; else it was removed, lies outside the scan, or moved further.
    vertices: (n,) int64, of the segment, that lie in the patch.
    """

    area: float
    distance: float
    place: Floats
    has_bone: bool
    vertices: NDArray[np.int64]

    def as_dict(self) -> dict[str, Any]:
        """Plain values with units in their names, as JSON holds them."""
        return {
            "area_mm2": self.area,
            "distance_mm": self.distance,
            "place_mm": self.place.tolist(),
            "has_bone": self.has_bone,
        }


def stray_patches(
    segment: SurfaceData,
    bone: Surface,
    matrix: Floats,
    rms: float,
    beside: Sequence[SurfaceData] = (),
) -> tuple[tuple[StrayPatch, ...], Floats]:
    """The patches of a segment that lie off the bone, and how far off each vertex is.

    segment: Before.
    bone: After.
    matrix: (4, 4), mm. The motion of the segment.
    rms: mm. Residual of the fit over the vertices that it keeps.
    beside: The other segments before: what touches them was cut, and is not searched for.
    Returns `patches`: The largest first.
    Returns `off`: (n,), mm. Distance of each vertex from the bone.
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
        nearest = Surface(other.vertices, other.triangles).closest(here[asked])[0]
        stray[asked[np.linalg.norm(nearest - here[asked], axis=1) <= CUT_FACE]] = False
    if not stray.any():
        return (), off
    normals = Surface(segment.vertices, segment.triangles).vertex_normals
    alike = ((normals @ turn.T) * facing).sum(axis=1) >= FACING
    ends = edges_of(triangles).ends
    label = connected_labels(ends[stray[ends].all(axis=1)], len(here))
    whole = triangles[stray[triangles].all(axis=1)]
    a, b, c = (here[whole[:, i]] for i in range(3))
    areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
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
