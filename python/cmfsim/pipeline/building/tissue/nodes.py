"""The kind of each node of the soft tissue, the remaining tets, and ends near moving bone."""

from collections.abc import Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cmfsim._core import TetMesh
from cmfsim.io import Case
from cmfsim.meshing import TissueRegion, report_of_part
from cmfsim.meshing.node_kinds import (
    DentalArches,
    KindOptions,
    classify_nodes,
    lifted_tissue,
    septum,
)
from cmfsim.pipeline.building.case_checks import Head, Nodes, Tissue, cut_segments, untouched
from cmfsim.pipeline.building.skin.lips import (
    CaseLipContact,
    held_part,
    lip_contact,
    separated_at_seam,
)
from cmfsim.pipeline.building.stages import Stages
from cmfsim.pipeline.building.surgery.motions import PlannedBones
from cmfsim.pipeline.building.tissue.contacts import (
    CaseContacts,
    arch_sheets,
    mean_edge,
    without_clefts,
    without_crushed,
)
from cmfsim.pipeline.building.tissue.tissue_mesh import end_planes
from cmfsim.values.anatomy import Anatomy, BoneSegment
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding
from cmfsim.values.node_kinds import NodeKinds
from cmfsim.values.surface_data import MovedSurface

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
        contacts=contacts.surfaces,
    )
    stages.add(classified.findings)
    whole = mesh.n_tets
    mesh, kinds = _remaining(stages, bones, mesh, classified.kinds, case)
    lips = CaseLipContact({}, kinds)
    if tissue.seam is not None:
        stages.begin("separating the lips")
        mesh, kinds, noticed = separated_at_seam(mesh, kinds, tissue.seam)
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
        stages.drop_repeated()
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
        report = report if counted is None else counted.result()
    return Nodes(mesh, report, kinds, contacts, tissue.level, tissue.seam, lips, lifted)


def _remaining(
    stages: Stages, bones: PlannedBones, mesh: TetMesh, kinds: NodeKinds, case: Case
) -> tuple[TetMesh, NodeKinds]:
    """The tets that are neither in a cleft nor crushed and are held by bone, and their nodes."""
    moved = _moved(case, bones)
    if case.mesh.file is None:
        mesh, kinds, noticed = without_clefts(mesh, kinds, bones.segments, moved, case.mesh.cleft)
        stages.add(noticed)
        if case.solver.kinematics != "linear":
            mesh, kinds, noticed = without_crushed(
                mesh, kinds, bones.segments, bones.motions, case.mesh.cleft
            )
            stages.add(noticed)
    mesh, kinds, noticed = held_part(mesh, kinds)
    stages.add(noticed)
    return mesh, kinds


def _walls(
    head: Head, stages: Stages, bones: PlannedBones, tissue: Tissue, options: KindOptions
) -> CaseContacts:
    """The sheets that the lips may not enter, whatever tissue slides on.

    The blurred bone would let a lip that only pushes sink into the edges of the teeth.
    """
    if options.contact_surface == "sheet" and options.sliding:
        return tissue.contacts
    sheets = replace(options, contact_surface="sheet", sliding=True)
    case = head.case
    edge = case.mesh.edge_length if case.mesh.file is None else mean_edge(tissue.mesh)
    walls = made_contacts(head, stages, bones, tissue.arches, sheets, edge_length=edge)
    stages.add(walls.findings)
    return walls


def _moved(case: Case, bones: PlannedBones) -> list[str]:
    """The names of the segments that are cut or planned to move."""
    return [*dict.fromkeys([*cut_segments(case), *bones.motions])]


def _noticed(
    head: Head, bones: PlannedBones, tissue: Tissue, mesh: TetMesh, kinds: NodeKinds
) -> list[Finding]:
    """Where the tissue ends next to bone that moves, and segments that hold none of it."""
    ends = end_findings(
        mesh.nodes,
        mesh.boundary_triangles(),
        kinds,
        head.anatomy,
        tissue.region,
        segments=bones.segments,
        moved=_moved(head.case, bones),
    )
    return [*ends, *untouched(head.case, mesh, kinds, bones)]


def made_contacts(
    head: Head,
    stages: Stages,
    bones: PlannedBones,
    arches: DentalArches | None,
    options: KindOptions,
    *,
    edge_length: float,
) -> CaseContacts:
    """The surfaces along the dental arches that tissue slides on: none without arches."""
    if arches is None:
        return CaseContacts()
    if options.contact_surface == "sheet":
        stages.begin("making the contact sheets")
    return arch_sheets(head.anatomy, bones.segments, arches, options, edge_length)


def end_findings(
    nodes: Floats,
    triangles: NDArray[np.uint32],
    kinds: NodeKinds,
    anatomy: Anatomy,
    region: TissueRegion,
    *,
    segments: Sequence[BoneSegment],
    moved: Collection[str],
) -> list[Finding]:
    """Findings on bones that move close to where tissue is fixed, and on tissue that ends loose.

    nodes: (n, 3), mm.
    triangles: (t, 3) uint32. Boundary of the tissue's mesh, outward.
    anatomy: Its grid ends where the image does.
    moved: Names of the segments that move.
    """
    near = _near_ends(anatomy, region, [s for s in segments if s.name in moved])
    return [*near, *_loose_ends(nodes, triangles, kinds, anatomy)]


def _near_ends(
    anatomy: Anatomy, region: TissueRegion, moving: Sequence[BoneSegment]
) -> Iterator[Finding]:
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


def _loose_ends(
    nodes: Floats, triangles: NDArray[np.uint32], kinds: NodeKinds, anatomy: Anatomy
) -> Iterator[Finding]:
    corners = nodes[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    twice = np.linalg.norm(normal, axis=1)
    free = (kinds.kind[triangles] == 0).all(axis=1)
    spacing = anatomy.skin.spacing
    for axis, names in enumerate(BORDERS):
        for name, sign, end in zip(
            names, (-1.0, 1.0), (anatomy.skin.lowest, anatomy.skin.highest), strict=True
        ):
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
                    else f', or fix it: fixed_borders = ["{_kind_border(axis, sign)}"] in '
                    "[node_kinds]"
                ),
            )


def _kind_border(axis: int, sign: float) -> str:
    """The border's name as [node_kinds] has it."""
    names = (("right", "left"), ("anterior", "posterior"), ("inferior", "superior"))
    return names[axis][int(sign > 0.0)]
