"""The soft tissue of a case as tets, the kind of each node, and ends near moving bone."""

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim._core import Surface, TetMesh, distance_image
from cmfsim.io import Case, read_tet_mesh
from cmfsim.meshing.levels import TissueRegion, near_skin
from cmfsim.meshing.lips.seam import LipSeam
from cmfsim.meshing.node_kinds.arches import DentalArches
from cmfsim.meshing.node_kinds.classification import classify_nodes
from cmfsim.meshing.node_kinds.options import KindOptions
from cmfsim.meshing.node_kinds.septum import lifted_tissue, septum
from cmfsim.meshing.stuffing import (
    MeshOptions,
    mesh_findings,
    mesh_from_level,
    mesh_report,
    report_of_part,
)
from cmfsim.pipeline.building.case_checks import (
    CaseLipContact,
    Head,
    Nodes,
    Tissue,
    cut_segments,
    untouched,
)
from cmfsim.pipeline.building.skin import (
    held_part,
    lifted_where_held,
    lip_contact,
    separated_at_seam,
)
from cmfsim.pipeline.building.stages import Stages
from cmfsim.pipeline.building.surgery.motions import PlannedBones
from cmfsim.pipeline.building.tissue.contacts import (
    CaseContacts,
    arch_sheets,
    without_clefts,
    without_crushed,
)
from cmfsim.surfaces.depth import distances
from cmfsim.surfaces.levels import block_of
from cmfsim.surfaces.topology import Integers
from cmfsim.values.anatomy import Anatomy, BoneSegment
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding
from cmfsim.values.image_data import ImageData
from cmfsim.values.mesh_report import MeshReport
from cmfsim.values.scene import NodeKinds
from cmfsim.values.skin_motion import mean_edge
from cmfsim.values.surface_data import MovedSurface

Counts = NDArray[np.uint8]

# Depth below the skin to which thin tissue is refined, mm: lips, nose and lids, not the walls of
# the nasal cavity.
THIN_DEPTH = 12.0
# Halvings of the edge at gaps between skin and skin: lips a millimetre apart stay two.
GAP_REFINEMENTS = 2
# The mouth is where the distances from the upper jaw and from the mandible come to less, mm: the
# lips over the crowns of the teeth. What the jaws' motions differ by is sheared over this width.
MOUTH_WIDTH = 24.0
# How far below the skin it reaches, mm: lips and the muscle in them, not the tongue.
MOUTH_DEPTH = 15.0
# How far behind its foremost tissue, mm: the corners of the mouth and what is beside them. The arch
# of the cheekbone and the mandible's processes, as near to each other, lie farther back.
MOUTH_LENGTH = 35.0
# Tets from the skin of a lip to the teeth at least; and how far about the seam, mm.
TETS_IN_LIP = 3.0
SEAM_REACH = 4.0

# Bodies of tissue below this volume are specks between bones, mm³.
LEAST_BODY = 1000.0
# A head ends in a cut, not a crown, where its cross-section near the end is above this share of the
# largest, and above the other share of that twice as far in: under a crown they grow with depth.
CUT_SHARE = 0.15
CUT_GROWTH = 0.75
# How far from the end the cross-section is taken, mm, and in voxels at least: the very last layer
# may be the rim of a cap.
CUT_DEPTH = 5.0
CUT_LAYERS = 2
# Voxels between the end of a head that was cut and the plane that closes its tissue there: the
# image's own end is ragged where the neck is tilted or a cap was sewn in.
CUT_MARGIN = 1.5


def region_of(case: Case, anatomy: Anatomy, landmarks: Mapping[str, Floats]) -> TissueRegion:
    """The region of the case; where the head was cut off below or above, tissue ends on a plane."""
    inside = anatomy.skin.values > 0.0
    lowest, spacing = anatomy.skin.lowest, anatomy.skin.spacing
    rows = np.flatnonzero(inside.any(axis=(0, 2)))
    foremost, hindmost = (lowest[1] + spacing[1] * rows[[0, -1]]).tolist()
    plane = case.region.plane(landmarks, foremost, hindmost)
    areas = np.count_nonzero(inside, axis=(0, 1))
    slices = np.flatnonzero(areas)
    bounds = [case.region.lower, case.region.upper]
    for which, end, inwards in ((0, slices[0], 1), (1, slices[-1], -1)):
        if bounds[which] is None and _is_cut(areas[slices][::inwards], float(spacing[2])):
            height = lowest[2] + spacing[2] * (end - 0.5 * inwards)
            bounds[which] = float(height + inwards * CUT_MARGIN * spacing[2])
    return TissueRegion(plane.point, plane.normal, lower=bounds[0], upper=bounds[1])


def _is_cut(areas: NDArray[np.intp], step: float) -> bool:
    """Whether a head whose cross-sections, from one end on, have these areas was cut off there."""
    layers = max(CUT_LAYERS, round(CUT_DEPTH / step))
    if len(areas) <= 2 * layers:
        return True
    near, farther = int(areas[layers]), int(areas[2 * layers])
    return near > CUT_SHARE * int(areas.max()) and near > CUT_GROWTH * farther


def end_planes(region: TissueRegion) -> dict[str, tuple[ArrayLike, ArrayLike]]:
    """Point and outward normal of each plane on which the tissue ends, by name."""
    planes: dict[str, tuple[ArrayLike, ArrayLike]] = {"posterior": (region.point, region.normal)}
    for name, side in (("lower", -1.0), ("upper", 1.0)):
        height = getattr(region, name)
        if height is not None:
            planes[name] = ((0.0, 0.0, height), (0.0, 0.0, side))
    return planes


def tissue_mesh(
    case: Case, level: ImageData, anatomy: Anatomy, seam: LipSeam | None = None
) -> tuple[TetMesh, MeshReport, tuple[Finding, ...]]:
    """The mesh that the case names or that fills the tissue, its report, and what to say of it.

    It is refined along a seam, not separated: that needs the kinds of its nodes.
    """
    if case.mesh.file is not None:
        mesh = TetMesh(*read_tet_mesh(case.mesh.file))
        report = mesh_report(mesh)
        return mesh, report, mesh_findings(report)
    options = MeshOptions(case.mesh.edge_length, refinements=0, least_body=LEAST_BODY)
    allowed = needed = None
    if case.mesh.refine:
        options = replace(options, refinements=GAP_REFINEMENTS)
        allowed = allowed_halvings(anatomy)
        needed = needed_halvings(level, anatomy)
        if seam is not None and seam.surface is not None:
            needed = np.maximum(needed, lip_halvings(level, seam, case.mesh.edge_length))
    made = mesh_from_level(level, options, allowed=allowed, needed=needed)
    return made.mesh, made.report, made.findings


def allowed_halvings(anatomy: Anatomy) -> Counts:
    """How often the edge may be halved for what is thin: (nx, ny, nz) on the anatomy's grid."""
    allowed: Counts = near_skin(anatomy, THIN_DEPTH).astype(np.uint8)
    allowed[anatomy.skin.values <= 0.0] = GAP_REFINEMENTS
    return allowed


def needed_halvings(level: ImageData, anatomy: Anatomy) -> Counts:
    """How often the edge is halved at least: once at the mouth, if the anatomy has a "mandible".

    A tet holds one mixture of fat and muscle: one half as large as a lip is thick smears the lip's
    muscle over it, where the motions of the jaws differ most. No landmark is asked for, nor that
    the image show the lips apart.
    """
    needed = np.zeros(level.values.shape, dtype=np.uint8)
    mandible = anatomy.bones.get("mandible")
    if mandible is None:
        return needed
    # Where a sum of distances below the width, and the depth there, depend on nothing outside.
    sx, sy, sz = (float(s) for s in level.spacing)
    reach = np.ceil((MOUTH_WIDTH + MOUTH_DEPTH) / level.spacing).astype(int) + 1
    low, high = block_of(mandible.values > 0.0)
    box = tuple(slice(max(a - r, 0), b + r) for a, b, r in zip(low, high, reach, strict=True))
    lower = mandible.values[box] > 0.0
    upper = np.zeros(lower.shape, dtype=bool)
    for name, bone in anatomy.bones.items():
        if name != "mandible":
            upper |= bone.values[box] > 0.0
    width = distance_image(lower, (sx, sy, sz), within=MOUTH_WIDTH)
    width += distance_image(upper, (sx, sy, sz), within=MOUTH_WIDTH)
    outside = anatomy.skin.values[box] <= 0.0
    depth = distance_image(outside, (sx, sy, sz), within=MOUTH_DEPTH)
    mouth = (level.values[box] > 0.0) & (width < MOUTH_WIDTH) & (depth < MOUTH_DEPTH)
    rows = np.flatnonzero(mouth.any(axis=(0, 2)))
    if len(rows):
        # The second axis of the grid runs from front to back.
        mouth[:, rows[0] + int(MOUTH_LENGTH / sy) + 1 :] = False
    needed[box] = mouth
    return needed


def lip_halvings(level: ImageData, seam: LipSeam, edge_length: float) -> Counts:
    """How often the edge is halved at least along the seam between thin lips."""
    values = level.values
    needed = np.zeros(values.shape, dtype=np.uint8)
    if seam.surface is None:
        return needed
    thickness = float(seam.summary.get("thickness", np.inf))
    wanted = int(np.ceil(np.log2(max(TETS_IN_LIP * edge_length / max(thickness, 1e-3), 1.0))))
    vertices, spacing = seam.surface.vertices, level.spacing
    low = np.floor((vertices.min(axis=0) - SEAM_REACH - level.lowest) / spacing).astype(int)
    high = np.ceil((vertices.max(axis=0) + SEAM_REACH - level.lowest) / spacing).astype(int) + 1
    low, high = np.maximum(low, 0), np.clip(high, 0, values.shape)
    if wanted < 1 or (high <= low).any():
        return needed
    crop = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    index = np.argwhere(values[crop] > 0.0) + low
    points = level.lowest + index * spacing
    near = index[distances(points, Surface(vertices, seam.surface.triangles)) <= SEAM_REACH]
    needed[tuple(near.T)] = min(wanted, GAP_REFINEMENTS)
    return needed


# Soft tissue follows a bone that moves over about its own thickness, mm: what is fixed nearer than
# that holds the face back.
NEAR_END = 20.0
# Skin and tissue that end on the image's border over less than this are not cut off, mm².
CUT_AREA = 150.0
# A surface that the border closes ends half a voxel to one inside it.
BORDER_VOXELS = 1.5
# Cosine from which a triangle faces a border.
FACING = 0.9
BORDERS = (("right", "left"), ("front", "back"), ("bottom", "top"))
# As [node_kinds] has them.
KIND_BORDERS = (("right", "left"), ("anterior", "posterior"), ("inferior", "superior"))


def nodes_of(
    head: Head, stages: Stages, bones: PlannedBones, tissue: Tissue, options: KindOptions
) -> Nodes:
    """What the nodes of the tissue do: joined, sliding, fixed or free, with contact and lips."""
    case, anatomy, mesh, report = head.case, head.anatomy, tissue.mesh, tissue.report
    moved = _moved(case, bones)
    contacts = tissue.contacts
    stages.add(contacts.findings)
    stages.begin("classifying nodes")
    classified = classify_nodes(
        mesh.nodes,
        mesh.boundary_triangles(),
        anatomy,
        bones.segments,
        moved=moved,
        landmarks=head.skull,
        fixed_planes=end_planes(tissue.region),
        options=options,
        arches=tissue.arches,
        contacts={name: sheet.surface for name, sheet in contacts.sheets.items()},
    )
    stages.add(classified.findings)
    whole = mesh.n_tets
    mesh, kinds, body = _remaining(stages, bones, mesh, classified.kinds, case)
    lips = CaseLipContact({}, kinds)
    if tissue.seam is not None:
        stages.begin("separating the lips")
        mesh, kinds, body, noticed = separated_at_seam(mesh, kinds, body, tissue.seam)
        stages.add(noticed)
        lips = lip_contact(
            mesh,
            kinds,
            tissue.seam,
            height=case.lips.height,
            arches=tissue.arches,
            walls=_walls(head, stages, bones, tissue, options),
            segments=bones.segments,
        )
        kinds = lips.kinds
    with ThreadPoolExecutor(1) as beside:
        counted = None
        if mesh.n_tets < whole or lips.regions:
            counted = beside.submit(report_of_part, mesh, report)
        stages.add(_noticed(head, bones, tissue, mesh, kinds))
        stages.findings = [*dict.fromkeys(stages.findings)]
        lifted = lifted_tissue(mesh.nodes, kinds, bones.segments, moved, options)
        if options.septum:
            held = septum(
                mesh.nodes,
                kinds,
                bones.segments,
                moved,
                head.landmarks,
                by_vertex=[n for n, m in bones.motions.items() if isinstance(m, MovedSurface)],
            )
            stages.add(held.findings)
            kinds = held.kinds
            lifted = None if lifted is None else lifted.without(held.nodes)
        lifted = None if lifted is None else lifted_where_held(mesh, kinds, body, lifted)
        report = report if counted is None else counted.result()
    return Nodes(mesh, report, kinds, contacts, tissue.level, tissue.seam, lips, lifted)


def _remaining(
    stages: Stages, bones: PlannedBones, mesh: TetMesh, kinds: NodeKinds, case: Case
) -> tuple[TetMesh, NodeKinds, Integers]:
    """The tets that are neither in a cleft nor crushed and are held by bone: kinds, bodies."""
    moved = _moved(case, bones)
    if case.mesh.file is None:
        mesh, kinds, noticed = without_clefts(mesh, kinds, bones.segments, moved, case.mesh.cleft)
        stages.add(noticed)
        if case.solver.kinematics != "linear":
            mesh, kinds, noticed = without_crushed(
                mesh, kinds, bones.segments, bones.motions, case.mesh.cleft
            )
            stages.add(noticed)
    mesh, kinds, body, noticed = held_part(mesh, kinds)
    stages.add(noticed)
    return mesh, kinds, body


def _walls(
    head: Head, stages: Stages, bones: PlannedBones, tissue: Tissue, options: KindOptions
) -> CaseContacts:
    """The sheets that the lips may not enter, whatever tissue slides on.

    The blurred bone would let a lip that only pushes sink into the edges of the teeth.
    """
    if options.contact_surface == "sheet" and options.sliding:
        return tissue.contacts
    sheets = replace(options, contact_surface="sheet", sliding=True)
    mesh = None if head.case.mesh.file is None else tissue.mesh
    walls = made_contacts(head, stages, bones, tissue.arches, sheets, mesh=mesh)
    stages.add(walls.findings)
    return walls


def _moved(case: Case, bones: PlannedBones) -> list[str]:
    """The names of the segments that are cut or planned to move."""
    return [*dict.fromkeys([*cut_segments(case), *bones.motions])]


def _noticed(
    head: Head, bones: PlannedBones, tissue: Tissue, mesh: TetMesh, kinds: NodeKinds
) -> list[Finding]:
    """Where the tissue ends next to bone that moves, and segments that hold none of it."""
    moved = _moved(head.case, bones)
    moving = [segment for segment in bones.segments if segment.name in moved]
    return [
        *near_ends(head.anatomy, tissue.region, moving),
        *loose_ends(mesh, kinds, head.anatomy),
        *untouched(head.case, mesh, kinds, bones),
    ]


def made_contacts(
    head: Head,
    stages: Stages,
    bones: PlannedBones,
    arches: DentalArches | None,
    options: KindOptions,
    *,
    mesh: TetMesh | None = None,
) -> CaseContacts:
    """The surfaces along the dental arches that tissue slides on: none without arches.

    mesh: That of the case's file, which has edges of its own.
    """
    if arches is None:
        return CaseContacts()
    if options.contact_surface == "sheet":
        stages.begin("making the contact sheets")
    edge = head.case.mesh.edge_length
    if mesh is not None:
        edge = mean_edge(mesh.nodes[mesh.boundary_triangles()])
    return arch_sheets(head.anatomy, bones.segments, arches, options, edge)


def near_ends(
    anatomy: Anatomy, region: TissueRegion, moving: Sequence[BoneSegment]
) -> Iterator[Finding]:
    """Findings on bones that move close to where tissue is fixed."""
    image_low, image_high = (float(h[2]) for h in (anatomy.skin.lowest, anatomy.skin.highest))
    for segment in moving:
        heights = segment.surface.vertices[:, 2]
        ends = (
            ("below", region.lower, float(heights.min()), -1.0, image_low, "lower"),
            ("above", region.upper, float(heights.max()), 1.0, image_high, "upper"),
        )
        for side, end, place, sign, border, key in ends:
            if end is None or sign * (end - place) >= NEAR_END:
                continue
            room = sign * (end - place)
            # The plane lies some voxels inside the image where the head was cut off there.
            cut = abs(end - border) < NEAR_END
            how = (
                "use a scan that extends further" if cut else f"move {key} in [region] further away"
            )
            yield Finding(
                "segment-near-end",
                f"{segment.name}, which moves, "
                + (
                    f"comes within {room:.1f} mm of the plane z = {end:.1f} mm {side} it"
                    if room > 0.0
                    else f"reaches {-room:.1f} mm past the plane z = {end:.1f} mm {side} it"
                )
                + f", on which all tissue is fixed (at least {NEAR_END:g} mm is needed)",
                where=f"{segment.name} at z = {place:.1f} mm",
                why=f"tissue {side} it cannot follow: the face there moves too little, or not at "
                "all" + (", because the image ends there" if cut else ""),
                fix=f"{how}, or exclude that part of the face from the evaluation",
            )


def loose_ends(mesh: TetMesh, kinds: NodeKinds, anatomy: Anatomy) -> Iterator[Finding]:
    """Findings on tissue that ends loose at a border of the image, where the anatomy does."""
    triangles = mesh.boundary_triangles()
    corners = mesh.nodes[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    twice = np.linalg.norm(normal, axis=1)
    free = (kinds.kind[triangles] == 0).all(axis=1)
    spacing = anatomy.skin.spacing
    for axis, names in enumerate(BORDERS):
        ends = (anatomy.skin.lowest, anatomy.skin.highest)
        for side, (name, sign, end) in enumerate(zip(names, (-1.0, 1.0), ends, strict=True)):
            there = np.abs(corners[:, :, axis] - end[axis]).max(axis=1)
            chosen = free & (there <= BORDER_VOXELS * spacing[axis])
            chosen &= sign * normal[:, axis] > FACING * twice
            area = 0.5 * float(twice[chosen].sum())
            if area <= CUT_AREA:
                continue
            yield Finding(
                "tissue-ends-loose",
                f"the tissue ends on the {name} border of the image over {area:.0f} mm², and "
                "nothing is fixed there",
                where=f"{name} border, {'xyz'[axis]} = {end[axis]:.1f} mm",
                fix="use an image that shows the whole face"
                + (
                    ", or bring the posterior plane inside it (posterior_depth in [region])"
                    if name == "back"
                    else f', or fix it: fixed_borders = ["{KIND_BORDERS[axis][side]}"] in '
                    "[node_kinds]"
                ),
            )
