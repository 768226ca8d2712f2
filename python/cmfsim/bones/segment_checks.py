"""Whether each segment has its own surface: that of its level, and of no other segment.

If surfaces are exchanged somewhere, the face looks right and is wrong. Each surface is therefore
compared with the level that it was made from.
"""

import hashlib
from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseError
from cmfsim.surfaces.checks import areas_volumes
from cmfsim.surfaces.levels import block_of
from cmfsim.values.anatomy import BoneSegment
from cmfsim.values.checks import Floats

# Smoothing and decimation keep a surface within half a voxel of the zero set of its level, so that
# the cube of three voxels about a vertex holds voxels on both sides. Share of the vertices of which
# that must be true: 1.00 on the 18 segments of three real heads after Le Fort I, BSSO and
# genioplasty; on the level of a neighbour 0.67 at most, of a chin of 142 voxels.
LEAST_SHARE = 0.8
# The same of a surface that was given: inner walls that face outwards lie inside the filled bone.
LEAST_GIVEN_SHARE = 0.5
# The volume inside the surface against that of the voxels inside the level: 0.86 (that chin) to
# 1.00 on the same segments.
VOLUME_RATIO = (0.6, 1.6)
# Below this volume, in voxels, the ratio is that of the grid and not of the bone.
LEAST_VOXELS = 500
# Vertices that are looked up, evenly taken.
SAMPLES = 20_000


def check_segments(segments: Sequence[BoneSegment], given: Collection[str] = ()) -> None:
    """Raises an error if a segment has another's surface, or one that does not match its level.

    given: Segments whose level was made from the surface, and filled: the surface may have more
        walls, and another volume.
    Raises `CaseError`: With the names; the surface encloses another volume, or lies off the level.
    """
    known: dict[bytes, str] = {}
    for segment in segments:
        key = _key(segment)
        if key in known:
            raise CaseError(
                f"segments {known[key]!r} and {segment.name!r} have the same surface, vertex by "
                "vertex, so that one would move with the other's tissue; if the case names one "
                "file for two bones, correct it; otherwise report this as a bug in cmfsim"
            )
        known[key] = segment.name
    for segment in segments:
        _check_lies_on_level(segment, is_given=segment.name in given)


def _key(segment: BoneSegment) -> bytes:
    vertices = np.ascontiguousarray(segment.surface.vertices, dtype=np.float64)
    triangles = np.ascontiguousarray(segment.surface.triangles, dtype=np.int64)
    digest = hashlib.sha256(vertices.tobytes())
    digest.update(triangles.tobytes())
    return digest.digest()


def _check_lies_on_level(segment: BoneSegment, *, is_given: bool) -> None:
    level = segment.level
    spacing = level.spacing
    values = level.values
    vertices = segment.surface.vertices
    inside = values > 0.0
    share = float(_on_zero_set(inside, (vertices - level.lowest) / spacing).mean())
    why = "its surface was exchanged or damaged in processing: report this as a bug in cmfsim"
    least = LEAST_GIVEN_SHARE if is_given else LEAST_SHARE
    if is_given:
        why = "check that the case names a different surface for each bone"
    if share < least:
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        first, past = block_of(inside)
        box = level.lowest + first * spacing, level.lowest + (past - 1) * spacing
        raise CaseError(
            f"the surface of segment {segment.name!r} is not that of its bone: {share:.0%} of its "
            f"vertices lie on the bone (at least {least:.0%} is needed); the surface reaches "
            f"from {_place(low)} to {_place(high)} mm, the bone from {_place(box[0])} to "
            f"{_place(box[1])} mm; {why}"
        )
    if is_given:
        return
    count = int(np.count_nonzero(inside))
    volumes = areas_volumes(vertices, segment.surface.triangles.astype(np.int64))[1]
    ratio = float(volumes.sum()) / (count * float(np.prod(spacing)))
    if count >= LEAST_VOXELS and not VOLUME_RATIO[0] <= ratio <= VOLUME_RATIO[1]:
        raise CaseError(
            f"the surface of segment {segment.name!r} encloses {ratio:.2f} times the volume of its "
            f"bone ({VOLUME_RATIO[0]:g} to {VOLUME_RATIO[1]:g} is allowed): {why}"
        )


def _on_zero_set(inside: NDArray[np.bool_], places: Floats) -> NDArray[np.bool_]:
    """Whether the cube of three voxels around each place (in voxels) contains both sides."""
    places = places[:: -(-len(places) // SAMPLES)]
    low, high = block_of(inside)
    # Beyond the image is outside: surfaces are closed at its border. Farther off, all is.
    rim = 3
    block = np.pad(inside[tuple(slice(*ends) for ends in zip(low, high, strict=True))], rim)
    index = np.rint(places).astype(np.intp) - low + rim
    index = np.clip(index, 1, np.array(block.shape) - 2)
    cube = np.ravel_multi_index(np.indices((3, 3, 3)).reshape(3, -1), block.shape)
    near = block.ravel()[np.ravel_multi_index((index - 1).T, block.shape)[:, None] + cube]
    return np.asarray(near.any(axis=1) & ~near.all(axis=1))


def _place(point: Floats) -> str:
    return "(" + ", ".join(f"{x:.0f}" for x in point.tolist()) + ")"
