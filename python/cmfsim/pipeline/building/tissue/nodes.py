"""The kind of each node of the soft tissue, and the remaining tets."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

from cmfsim._core import TetMesh
from cmfsim.io import Case
from cmfsim.meshing import report_of_part
from cmfsim.meshing.node_kinds import (
    DentalArches,
    KindOptions,
    classify_nodes,
    lifted_tissue,
    septum,
)
from cmfsim.pipeline.building.case_checks import cut_segments, untouched
from cmfsim.pipeline.building.parts import Head, Nodes, Tissue
from cmfsim.pipeline.building.skin.lips import CaseLipContact, lip_contact, separated_at_seam
from cmfsim.pipeline.building.stages import Stages
from cmfsim.pipeline.building.surgery.attached_bodies import held_part
from cmfsim.pipeline.building.surgery.motions import PlannedBones
from cmfsim.pipeline.building.tissue.clefts import without_clefts, without_crushed
from cmfsim.pipeline.building.tissue.contacts import CaseContacts, arch_sheets, mean_edge
from cmfsim.pipeline.building.tissue.tissue_ends import end_findings
from cmfsim.pipeline.building.tissue.tissue_mesh import end_planes
from cmfsim.values.finding import Finding
from cmfsim.values.node_kinds import NodeKinds
from cmfsim.values.surface_data import MovedSurface


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
    kinds, whole = classified.kinds, mesh.n_tets
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
