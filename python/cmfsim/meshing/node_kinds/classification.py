"""Classification of the nodes of a mesh: fixed, joined, sliding or free.

A node lies on a bone if it is near the bone's surface *and* its part of the boundary faces that
surface: where skin is thinner than a tet is long, nearness alone would take skin for interface.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim._core import Surface
from cmfsim.errors import CaseInputError
from cmfsim.meshing.node_kinds.arches import DentalArches, dental_arches, sliding_nodes
from cmfsim.meshing.node_kinds.options import BORDERS, KindOptions
from cmfsim.values.anatomy import Anatomy, BoneSegment
from cmfsim.values.checks import (
    Floats,
    Indices,
    as_index_rows,
    as_point,
    as_rows,
    check_instance,
    keep,
)
from cmfsim.values.finding import Finding
from cmfsim.values.scene import NODE_KINDS, NodeKinds, SegmentData
from cmfsim.values.surface_data import SurfaceData, used_nodes

FREE, FIXED, JOINED, SLIDING = range(4)
# A body is held if at least this many of its nodes, not on one line, are prescribed.
HOLDING_NODES = 3


@dataclass(frozen=True, eq=False)
class ClassifiedNodes:
    """The kinds of all nodes, with counts and findings.

    Attributes
    ----------
    kinds : NodeKinds
    counts : mapping of str to int
        "free", "fixed", "joined", "sliding"; "joined on NAME", "sliding on NAME"; "fixed on
        planes", "fixed on bone"; "contested": nodes within reach of two segments, given to the
        nearer; "overruled": nodes on a fixed plane that a bone would have had otherwise.
    findings : tuple of Finding
    """

    kinds: NodeKinds
    counts: Mapping[str, int] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()

    def __post_init__(self) -> None:
        keep(self, counts=self.counts)


def classify_nodes(  # noqa: PLR0913 (options by name)
    nodes: ArrayLike,
    boundary_triangles: ArrayLike,
    anatomy: Anatomy,
    segments: Sequence[BoneSegment],
    *,
    moved: Collection[str],
    landmarks: Mapping[str, ArrayLike] | None = None,
    fixed_planes: Mapping[str, tuple[ArrayLike, ArrayLike]] | None = None,
    options: KindOptions | None = None,
    arches: DentalArches | None = None,
    contacts: Mapping[str, SurfaceData] | None = None,
) -> ClassifiedNodes:
    """The kind of every node of a tissue mesh, and the segment of the nodes attached to bone.

    A node on a fixing plane is fixed. Of the others, those on a bone (the nearest one counts) slide
    if they are in its sliding region; otherwise they are joined if the bone moves, and fixed if it
    does not. All others are free. Nodes also slide on bones that do not move; the contact surface
    of these bones does not move either.

    Parameters
    ----------
    nodes : (n, 3) float64, mm
        LPS.
    boundary_triangles : (t, 3) uint32
        Boundary of the mesh, outward.
    anatomy : Anatomy
        Its teeth, if known, bound the sliding region; its grid defines the borders.
    segments : sequence of BoneSegment
    moved : collection of str
        Names of the segments that the plan moves.
    landmarks : mapping of str to (3,) float64, mm, optional
        Skull landmarks, LPS; `supradentale`, `infradentale`, `supra_m2_L/R` and `sub_m2_L/R` place
        the sliding regions; without them, the teeth in the anatomy do.
    fixed_planes : mapping of str to (point, normal), optional
        Planes that cut the tissue (posterior, neck), by name: each a point (3,) mm and a normal.
    options : KindOptions, optional
    arches : DentalArches, optional
        The result of `dental_arches`, if it is already known.
    contacts : mapping of str to SurfaceData, optional
        Contact sheets (`contact_sheet`) by segment: at the arches, only nodes on them slide. Those
        deeper behind them, on the palate or where teeth bite, are joined or fixed as other nodes
        on the bone are.

    Raises
    ------
    CaseError
        (also `ValueError`) Misshapen arrays, no segment, two of one name, an unknown name in
        `moved` or in a region.

    Examples
    --------
    >>> import cmfsim
    >>> found = cmfsim.classify_nodes(
    ...     mesh.nodes, mesh.boundary_triangles(), anatomy, segments, moved=["maxilla"]
    ... )  # doctest: +SKIP
    >>> found.counts["joined on maxilla"]  # doctest: +SKIP
    1204
    """
    options = options or KindOptions()
    points = as_rows("nodes", nodes, 3)
    triangles = as_index_rows("boundary triangles", boundary_triangles, 3, len(points), "nodes")
    check_instance("anatomy", anatomy, Anatomy)
    names = _checked_names(segments, moved, options)
    if not len(triangles):
        raise CaseInputError("the mesh has no boundary triangles")
    border = _Boundary(points, triangles)
    surfaces = [s.surface.searched for s in segments]
    nearest, near = _on_bones(border, surfaces, options)
    on_bone = nearest >= 0
    on_plane = _on_planes(border, anatomy, fixed_planes or {}, options)
    slides = np.zeros(len(border.points), dtype=bool)
    findings: tuple[Finding, ...] = ()
    if options.sliding:
        if arches is None:
            arches = dental_arches(anatomy, segments, landmarks)
        slides, noticed = sliding_nodes(
            border.points,
            nearest,
            anatomy,
            segments,
            arches=arches,
            contacts=contacts or {},
            options=options,
        )
        # Where every segment has regions of its own, no arch is asked for.
        asked = set(names) - {region.segment for region in options.regions}
        findings = (*(arches.findings if asked else ()), *noticed)
    moves = np.array([name in moved for name in names])
    carried = on_bone & moves[nearest]
    kind = np.zeros(len(points), dtype=np.uint8)
    owner = np.full(len(points), -1, dtype=np.int16)
    part = np.where(on_bone, np.where(carried, JOINED, FIXED), FREE)
    part[slides] = SLIDING
    part[on_plane] = FIXED
    kind[border.ids] = part
    lies = on_bone & ~on_plane
    owner[border.ids[lies]] = nearest[lies]
    kinds = NodeKinds(kind, owner, names)
    counts = _counts(kinds, fixed_on_planes=int(on_plane.sum()))
    counts["contested"] = int((near > 1).sum())
    counts["overruled"] = int((on_plane & (carried | slides)).sum())
    return ClassifiedNodes(kinds, counts, (*findings, *_noticed(points, kinds, counts, moved)))


def _counts(kinds: NodeKinds, *, fixed_on_planes: int) -> dict[str, int]:
    """Nodes of each kind, by segment where a bone holds them."""
    counts = {n: len(kinds.nodes(n)) for n in NODE_KINDS}
    for name in kinds.segments:
        counts |= {f"{k} on {name}": len(kinds.nodes(k, name)) for k in ("joined", "sliding")}
    counts["fixed on planes"] = fixed_on_planes
    counts["fixed on bone"] = counts["fixed"] - fixed_on_planes
    return counts


def segment_data(
    kinds: NodeKinds,
    segments: Sequence[BoneSegment],
    *,
    contacts: Mapping[str, SurfaceData] | None = None,
    gap: ArrayLike | str = "rest",
) -> dict[str, SegmentData]:
    """The segments of a scene: the nodes that each carries, and the surface that others slide on.

    Parameters
    ----------
    kinds : NodeKinds
    segments : sequence of BoneSegment
        The segments with which the kinds were determined.
    contacts : mapping of str to SurfaceData, optional
        Contact surfaces in place of the segments' own, by segment (see `contact_surface`).
    gap : float, mm, or "rest"
        As in `SegmentData`.

    Returns
    -------
    dict of str to SegmentData
        Only segments to which a node is joined or on which one slides; the plan of a scene names
        exactly these.

    Raises
    ------
    CaseError
        (also `ValueError`) A segment of the kinds is not among the segments.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.segment_data(found.kinds, segments)  # doctest: +SKIP
    """
    known = {segment.name: segment for segment in segments}
    for name in contacts or {}:
        if name not in known:
            raise CaseInputError(f"contact of {name!r}; segments are: {', '.join(known)}")
    data = {}
    for name in kinds.segments:
        if name not in known:
            raise CaseInputError(f"there is no segment {name!r}; segments: {', '.join(known)}")
        joined, sliding = kinds.nodes("joined", name), kinds.nodes("sliding", name)
        if len(joined) or len(sliding):
            own = (contacts or {}).get(name, known[name].surface)
            contact = own if len(sliding) else None
            data[name] = SegmentData(joined, sliding, contact, gap if len(sliding) else 0.0)
    return data


class _Boundary:
    """The nodes on the boundary of a mesh, with the length of their edges and their triangles."""

    def __init__(self, points: Floats, triangles: Indices) -> None:
        self.ids, self.triangles = used_nodes(triangles)
        self.points: Floats = points[self.ids]
        n = len(self.ids)
        corners = self.points[self.triangles]
        total, count = np.zeros(n), np.zeros(n)
        for a, b in ((0, 1), (1, 2), (2, 0)):
            length = np.linalg.norm(corners[:, a] - corners[:, b], axis=1)
            for end in (a, b):
                total += np.bincount(self.triangles[:, end], length, n)
                count += np.bincount(self.triangles[:, end], minlength=n)
        self.edge_length: Floats = total / count
        # Twice the area of each triangle along its outward normal.
        self.area: Floats = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])

    def share_facing(self, normals: Floats) -> Floats:
        """The part of each node's area that looks against a normal given for that node."""
        n = len(self.ids)
        size = np.linalg.norm(self.area, axis=1)
        facing, total = np.zeros(n), np.zeros(n)
        for corner in range(3):
            node = self.triangles[:, corner]
            against = -np.einsum("ta,ta->t", self.area, normals[node])
            facing += np.bincount(node, np.maximum(against, 0.0), n)
            total += np.bincount(node, size, n)
        share: Floats = facing / np.maximum(total, np.finfo(float).tiny)
        return share


def _checked_names(
    segments: Sequence[BoneSegment], moved: Collection[str], options: KindOptions
) -> tuple[str, ...]:
    if not segments:
        raise CaseInputError(
            "there is no bone segment, so the tissue would not be attached to anything"
        )
    for segment in segments:
        check_instance("segment", segment, BoneSegment)
    names = tuple(segment.name for segment in segments)
    known = ", ".join(repr(n) for n in names)
    if len(set(names)) < len(names):
        raise CaseInputError(f"two segments have one name; segments are: {known}")
    if isinstance(moved, str):
        raise CaseInputError(f"moved is the text {moved!r}: a list of segment names is needed")
    for name in moved:
        if name not in names:
            raise CaseInputError(f"the plan moves {name!r}; segments are: {known}")
    for region in options.regions:
        if region.segment not in names:
            raise CaseInputError(f"region on {region.segment!r}; segments are: {known}")
    return names


def _on_bones(
    border: _Boundary, surfaces: Sequence[Surface], options: KindOptions
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The nearest segment that each boundary node lies on, or −1; how many are within reach."""
    n = len(border.ids)
    reach = options.bone_distance * border.edge_length
    least = np.full(n, np.inf)
    nearest = np.full(n, -1, dtype=np.intp)
    within = np.zeros(n, dtype=np.intp)
    for number, surface in enumerate(surfaces):
        low = surface.vertices.min(axis=0) - reach.max()
        high = surface.vertices.max(axis=0) + reach.max()
        ids = np.flatnonzero(((border.points >= low) & (border.points <= high)).all(axis=1))
        if not len(ids):
            continue
        closest, normals, _ = surface.closest(border.points[ids])
        distance = np.full(n, np.inf)
        distance[ids] = np.linalg.norm(closest - border.points[ids], axis=1)
        outward = np.zeros((n, 3))
        outward[ids] = normals
        on = (distance <= reach) & (border.share_facing(outward) >= options.facing)
        within += on
        nearer = on & (distance < least)
        nearest[nearer] = number
        least[nearer] = distance[nearer]
    return nearest, within


def _on_planes(
    border: _Boundary,
    anatomy: Anatomy,
    planes: Mapping[str, tuple[ArrayLike, ArrayLike]],
    options: KindOptions,
) -> NDArray[np.bool_]:
    """Which boundary nodes lie on a plane that fixes, or on a border of the image that does."""
    reach = options.plane_distance * border.edge_length
    found = np.zeros(len(border.ids), dtype=bool)
    for name, (point, normal) in planes.items():
        at = as_point(f"point of fixed plane {name!r}", point)
        along = as_point(f"normal of fixed plane {name!r}", normal)
        length = float(np.linalg.norm(along))
        if length == 0.0:
            raise CaseInputError(f"normal of fixed plane {name!r} is (0, 0, 0)")
        found |= np.abs((border.points - at) @ (along / length)) <= reach
    low, high = anatomy.skin.lowest, anatomy.skin.highest
    for name in options.fixed_borders:
        # +x is left, +y posterior, +z superior.
        axis = BORDERS.index(name) // 2
        at_end = name in {"left", "posterior", "superior"}
        end = high[axis] if at_end else low[axis]
        # A level that is cut by the border ends half a voxel to one voxel inside it.
        slack = float(anatomy.skin.spacing[axis])
        found |= np.abs(border.points[:, axis] - end) <= reach + slack
    return found


def _noticed(
    points: Floats, kinds: NodeKinds, counts: Mapping[str, int], moved: Collection[str]
) -> list[Finding]:
    findings = [
        Finding(
            "segment-no-tissue",
            f"no node is joined to {name!r}, which the plan moves "
            f"({counts[f'sliding on {name}']} slide on it)",
            severity="warning",
            where=name,
            fix="check the picture; increase bone_distance, or remove the segment from the plan",
        )
        for name in kinds.segments
        if name in moved and not counts[f"joined on {name}"]
    ]
    held = points[np.concatenate([kinds.nodes("fixed"), kinds.nodes("joined")])]
    spread = np.linalg.svd(held - held.mean(axis=0), compute_uv=False) if len(held) else [0.0, 0.0]
    if len(held) < HOLDING_NODES or spread[1] <= 1e-6 * spread[0]:
        findings.append(
            Finding(
                "tissue-not-held",
                f"{len(held)} nodes are fixed or joined: at least {HOLDING_NODES} not on one line "
                "are needed",
                severity="error",
                where="node kinds",
                why="the tissue could drift as a whole, so there is no unique solution",
                fix="give fixed_planes (posterior), or increase bone_distance",
            )
        )
    return findings
