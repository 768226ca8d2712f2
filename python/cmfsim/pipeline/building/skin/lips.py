"""The lips of a case: the seam between them, the mesh separated there, what they may not enter."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cmfsim._core import Surface, TetMesh
from cmfsim.errors import MeshError, MeshInputError
from cmfsim.io import Case, read_surface
from cmfsim.meshing import separated_mesh
from cmfsim.meshing.lips import LipSeam, lip_regions, lip_seam
from cmfsim.meshing.node_kinds import DentalArches
from cmfsim.pipeline.building.tissue.contacts import CaseContacts
from cmfsim.surfaces.levels import contact_surface
from cmfsim.surfaces.topology import connected_labels, edges_of, tet_bodies
from cmfsim.values.anatomy import Anatomy, BoneSegment
from cmfsim.values.checks import Floats, Indices
from cmfsim.values.finding import Finding
from cmfsim.values.node_kinds import NODE_KINDS, NodeKinds
from cmfsim.values.surface_data import SurfaceData, used_nodes
from cmfsim.values.touching import LipRegion, ObstacleData, TouchingData

# Held nodes that a body needs: three hold it unless they are in line.
LEAST_HELD = 3
# What is left out below this volume nobody will miss, mm³.
SPECKS = 100.0


def held_part(mesh: TetMesh, kinds: NodeKinds) -> tuple[TetMesh, NodeKinds, tuple[Finding, ...]]:
    """The mesh without bodies that neither bone nor plane holds, and a finding for them.

    A body hangs together by the faces of its tets: what an edge or a node joins to the rest swings
    about it.

    Raises `MeshError`: Nothing of it is held.
    """
    tets = mesh.tets
    body = tet_bodies(tets)
    n_bodies = int(body.max(initial=-1)) + 1
    holds = np.isin(kinds.kind, (1, 2))
    corner = holds[tets]
    # Each held node once for each body that it is in.
    held = np.unique(np.repeat(body, 4)[corner.ravel()] * mesh.n_nodes + tets[corner])
    loose = np.bincount(held // mesh.n_nodes, minlength=n_bodies) < LEAST_HELD
    if not loose.any():
        return mesh, kinds, ()
    if loose.all():
        raise MeshInputError(
            "the tissue is not attached anywhere: no node is on the posterior plane or on a "
            "bone; check that bones and skin are in one frame, and check the posterior plane"
        )
    dropped = loose[body]
    used, left = used_nodes(tets[~dropped])
    kept = TetMesh(mesh.nodes[used], left)
    volume = float(mesh.volumes[dropped].sum())
    place = mesh.nodes[tets[dropped]].reshape(-1, 3).mean(axis=0)
    speck = volume < SPECKS
    finding = Finding(
        "tissue-not-held",
        f"{int(loose.sum())} bodies of tissue of {volume:.3g} mm³ in total touch no bone "
        "and were removed",
        severity="note" if speck else "warning",
        where=f"mesh, about ({place[0]:.0f}, {place[1]:.0f}, {place[2]:.0f}) mm",
        fix="nothing to do: they are specks outside the face"
        if speck
        else "check skin and bone nearby; a larger bone threshold or closing may have cut them off",
    )
    return kept, kinds.of_nodes(used), (finding,)


# Nodes of a lip further than this from the other lip, or from the teeth, do not come to them, mm.
REACH = 8.0
# Where a sheet goes on past the edges of the teeth it lies further from them than this, mm: a wall
# for the lip of its own jaw, which it supports, and none for the other lip.
ON_TEETH = 3.0


@dataclass(frozen=True, eq=False)
class CaseLipContact:
    """The lips of a case, and what they may not enter.

    regions: "upper" and "lower"; none where the lips are not separated.
    kinds: Of all nodes, those that may lift off the teeth free.
    """

    regions: Mapping[str, LipRegion]
    kinds: NodeKinds
    touching: tuple[TouchingData, ...] = ()
    obstacles: tuple[ObstacleData, ...] = ()


def find_seam(
    case: Case, anatomy: Anatomy, arches: DentalArches | None, skin: Mapping[str, ArrayLike]
) -> LipSeam:
    """The seam of a case that asks for contact of the lips."""
    seam = case.lips.seam
    file = seam if isinstance(seam, Path) else case.mesh.parting
    if file is not None:
        units: str = "mm"
        frame: str | None = None
        if case.surfaces is not None:
            units, frame = case.surfaces.units, case.surfaces.frame
        surface = read_surface(file, units=units, frame=frame)
        return LipSeam(_upwards(surface), "file", {"source": "file", "file": file.name})
    by_jaw = {} if arches is None else arches.by_jaw
    return lip_seam(anatomy, by_jaw, skin, way=str(seam), depth=case.lips.depth)


def _upwards(surface: SurfaceData) -> SurfaceData:
    """The surface, turned if its normals look down."""
    vertices, triangles = surface.vertices, surface.triangles
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    if float(np.cross(b - a, c - a)[:, 2].sum()) >= 0.0:
        return surface
    return replace(surface, triangles=triangles[:, ::-1])


def separated_at_seam(
    mesh: TetMesh, kinds: NodeKinds, seam: LipSeam
) -> tuple[TetMesh, NodeKinds, tuple[Finding, ...]]:
    """The mesh separated at the seam; new nodes have the kinds of those that they lie between.

    Kinds are found before: the faces of the lips along the edges of teeth look at these without
    being attached to them.

    Raises `MeshError`: A surface given as a file runs through no tissue.
    """
    if seam.surface is None:
        return mesh, kinds, ()
    try:
        separated = separated_mesh(mesh, seam.surface)
    except MeshError:
        if seam.source != "gap":
            raise
        finding = Finding("lips-apart", where="lips")
        return mesh, kinds, (finding,)
    return held_part(separated.mesh, _with_new_nodes(mesh, kinds, separated.parents))


def _with_new_nodes(mesh: TetMesh, kinds: NodeKinds, parents: Indices) -> NodeKinds:
    """The kinds of a mesh, and those of new nodes by the nodes that they lie between.

    A copy has the kind of its original. A node on an edge of the boundary has the kind of both its
    ends, or slides where one end does and the other is joined to the same bone; all others are
    free.
    """
    kind, segment = kinds.kind[parents], kinds.segment[parents]
    free, joined, sliding = (NODE_KINDS.index(k) for k in ("free", "joined", "sliding"))
    edges = edges_of(mesh.boundary_triangles().astype(np.int64)).ends
    key = np.array([mesh.n_nodes, 1])
    on_boundary = np.isin(np.sort(parents, axis=1) @ key, edges @ key)
    is_copy = parents[:, 0] == parents[:, 1]
    attached = np.isin(kind, [joined, sliding]).all(axis=1)
    alike = ((kind[:, 0] == kind[:, 1]) | attached) & (segment[:, 0] == segment[:, 1])
    kept = is_copy | (on_boundary & alike)
    new_kind = np.where(kept, kind.max(axis=1), free)
    new_segment = np.where(kept, segment[:, 0], -1)
    return NodeKinds(
        np.concatenate([kinds.kind, new_kind.astype(kinds.kind.dtype)]),
        np.concatenate([kinds.segment, new_segment.astype(kinds.segment.dtype)]),
        kinds.segments,
    )


def lip_contact(
    mesh: TetMesh,
    kinds: NodeKinds,
    seam: LipSeam,
    *,
    height: float,
    arches: DentalArches | None,
    walls: CaseContacts,
    segments: Sequence[BoneSegment],
) -> CaseLipContact:
    """The lips of a separated mesh, free to lift off the teeth, and what they may not enter.

    height: mm. How far from the seam the lips reach.
    walls: The sheets of the arches.
    segments: Those that the kinds were found with.
    """
    if seam.surface is None:
        return CaseLipContact({}, kinds)
    nodes = mesh.nodes
    by_jaw = {} if arches is None else arches.by_jaw
    regions = lip_regions(nodes, mesh.boundary_triangles(), kinds, seam.surface, height=height)
    touching = tuple(
        _touching(nodes, regions[one], regions[other])
        for one, other in (("lower", "upper"), ("upper", "lower"))
    )
    obstacles: list[ObstacleData] = []
    for jaw in by_jaw:
        obstacles += _obstacles(nodes, regions, jaw, arches=arches, walls=walls, segments=segments)
    return CaseLipContact(regions, _released(kinds, regions), touching, tuple(obstacles))


def _touching(nodes: Floats, lip: LipRegion, other: LipRegion) -> TouchingData:
    """The nodes of a lip that may come to the other one, and that one."""
    ids = lip.nodes
    away = _distances(nodes[ids], Surface(nodes, other.triangles))
    return TouchingData(ids[away <= REACH], other.triangles)


def _released(kinds: NodeKinds, regions: Mapping[str, LipRegion]) -> NodeKinds:
    """The kinds with the nodes free that may lift off."""
    kind, segment = np.array(kinds.kind), np.array(kinds.segment)
    for region in regions.values():
        for ids in region.released.values():
            kind[ids] = NODE_KINDS.index("free")
            segment[ids] = -1
    return NodeKinds(kind, segment, kinds.segments)


def _obstacles(
    nodes: Floats,
    regions: Mapping[str, LipRegion],
    jaw: str,
    *,
    arches: DentalArches | None,
    walls: CaseContacts,
    segments: Sequence[BoneSegment],
) -> list[ObstacleData]:
    """The teeth of a jaw before both lips: of each segment that bears them, its nearest nodes."""
    if arches is None:
        return []
    bearers = [segments[number] for number in sorted(arches.bearers[jaw])]
    bones = [s.surface.searched for s in bearers]
    found = []
    for lip, region in regions.items():
        ids = region.nodes
        if not len(ids):
            continue
        away = np.array([_distances(nodes[ids], bone) for bone in bones])
        nearest = np.argmin(away, axis=0)
        for number, segment in enumerate(bearers):
            mine = ids[(nearest == number) & (away[number] <= REACH)]
            if not len(mine):
                continue
            whole = _sheet(segment, walls)
            surface = whole if lip == jaw else _on_teeth(whole, bones)
            if surface is not None:
                found.append(ObstacleData(mine, segment.name, surface))
    return found


def _sheet(segment: BoneSegment, walls: CaseContacts) -> SurfaceData:
    """The contact sheet of a segment, else the blurred bone."""
    if segment.name in walls.sheets:
        return walls.sheets[segment.name].surface
    return contact_surface(segment)


def _on_teeth(sheet: SurfaceData, bones: Sequence[Surface]) -> SurfaceData | None:
    """The part of a sheet that lies on bones and teeth, its largest piece; None if none does."""
    vertices, triangles = sheet.vertices, sheet.triangles
    away = np.min([_distances(vertices, bone) for bone in bones], axis=0)
    kept = triangles[(away[triangles] <= ON_TEETH).all(axis=1)]
    if not len(kept):
        return None
    label = connected_labels(edges_of(kept.astype(np.int64)).pairs, len(kept))
    kept = kept[label == np.argmax(np.bincount(label))]
    used, corners = used_nodes(kept)
    return SurfaceData(vertices[used], corners, sheet.crease_angle)


def _distances(points: Floats, surface: Surface) -> Floats:
    closest, _, _ = surface.closest(points)
    distances: Floats = np.linalg.norm(closest - points, axis=1)
    return distances


def lip_summary(seam: LipSeam, lips: CaseLipContact) -> dict[str, Any]:
    """What build.json states of the lips."""
    counts = {
        name: {
            "nodes": len(region.nodes),
            "triangles": len(region.triangles),
            "released": {segment: len(ids) for segment, ids in region.released.items()},
        }
        for name, region in lips.regions.items()
    }
    return {**seam.summary, **counts}
