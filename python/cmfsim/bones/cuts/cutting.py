"""Bones cut into segments: their levels, a bone divided midway between two, small fragments."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim import _core
from cmfsim._core import Surface
from cmfsim.bones.cuts.planes import Cut, Procedure
from cmfsim.bones.cuts.procedures import PROCEDURES, place_procedure
from cmfsim.bones.segment_checks import check_segments
from cmfsim.errors import CaseInputError, third_party
from cmfsim.surfaces.depth import distances
from cmfsim.surfaces.levels import SurfaceOptions, block_of, surface_of_level
from cmfsim.values.anatomy import BoneSegment
from cmfsim.values.checks import Floats, check_instance
from cmfsim.values.finding import Finding
from cmfsim.values.image_data import ImageData
from cmfsim.values.surface_data import SurfaceData

# Beyond this distance from the box round a smaller piece, mm, bone belongs to the largest: the
# hollows of a jaw reach no further over its surface.
BESIDE = 15.0
# A piece with less bone than this, mm³, has no tissue attached to it alone.
LEAST_VOLUME = 100.0

Levels = NDArray[np.float32]
# The upper jaw's cuts come before the lower's, the larger piece before the one inside it.
ORDER = {"le_fort_3": 0, "le_fort_1": 1, "bsso": 2, "genioplasty": 3}
# A fragment smaller than this, mm³, that a cut separates from its segment stays with the segment on
# the other side of the cut, to which it is connected.
CRUMB_VOLUME = 500.0
# Half-width of the block of voxels that is transferred with a fragment.
CRUMB_RIM = 2
# Edge of the blocks in which distances from planes are measured, voxels.
BLOCK = 24
# Number of surfaces made concurrently.
SURFACES_AT_ONCE = 2


@dataclass(frozen=True, eq=False)
class CutBones:
    """The segments of all bones, with the findings of cutting.

    Attributes
    ----------
    segments : tuple of BoneSegment
        Uncut bones first, each under its own name.
    procedures : tuple of Procedure
        As placed, with all planes and options.
    findings : tuple of Finding
    """

    segments: tuple[BoneSegment, ...]
    procedures: tuple[Procedure, ...] = ()
    findings: tuple[Finding, ...] = ()

    def __getitem__(self, name: str) -> BoneSegment:
        for segment in self.segments:
            if segment.name == name:
                return segment
        known = ", ".join(repr(s.name) for s in self.segments)
        raise CaseInputError(f"there is no segment {name!r}; segments are: {known}")


def cut_bones(
    bones: Mapping[str, ImageData],
    procedures: Sequence[Procedure] | Mapping[str, Mapping[str, float]] = (),
    *,
    landmarks: Mapping[str, ArrayLike] | None = None,
    surface: SurfaceOptions | None = None,
) -> CutBones:
    """The segments into which osteotomies cut the bones.

    Parameters
    ----------
    bones : mapping of str to ImageData
        Levels (positive inside) on one grid: "cranium" and "mandible" for the standard procedures.
    procedures : sequence of Procedure, or mapping of procedure name to options
        Standard procedures are applied from top to bottom, then the others in their order.
    landmarks : mapping of str to (3,) float64, mm, optional
        Skull landmarks, LPS; needed where procedures are given by name.
    surface : SurfaceOptions, optional

    Raises
    ------
    CaseError
        Two segments with the same surface, or one whose surface is not that of its level; also
        `ValueError`: no bone to cut, a cut that misses its bone or leaves nothing of it, two pieces
        with one name.
    LandmarkError
        (also `ValueError`) A missing landmark; the message names it and the procedure.

    Notes
    -----
    The level of a piece is the minimum of the bone's level and the planes' signed distances, and
    that of the rest the minimum of the bone's level and their negative: no voxel is lost or counted
    twice, and the cut is on the plane to a fraction of a voxel.

    Examples
    --------
    >>> import cmfsim, numpy as np
    >>> ball = cmfsim.ImageData(np.zeros((20, 20, 20)), spacing=(1, 1, 1))
    >>> x, y, z = ball.axes()
    >>> ball = ball.with_values(7 - np.sqrt((x - 10) ** 2 + (y - 10) ** 2 + (z - 10) ** 2))
    >>> plane = cmfsim.CuttingPlane((0, 0, 8), (0, 0, -1))
    >>> cut = cmfsim.free_cut("mandible", "chin", (plane,), rest="mandible_body")
    >>> [s.name for s in cmfsim.cut_bones({"mandible": ball}, [cut]).segments]
    ['mandible_body', 'chin']
    """
    if not bones:
        raise CaseInputError("there is no bone to cut")
    for name, level in bones.items():
        check_instance(f"bone {name!r}", level, ImageData)
        first = next(iter(bones.values()))
        same = level.values.shape == first.values.shape and all(
            np.array_equal(getattr(level, n), getattr(first, n)) for n in ("spacing", "origin")
        )
        if not same:
            raise CaseInputError(f"bone {name!r} is not on the same grid as {next(iter(bones))!r}")
    placed = _placed(procedures, landmarks or {})
    findings = [f for p in placed for f in p.findings]
    pieces: dict[str, Levels] = {name: level.single for name, level in bones.items()}
    grid = next(iter(bones.values()))
    for procedure in placed:
        for cut in procedure.cuts:
            _make_cut(procedure, cut, grid, pieces, findings=findings)
    levels = {name: grid.with_values(values) for name, values in pieces.items()}
    return CutBones(_checked_segments(levels, surface), placed, tuple(findings))


def _checked_segments(
    levels: Mapping[str, ImageData], options: SurfaceOptions | None = None
) -> tuple[BoneSegment, ...]:
    """Segments of levels, with their surfaces."""
    # Marching cubes and smoothing of one piece go on while another is decimated; decimation itself
    # takes one piece at a time.
    with ThreadPoolExecutor(SURFACES_AT_ONCE) as pool:
        made = pool.map(lambda name: surface_of_level(name, levels[name], options), levels)
        named = zip(levels.items(), made, strict=True)
        segments = tuple(BoneSegment(name, level, surface) for (name, level), surface in named)
    check_segments(segments)
    return segments


def segments_from_surfaces(
    levels: Mapping[str, ImageData], surfaces: Mapping[str, SurfaceData]
) -> tuple[BoneSegment, ...]:
    """Bone segments from given surfaces; nothing is cut.

    Parameters
    ----------
    levels : mapping of str to ImageData
        As in `Anatomy.bones`.
    surfaces : mapping of str to SurfaceData
        As in `Anatomy.surfaces`; a level without one gets the surface of its zero set, and "skin"
        is ignored.

    Raises
    ------
    CaseError
        Two segments with the same surface, or one whose surface is not that of its level; also
        `ValueError`: a surface without a level.

    Examples
    --------
    >>> import cmfsim
    >>> found = cmfsim.segments_from_surfaces(anatomy.bones, anatomy.surfaces)
    >>> [segment.name for segment in found]
    ['cranium', 'mandible']
    """
    for name in surfaces:
        if name != "skin" and name not in levels:
            known = ", ".join(repr(n) for n in levels) or "none"
            raise CaseInputError(f"surface {name!r} has no level; levels are: {known}")
    segments = tuple(
        BoneSegment(
            name, level, surfaces[name] if name in surfaces else surface_of_level(name, level)
        )
        for name, level in levels.items()
    )
    check_segments(segments, given=surfaces)
    return segments


def _placed(
    procedures: Sequence[Procedure] | Mapping[str, Mapping[str, float]],
    landmarks: Mapping[str, ArrayLike],
) -> tuple[Procedure, ...]:
    if isinstance(procedures, Mapping):
        placed = [place_procedure(kind, landmarks, table) for kind, table in procedures.items()]
    else:
        placed = list(procedures)
        for procedure in placed:
            check_instance("procedure", procedure, Procedure)
    # Sorting is stable: free cuts keep their order, after the standard ones.
    return tuple(sorted(placed, key=lambda p: ORDER.get(p.kind, len(ORDER))))


def _make_cut(
    procedure: Procedure,
    cut: Cut,
    grid: ImageData,
    pieces: dict[str, Levels],
    *,
    findings: list[Finding],
) -> None:
    source, rest_name = _names_of_cut(procedure, cut, pieces)
    if source == "skull" and cut.joined is not None:
        findings.append(
            Finding(
                "cut-of-joined-jaws",
                f"{cut.segment!r} is cut from a skull whose jaws are not separated; it ends at the "
                "edges of the upper teeth: bone below stays where it is, but the front of the rami "
                "may move with it",
                where=procedure.kind,
            )
        )
    cut = cut.of(source)
    bone = pieces[source]
    limit = max(float(bone.max()), -float(bone.min()))
    # Where the bone's level is clipped, so are those of both pieces.
    low, high = block_of(bone > -limit)
    box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    whole, bone = bone, bone[box]
    part_grid = ImageData(bone, grid.spacing, grid.lowest + low * grid.spacing)
    region = _scaled(cut, part_grid, limit)
    piece, rest = np.minimum(bone, region), np.minimum(bone, -region)
    voxel = float(np.prod(grid.spacing))
    names = (cut.segment, rest_name)
    planes = ", ".join(sorted({p.name for group in cut.groups for p in group}))
    for name, part in ((cut.segment, piece), (rest_name, rest)):
        if not (part > 0.0).any():
            what = "misses the bone" if name == cut.segment else "takes the whole bone"
            raise CaseInputError(
                f"{procedure.kind}: the cut of {cut.segment!r} from {source!r} {what} "
                f"(planes: {planes}): check the landmarks, or move the planes"
            )
    for one, other, both in ((piece, rest, names), (rest, piece, names[::-1])):
        moved, kept = _join_crumbs(one, other, bone, limit, int(CRUMB_VOLUME / voxel))
        volumes = ([n * voxel for n in moved], [n * voxel for n in kept])
        findings.extend(_fragment_findings(procedure.kind, both, *volumes))
    # Clipped beyond the box.
    parts = (np.full(whole.shape, np.float32(-limit)), np.full(whole.shape, np.float32(-limit)))
    parts[0][box], parts[1][box] = rest, piece
    others = list(pieces.items())
    pieces.clear()
    for name, values in others:
        pieces[rest_name if name == source else name] = parts[0] if name == source else values
    pieces[cut.segment] = parts[1]


def _names_of_cut(procedure: Procedure, cut: Cut, pieces: Iterable[str]) -> tuple[str, str]:
    """The piece that is cut, and the name of what remains of it."""
    pieces = list(pieces)
    source = next((name for name in cut.sources if name in pieces), None)
    is_joined = source == "skull" and procedure.kind in PROCEDURES and cut.joined is None
    if source is None or is_joined:
        have = ", ".join(repr(n) for n in pieces)
        raise CaseInputError(
            f"{procedure.kind} cuts {' or '.join(repr(s) for s in cut.sources if s != 'skull')}, "
            f"but the bones are {have}: separate the jaws (give landmarks to the segmentation), or "
            "give the surfaces of the segments"
        )
    rest_name = cut.rest or source
    if cut.segment in pieces or (rest_name != source and rest_name in pieces):
        raise CaseInputError(
            f"{procedure.kind} makes {cut.segment!r}, but a segment of this name already exists"
        )
    return source, rest_name


def _fragment_findings(
    kind: str, names: tuple[str, str], moved: Sequence[float], kept: Sequence[float]
) -> Iterator[Finding]:
    """Findings about the fragments of the first of two segments, by their volumes in mm³."""
    if moved:
        yield Finding(
            "osteotomy-parts",
            f"fragments that the cut separated from {names[0]!r}: {len(moved)}, "
            f"{sum(moved):.0f} mm³ in all; they stay with {names[1]!r}",
            severity="note",
            where=kind,
            why="they would move with a bone to which they are not connected",
            fix="move the planes",
        )
    if kept:
        yield Finding(
            "osteotomy-parts",
            f"{names[0]!r} has {len(kept) + 1} disconnected parts; the volumes of the smaller "
            f"ones are {', '.join(f'{volume:.0f}' for volume in kept)} mm³",
            severity="warning",
            where=kind,
        )


def _scaled(cut: Cut, grid: ImageData, limit: float) -> Levels:
    """The depth in the region, clipped as a level is, and linear in every cell it crosses."""
    # Levels are clipped at `limit`. A plane clipped at less than a cell's diagonal would be bent
    # inside the cells that it cuts, and its zero would shift: so the diagonal becomes the limit.
    diagonal = float(np.linalg.norm(grid.spacing))
    parts = [[plane.distance_along(grid) for plane in group] for group in cut.groups]
    # A sum of three parts, each of one axis, has its least and its most in a block where they have:
    # most blocks lie on one side of all planes, and need no distance of their voxels.
    starts = [np.arange(0, n, BLOCK) for n in grid.values.shape]
    least, most = (
        _greatest_depth(
            [
                [end.reduceat(line, starts[a], axis=a) for a, line in enumerate(lines)]
                for lines in group
            ]
            for group in parts
        )
        for end in (np.minimum, np.maximum)
    )
    scaled: Levels = np.copysign(limit, least).astype(np.float32)
    for axis, n in enumerate(grid.values.shape):
        scaled = scaled.repeat(BLOCK, axis=axis).take(np.arange(n), axis=axis)
    for corner in BLOCK * np.argwhere((least < diagonal) & (most > -diagonal)):
        block = tuple(slice(start, start + BLOCK) for start in corner)
        depth = _greatest_depth(
            [[line[_own(block, a)] for a, line in enumerate(lines)] for lines in group]
            for group in parts
        )
        scaled[block] = np.clip(depth * (limit / diagonal), -limit, limit)
    return scaled


def _greatest_depth(groups: Iterable[Iterable[Sequence[Floats]]]) -> Floats:
    """The depth in the union of groups of planes, by the parts of each distance."""
    depth: Floats = np.maximum.reduce(
        [np.minimum.reduce([x + y + z for x, y, z in group]) for group in groups]
    )
    return depth


def _own(block: tuple[slice, ...], axis: int) -> tuple[slice, ...]:
    """The part of a block that a line along one axis has."""
    return tuple(part if a == axis else slice(None) for a, part in enumerate(block))


def _join_crumbs(
    piece: Levels, rest: Levels, bone: Levels, bound: float, most: int
) -> tuple[list[int], list[int]]:
    """Transfers small parts of a piece to the rest, in place; returns voxels transferred and left.

    `bound` is the value at which levels are clipped, `most` the voxels of a small part. Only parts
    connected to the rest are transferred: what was disconnected before the cut stays.
    """
    ndimage = third_party("scipy.ndimage", "bones are cut", "imaging")
    block = np.ones((3, 3, 3), dtype=np.int8)
    labels, sizes = _core.label_image(piece > 0.0, corners=True)
    if len(sizes) < 3:
        return [], []
    largest = int(np.argmax(sizes))
    moved, kept = [], []
    boxes = ndimage.find_objects(labels)
    for label in range(1, len(sizes)):
        if label == largest:
            continue
        around = tuple(
            slice(max(s.start - CRUMB_RIM - 1, 0), s.stop + CRUMB_RIM + 1)
            for s in cast("tuple[slice, slice, slice]", boxes[label - 1])
        )
        crumb = labels[around] == label
        others = (labels[around] > 0) & ~crumb
        rim = ndimage.binary_dilation(crumb, block, CRUMB_RIM) & ~ndimage.binary_dilation(
            others, block
        )
        rim |= crumb
        # Two steps: a plane through voxel centres leaves a layer on neither side.
        touching = ndimage.binary_dilation(crumb, block, CRUMB_RIM) & (rest[around] > 0.0)
        if not touching.any():
            continue
        if sizes[label] > most:
            kept.append(int(sizes[label]))
            continue
        moved.append(int(sizes[label]))
        rest[around] = np.where(rim, bone[around], rest[around])
        outside = -np.abs(bone[around]).clip(min=np.float32(bound * 1e-3))
        piece[around] = np.where(rim, np.minimum(piece[around], outside), piece[around])
    return moved, kept


def part_segment(
    segment: BoneSegment, pieces: Mapping[str, SurfaceData]
) -> tuple[BoneSegment, ...]:
    """The pieces of a segment: each has the bone that lies nearest to its surface.

    pieces: Parts of the segment's own surface by name, the largest first; they need not be closed.
    Returns: Those of 100 mm³ or more; `CaseError` where none holds as much.
    """
    level = segment.level
    values = level.single
    limit = max(float(values.max()), -float(values.min()))
    surfaces = [Surface(s.vertices, s.triangles) for s in pieces.values()]
    low = np.min([s.vertices.min(axis=0) for s in surfaces[1:]] or [level.highest], axis=0)
    high = np.max([s.vertices.max(axis=0) for s in surfaces[1:]] or [level.lowest], axis=0)
    spacing = level.spacing
    index = np.argwhere(values > -limit)
    points = level.lowest + index * spacing
    beside = ((points >= low - BESIDE) & (points <= high + BESIDE)).all(axis=1)
    index, points = index[beside], points[beside]
    away = np.array([distances(points, surface) for surface in surfaces])
    # Scaled as a cut by planes is: linear in the cells that it crosses.
    steep = limit / float(np.linalg.norm(spacing))
    voxel = float(np.prod(spacing))
    parted: dict[str, ImageData] = {}
    place = tuple(index.T)
    for number, name in enumerate(pieces):
        others = np.delete(away, number, axis=0)
        nearest = others.min(axis=0) if len(others) else np.full(len(points), np.inf)
        depth = np.clip(0.5 * (nearest - away[number]) * steep, -limit, limit)
        region = np.full(values.shape, np.float32(-limit if number else limit))
        region[place] = depth
        piece = np.minimum(values, region)
        if np.count_nonzero(piece > 0.0) * voxel >= LEAST_VOLUME:
            parted[name] = level.with_values(piece)
    if not parted:
        raise CaseInputError(
            f"none of the {len(pieces)} moved pieces lies in bone {segment.name!r}: give the "
            "surfaces of this bone before and after, both in the frame and unit of the case"
        )
    return _checked_segments(parted)
