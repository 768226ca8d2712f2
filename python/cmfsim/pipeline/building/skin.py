"""The skin of a case: its part of the mesh's boundary, its face, its 3D photo, and its lips.

The lips are separated along the seam between them; the part also states what they may not enter.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim._core import Surface, TetMesh, rigid_fit
from cmfsim.errors import CaseInputError, MeshError, MeshInputError, RegistrationError
from cmfsim.io import Case, read_landmark_file, read_surface
from cmfsim.io.meshes.photos import read_photo
from cmfsim.meshing.lips.seam import LipSeam, lip_regions, lip_seam
from cmfsim.meshing.lips.sheet import facing
from cmfsim.meshing.node_kinds.arches import DentalArches
from cmfsim.meshing.stuffing import separated_mesh
from cmfsim.pipeline.building.case_checks import CaseLipContact, Head
from cmfsim.pipeline.building.inputs import stated_frame
from cmfsim.pipeline.building.tissue.contacts import CaseContacts, without_tets
from cmfsim.surfaces.depth import barycentric, distances
from cmfsim.surfaces.levels import SurfaceOptions, surface_of_level
from cmfsim.surfaces.topology import Integers, connected_labels, edges_of, tet_bodies
from cmfsim.values.anatomy import Anatomy, BoneSegment
from cmfsim.values.case_parts import UNITS
from cmfsim.values.checks import Floats, Indices
from cmfsim.values.finding import Finding
from cmfsim.values.image_data import ImageData
from cmfsim.values.motion import carried
from cmfsim.values.patient_model import LiftedTissue
from cmfsim.values.scene import NODE_KINDS, NodeKinds
from cmfsim.values.surface_data import SurfaceData, triangle_areas, used_nodes
from cmfsim.values.touching import LipRegion, ObstacleData, TouchingData

# Held nodes that a body needs: three hold it unless they are in line.
LEAST_HELD = 3
# What is left out below this volume nobody will miss, mm³.
SPECKS = 100.0


# A mesh, the kinds of its nodes, the body of each tet, and findings.
Held = tuple[TetMesh, NodeKinds, Integers, tuple[Finding, ...]]


def held_part(mesh: TetMesh, kinds: NodeKinds) -> Held:
    """The mesh without bodies that neither bone nor plane holds, and a finding for them.

    A body is connected by faces of tets: what an edge or a node joins to it can turn about that.
    Raises `MeshError`: Nothing of it is held.
    """
    tets = mesh.tets
    body = tet_bodies(tets)
    loose = _are_loose(body, tets, np.isin(kinds.kind, (1, 2)))
    if not loose.any():
        return mesh, kinds, body, ()
    if loose.all():
        raise MeshInputError(
            "the tissue is not attached anywhere: no node is on the posterior plane or on a "
            "bone; check that bones and skin are in one frame, and check the posterior plane"
        )
    dropped = loose[body]
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
    return *without_tets(mesh, kinds, dropped), body[~dropped], (finding,)


def _are_loose(body: Integers, tets: Indices, holds: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which bodies of tets too few of the nodes hold that `holds` marks."""
    corner = holds[tets]
    # Each held node once for each body that it is in.
    held = np.unique(np.repeat(body, 4)[corner.ravel()] * len(holds) + tets[corner])
    counts = np.bincount(held // len(holds), minlength=int(body.max(initial=-1)) + 1)
    loose: NDArray[np.bool_] = counts < LEAST_HELD
    return loose


def lifted_where_held(
    mesh: TetMesh, kinds: NodeKinds, body: Integers, lifted: LiftedTissue
) -> LiftedTissue:
    """The lifted nodes without those of bodies that too little else holds: these would drift."""
    holds = np.isin(kinds.kind, (1, 2))
    holds[lifted.nodes] = False
    loose = _are_loose(body, mesh.tets, holds)
    return lifted.without(np.unique(mesh.tets[loose[body]]))


# Nodes of a lip further than this from the other lip, or from the teeth, do not come to them, mm.
REACH = 8.0
# Where a sheet goes on past the edges of the teeth it lies further from them than this, mm: a wall
# for the lip of its own jaw, which it supports, and none for the other lip.
ON_TEETH = 3.0


def find_seam(
    case: Case, anatomy: Anatomy, arches: DentalArches | None, skin: Mapping[str, ArrayLike]
) -> LipSeam:
    """The seam of a case that asks for contact of the lips."""
    seam = case.lips.seam
    if isinstance(seam, Path):
        surface = read_surface(seam, **stated_frame(case))
        upwards = facing(surface.vertices, surface.triangles, np.array([0.0, 0.0, 1.0]))
        surface = replace(surface, triangles=upwards)
        return LipSeam(surface, "file", {"source": "file", "file": seam.name})
    by_jaw = {} if arches is None else arches.by_jaw
    return lip_seam(anatomy, by_jaw, skin, way=seam, depth=case.lips.depth)


def separated_at_seam(mesh: TetMesh, kinds: NodeKinds, body: Integers, seam: LipSeam) -> Held:
    """The mesh separated at the seam; new nodes have the kinds of those that they lie between.

    Kinds are found before: the faces of the lips along the edges of teeth look at these without
    being attached to them. Raises `MeshError`: A surface of a file runs through no tissue.
    """
    if seam.surface is None:
        return mesh, kinds, body, ()
    try:
        separated = separated_mesh(mesh, seam.surface)
    except MeshError:
        if seam.source != "gap":
            raise
        finding = Finding("lips-apart", where="lips")
        return mesh, kinds, body, (finding,)
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
    away = distances(nodes[ids], Surface(nodes, other.triangles))
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
        away = np.array([distances(nodes[ids], bone) for bone in bones])
        nearest = np.argmin(away, axis=0)
        for number, segment in enumerate(bearers):
            mine = ids[(nearest == number) & (away[number] <= REACH)]
            if not len(mine):
                continue
            whole = walls.of(segment)
            surface = whole if lip == jaw else _on_teeth(whole, bones)
            if surface is not None:
                found.append(ObstacleData(mine, segment.name, surface))
    return found


def _on_teeth(sheet: SurfaceData, bones: Sequence[Surface]) -> SurfaceData | None:
    """The part of a sheet that lies on bones and teeth, its largest piece; None if none does."""
    vertices, triangles = sheet.vertices, sheet.triangles
    away = np.min([distances(vertices, bone) for bone in bones], axis=0)
    kept = triangles[(away[triangles] <= ON_TEETH).all(axis=1)]
    if not len(kept):
        return None
    label = connected_labels(edges_of(kept.astype(np.int64)).pairs, len(kept))
    kept = kept[label == np.argmax(np.bincount(label))]
    used, corners = used_nodes(kept)
    return SurfaceData(vertices[used], corners, sheet.crease_angle)


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


# Skin farther from the photo than this, mm, has no colour of it, but this grey.
REACH, GREY = 5.0, 170
# A photo whose vertices are farther than this from the skin, mm, half of them, is not on it.
MOST_AWAY = 2.5
# From here on, mm, it may be another person's: two scans of one face leave less than 1 mm.
DOUBTFUL = 1.2
# Share of a photo that has no part in its registration (hair, neck, lips), and of its vertices as
# many as decide it.
TRIM, VERTICES, STEPS = 0.3, 4000, 300
# Landmarks that determine a rigid motion, and how far the worst may lie from its partner, mm.
LANDMARKS, MOST_OFF = 3, 15.0
# Triangles of the skin of an image, which has the colours at its vertices.
TRIANGLES = 120_000


def with_photo(head: Head) -> tuple[SurfaceData, NDArray[np.uint8], Finding]:
    """The skin of a head in full detail, the colours of its vertices, and how they came there.

    Raises `CaseError`: A photo or landmarks of it that do not do, or do not lie on the skin.
    """
    given, where = head.case.photo, head.case.where("photo")
    if given is None:  # called for cases with a photo
        raise AssertionError(head.case.name)
    skin = head.anatomy.surfaces.get("skin") or surface_of_level(
        "skin", head.anatomy.skin, SurfaceOptions(max_triangles=TRIANGLES)
    )
    photo = read_photo(given.file)
    scale = UNITS[given.units]
    matrix = np.eye(4)
    if given.landmarks is not None:
        found = read_landmark_file(given.landmarks).points
        points = {name: scale * np.asarray(point) for name, point in found.items()}
        ours = head.landmarks.get("skin", {})
        matrix = _registered(scale * photo.vertices, points, ours, skin, where)
    vertices = carried(matrix, scale * photo.vertices)
    away = float(np.median(distances(vertices, skin.searched)))
    if away > MOST_AWAY:
        raise CaseInputError(
            f"{where}: half of the 3D photo lies {away:.1f} mm from the skin or more (at most "
            f"{MOST_AWAY:g} mm): check that it is this patient's, its units, and "
            + ("its landmarks" if given.landmarks else "its frame, or give landmarks")
        )
    surface = Surface(vertices, photo.triangles)
    nearest, _, triangles = surface.closest(skin.vertices)
    near = np.linalg.norm(nearest - skin.vertices, axis=1) <= REACH
    shares = barycentric(vertices[photo.triangles[triangles[near]]], nearest[near])
    colours = np.full((len(near), 3), GREY, dtype=np.uint8)
    corners = photo.colours[photo.triangles[triangles[near]]].astype(np.float64)
    # A triangle without area has the colour of its middle.
    shares = np.nan_to_num(shares, nan=1.0 / 3.0)
    colours[near] = np.einsum("kc,kca->ka", shares, corners).round().clip(0, 255)
    what = (
        f"the 3D photo lies {away:.1f} mm from the skin (median); {near.mean():.0%} of the skin "
        "has its colours, the rest is grey"
    )
    severity = "warning" if away > DOUBTFUL else "note"
    return skin, colours, Finding("photo-placed", what, severity=severity, where=where)


def _registered(
    vertices: Floats,
    points: Mapping[str, Floats],
    ours: Mapping[str, Floats],
    skin: SurfaceData,
    where: str,
) -> Floats:
    """The motion of a photo to the skin: by landmarks, then by their surfaces."""
    names = [name for name in points if name in ours]
    if len(names) < LANDMARKS:
        raise CaseInputError(
            f"{where}: {len(names)} skin landmarks of the photo are known on the head "
            f"({', '.join(names) or 'none'}): {LANDMARKS} are needed, with names as "
            f"{', '.join(ours) or 'those of [landmarks] skin, which the case lacks'}"
        )
    there = np.array([points[name] for name in names])
    here = np.array([ours[name] for name in names])
    start = rigid_fit(there, here).matrix
    off = np.linalg.norm(carried(start, there) - here, axis=1)
    if off.max() > MOST_OFF:
        raise CaseInputError(
            f"{where}: landmark {names[int(off.argmax())]} of the photo stays {off.max():.0f} mm "
            f"from that of the head (at most {MOST_OFF:g} mm): check names, sides and units"
        )
    from cmfsim.registration import icp  # noqa: PLC0415

    some = vertices[:: max(1, len(vertices) // VERTICES)]
    try:
        return icp(some, skin, initial=start, trim=TRIM, max_iterations=STEPS).matrix
    except RegistrationError as error:
        raise CaseInputError(f"{where}: the 3D photo cannot be registered: {error}") from error


# Sites of the skull that skin covers whatever the lips do.
COVERED = ("nasion", "mid_philtrum", "pogonion", "suborbital_L", "suborbital_R")
# Skin alone is 1.5 mm thick: less of all tissue in front of bone is none, mm.
LEAST_TISSUE = 1.2
# The nose stands out by more than this from the line from rhinion to mid-philtrum, mm, where nasion
# and mid-philtrum are 59 mm apart as in an average head; 26 to 28 in two real heads.
LEAST_NOSE, NOSE_HEIGHT = 9.0, 59.0
# How far in front of bone skin is looked for, in steps, mm.
FARTHEST, STEP = 50.0, 0.5
# What a triangle's centroid may lie further from the skin than from the tissue's surface, mm.
SLACK = 0.25
# Smaller patches, mm², belong to what surrounds them: where tissue is hardly thicker than a tet, a
# triangle of the skin can lie nearer to the bone below.
LEAST_PATCH = 100.0


def check_skin(anatomy: Anatomy, skull: Mapping[str, Floats]) -> Iterator[Finding]:
    """Warnings where nose or tissue is missing in front of the skull."""
    front = _front(skull)
    if front is None:
        return
    bare = {
        name: depth
        for name in COVERED
        if name in skull and (depth := _tissue(anatomy, skull[name], front)) < LEAST_TISSUE
    }
    if bare:
        yield _missing(
            "tissue in front of bone is missing at "
            + ", ".join(f"{name} ({depth:.1f} mm)" for name, depth in bare.items())
        )
    if not {"rhinion", "mid_philtrum", "nasion"} <= skull.keys():
        return
    top, bottom = skull["rhinion"], skull["mid_philtrum"]
    size = float(np.linalg.norm(skull["nasion"] - bottom)) / NOSE_HEIGHT
    line = [top + share * (bottom - top) for share in np.linspace(0.2, 0.9, 8)]
    nose = max(_tissue(anatomy, point, front, last=True) for point in line)
    if nose < LEAST_NOSE * size:
        yield _missing(
            f"the skin has no nose: it stands out by {nose:.1f} mm between rhinion and upper lip "
            f"({LEAST_NOSE * size:.0f} mm at least are expected)"
        )


def _front(skull: Mapping[str, Floats]) -> Floats | None:
    """The direction in which the face looks, from pairs of sites and the midline."""
    pairs = [n[:-2] for n in skull if n.endswith("_L") and f"{n[:-2]}_R" in skull]
    if not pairs or not {"nasion", "supradentale"} <= skull.keys():
        return None
    left = np.sum([skull[f"{n}_L"] - skull[f"{n}_R"] for n in pairs], axis=0)
    front: Floats = np.cross(left, skull["nasion"] - skull["supradentale"])
    length = float(np.linalg.norm(front))
    return front / length if length > 0.0 else None


def _tissue(anatomy: Anatomy, point: Floats, front: Floats, *, last: bool = False) -> float:
    """How far the head reaches in front of a point, to the first or the last end of it, mm."""
    steps = np.arange(0.0, FARTHEST, STEP)
    inside = np.asarray(anatomy.skin.sample(point + steps[:, None] * front)) > 0.0
    if last:
        return float(steps[np.flatnonzero(inside)[-1]]) if inside.any() else 0.0
    return FARTHEST if inside.all() else float(steps[int(np.argmin(inside))])


def _missing(what: str) -> Finding:
    return Finding("skin-implausible", what, where="skin")


def on_skin(
    nodes: Floats, triangles: NDArray[np.uint32], anatomy: Anatomy, level: ImageData
) -> NDArray[np.bool_]:
    """Which boundary triangles are skin: their centroids lie nearer to it than to anything else.

    level: Of the tissue that was meshed.
    """
    centroids = nodes[triangles].mean(axis=1)
    others = [*anatomy.bones.values(), *([] if anatomy.air is None else [anatomy.air])]
    from_skin = np.abs(anatomy.skin.sample(centroids))
    near = np.ones(len(centroids), dtype=bool)
    for other in others:
        near &= from_skin < np.abs(other.sample(centroids))
    # On a plane that bounds the region, the level is zero well inside the skin.
    near &= from_skin <= np.abs(level.sample(centroids)) + SLACK
    return _without_specks(nodes, triangles, near)


def _without_specks(
    nodes: Floats, triangles: NDArray[np.uint32], chosen: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """The choice with its small patches, and the small gaps in it, turned over."""
    edges = edges_of(triangles.astype(np.int64))
    # Patches are connected by edges between triangles of one choice.
    alike = chosen[edges.pairs[:, 0]] == chosen[edges.pairs[:, 1]]
    patch = connected_labels(edges.pairs[alike], len(triangles))
    small = np.bincount(patch, weights=triangle_areas(nodes, triangles)) < LEAST_PATCH
    # A closed surface of its own, round a small cavity, is surrounded by nothing.
    bordered = np.zeros(len(small), dtype=bool)
    bordered[patch[edges.pairs[~alike]]] = True
    return chosen ^ (small & bordered)[patch]
