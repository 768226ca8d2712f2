"""Builds the patient's model of a case, and writes it."""

import logging
import platform
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cmfsim._core import TetMesh, __version__
from cmfsim.bones import (
    CuttingPlane,
    Procedure,
    check_segments,
    cut_bones,
    free_cut,
    place_procedure,
)
from cmfsim.checks import Floats
from cmfsim.doctor import diagnose
from cmfsim.doctor.landmarks import (
    LANDMARK_CODES,
)
from cmfsim.errors import CaseInputError, CmfsimError
from cmfsim.io import Case, CaseOrPath, as_case, write_model
from cmfsim.lips import LipSeam, seam_faces
from cmfsim.meshing import (
    MeshReport,
    TissueRegion,
    report_of_part,
    tissue_level,
)
from cmfsim.node_kinds import (
    DentalArches,
    KindOptions,
    classify_nodes,
    dental_arches,
    kind_options,
    lifted_tissue,
    segment_data,
)
from cmfsim.pictures import picture_anatomy, picture_node_kinds
from cmfsim.pipeline.building.case_checks import cut_segments, misplaced, plan_sizes, untouched
from cmfsim.pipeline.building.clefts import without_clefts
from cmfsim.pipeline.building.contacts import CaseContacts, arch_sheets, mean_edge
from cmfsim.pipeline.building.ends import end_findings
from cmfsim.pipeline.building.held import held_part
from cmfsim.pipeline.building.inputs import (
    case_key,
    check_output,
    input_hashes,
    read_anatomy,
    read_case_landmarks,
)
from cmfsim.pipeline.building.landmarks import found_landmarks, landmark_summary
from cmfsim.pipeline.building.lips import (
    CaseLipContact,
    find_seam,
    lip_contact,
    lip_summary,
    separated_at_seam,
)
from cmfsim.pipeline.building.motions import PlannedBones, planned_bones
from cmfsim.pipeline.building.postoperative import Postoperative
from cmfsim.pipeline.building.skin_part import on_skin
from cmfsim.pipeline.building.stages import BuildOptions, Stages
from cmfsim.pipeline.building.tissue_mesh import end_planes, region_of, tissue_mesh
from cmfsim.progress import Progress, no_progress
from cmfsim.registration.proposed import ProposedLandmarks
from cmfsim.surfaces.levels import detailed_surface
from cmfsim.values.anatomy import Anatomy
from cmfsim.values.finding import Finding, OnFindings
from cmfsim.values.image_data import ImageData
from cmfsim.values.lifted_tissue import LiftedTissue
from cmfsim.values.node_kinds import NODE_KINDS, NodeKinds
from cmfsim.values.patient_model import PatientModel
from cmfsim.values.scene import Scene, SegmentData
from cmfsim.values.surface_data import SurfaceData

__all__ = ["build_case", "build_model", "model_of"]

_log = logging.getLogger(__name__)


def build_case(
    case: CaseOrPath,
    *,
    progress: Progress | None = None,
    check: bool = True,
    findings: Iterable[Finding] = (),
    on_findings: OnFindings | None = None,
) -> PatientModel:
    """The model of a case, written to its output folder.

    Parameters
    ----------
    case : Case, or path of its file or folder
    progress : callable, optional
        Called with the name of each stage as it begins.
    check : bool
        Whether the doctor looks at the case first; an error that it finds ends the work.
    findings : iterable of Finding
        What is known of the case already; the model keeps it.
    on_findings : callable, optional
        Called with new findings at the end of each stage.

    Returns
    -------
    PatientModel

    Raises
    ------
    CmfsimError
        (also `ValueError` where the input is at fault) What a stage cannot work with. Files that an
        earlier run left are then as they were.
    OSError
        The output folder cannot be written to.

    Examples
    --------
    >>> import cmfsim
    >>> model = cmfsim.build_case(cmfsim.Case.load("case.toml"))  # doctest: +SKIP
    >>> result = cmfsim.solve_scene(model.scene)  # doctest: +SKIP
    """
    case = as_case(case)
    check_output(case)
    model = build_model(
        case, progress=progress, check=check, findings=findings, on_findings=on_findings
    )
    stage = progress or no_progress
    stage("writing the model")
    begun = time.perf_counter()
    names = write_model(case.output, model, partial(_draw, model))
    timings = {**model.summary["timings"], "writing the model": time.perf_counter() - begun}
    more = {"timings": timings, "output": str(case.output), "files": names}
    return replace(model, summary={**model.summary, **more})


def build_model(
    case: CaseOrPath,
    *,
    progress: Progress | None = None,
    check: bool = True,
    findings: Iterable[Finding] = (),
    anatomy: Anatomy | None = None,
    after: Postoperative | None = None,
    on_findings: OnFindings | None = None,
) -> PatientModel:
    """The model of a case: read, segmented, cut, meshed and classified; nothing is written.

    Parameters
    ----------
    case : Case, or path of its file or folder
    progress : callable, optional
    check : bool
    findings : iterable of Finding
        As for `build_case`.
    anatomy : Anatomy, optional
        The head, where it is known; the image or surfaces of the case are then not read.
    after : Postoperative, optional
        What `read_postoperative` gives, where it is known already; an achieved plan is read off it.
    on_findings : callable, optional
        Called with new findings at the end of each stage.

    Returns
    -------
    PatientModel

    Raises
    ------
    CmfsimError
        (also `ValueError` where the input is at fault) What a stage cannot work with.

    Examples
    --------
    >>> import cmfsim
    >>> model = cmfsim.build_model(cmfsim.Case.load("case.toml"))  # doctest: +SKIP
    """
    options = BuildOptions(
        progress=progress,
        check=check,
        findings=findings,
        anatomy=anatomy,
        after=after,
        on_findings=on_findings,
    )
    return model_of(as_case(case), options)


def model_of(case: Case, options: BuildOptions) -> PatientModel:
    """The model of a case, as `build_model` makes it."""
    kinds = _kind_options(case)
    stages = Stages(options)
    if options.check:
        stages.begin("checking the case")
        stages.add(_checked(case))
    landmarks, noticed = read_case_landmarks(case)
    stages.add(noticed)
    anatomy = options.anatomy
    if anatomy is None:
        anatomy, noticed = read_anatomy(case, landmarks.get("skull", {}), stages.begin)
        stages.add(noticed)
    proposed = None
    if case.landmarks.proposed and not landmarks:
        proposed, anatomy = found_landmarks(case, anatomy, stages, is_read=options.anatomy is None)
        landmarks = {} if proposed is None else proposed.points
    head = _Head(case, landmarks, anatomy, proposed)
    bones, procedures = _bones(head, stages, options.after)
    tissue = _tissue(head, stages, bones, kinds)
    nodes = _nodes(head, stages, bones, tissue, kinds)
    patient = _assembled(head, stages, bones, nodes, procedures)
    if case.muscles is None:
        return patient
    stages.begin("placing and sampling the muscles")
    # A case without muscles loads nothing of them.
    from cmfsim.pipeline.building.muscles import with_muscles  # noqa: PLC0415

    return with_muscles(patient, case.muscles, mesh=nodes.mesh)


@dataclass(frozen=True, eq=False)
class _Head:
    """A case with what was read of it."""

    case: Case
    landmarks: Mapping[str, Mapping[str, Floats]]
    anatomy: Anatomy
    proposed: ProposedLandmarks | None = None

    @property
    def skull(self) -> Mapping[str, Floats]:
        return self.landmarks.get("skull", {})


@dataclass(frozen=True, eq=False)
class _Tissue:
    """The soft tissue of a head, and the tets that fill it."""

    region: TissueRegion
    level: ImageData
    mesh: TetMesh
    report: MeshReport
    arches: DentalArches | None
    seam: LipSeam | None


@dataclass(frozen=True, eq=False)
class _Nodes:
    """The mesh that is solved on, and what its nodes do."""

    mesh: TetMesh
    report: MeshReport
    kinds: NodeKinds
    contacts: CaseContacts
    level: ImageData
    seam: LipSeam | None
    lips: CaseLipContact
    lifted: LiftedTissue | None


def _bones(
    head: _Head, stages: Stages, after: Postoperative | None
) -> tuple[PlannedBones, tuple[Procedure, ...]]:
    """The segments of the bones with their motions, and the procedures that cut them."""
    case = head.case
    stages.begin("cutting the bones")
    cut = cut_bones(head.anatomy.bones, _procedures(case, head.skull))
    stages.add(cut.findings)
    if case.achieved:
        stages.begin("reading the achieved plan")
    bones = planned_bones(case, cut.segments, after)
    for name, fit in bones.fits.items():
        if fit.method == "shape":
            # By shape the size is known with an interval, and is no part of the motion.
            stages.drop({"moved-scaled"}, case.where(f"plan.{name}"))
    stages.add(bones.findings)
    stages.add(plan_sizes(case, bones, stages.findings))
    if case.image is not None:
        # What was compared with the voxels of the CT is compared with the bones made of them.
        stages.drop(LANDMARK_CODES)
        stages.add(misplaced(case, head.landmarks, head.anatomy, cut.segments))
    # Again for all of them together: pieces of two bones never met before.
    check_segments(bones.segments)
    return bones, cut.procedures


def _tissue(head: _Head, stages: Stages, bones: PlannedBones, options: KindOptions) -> _Tissue:
    case, anatomy = head.case, head.anatomy
    stages.begin("finding the soft tissue")
    region = region_of(head.case, head.anatomy, head.skull)
    level, noticed = tissue_level(head.anatomy, region)
    stages.add(noticed)

    arches = seam = None
    if options.sliding or case.lips.contact:
        arches = dental_arches(anatomy, bones.segments, head.skull)
    if case.lips.contact:
        stages.begin("finding the seam between the lips")
        seam = find_seam(case, anatomy, arches, head.landmarks.get("skin", {}))
        stages.add(seam.findings)

    stages.begin("filling the tissue with tets")
    mesh, report, noticed = tissue_mesh(case, level, anatomy, seam)
    stages.add(noticed)
    _log.info("mesh: %d nodes, %d tets", mesh.n_nodes, mesh.n_tets)
    return _Tissue(region, level, mesh, report, arches, seam)


def _nodes(
    head: _Head, stages: Stages, bones: PlannedBones, tissue: _Tissue, options: KindOptions
) -> _Nodes:
    case, anatomy, mesh, report = head.case, head.anatomy, tissue.mesh, tissue.report
    moved = [*dict.fromkeys([*cut_segments(case), *bones.motions])]
    arches, seam = tissue.arches, tissue.seam
    contacts = CaseContacts()
    if arches is not None:
        stages.begin("making the contact sheets")
        edge = case.mesh.edge_length if case.mesh.file is None else mean_edge(mesh)
        contacts = arch_sheets(anatomy, bones.segments, arches, options, edge)
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
        arches=arches,
        contacts=contacts.surfaces,
    )
    stages.add(classified.findings)
    kinds, whole = classified.kinds, mesh.n_tets
    if case.mesh.file is None:
        mesh, kinds, noticed = without_clefts(mesh, kinds, bones.segments, moved, case.mesh.cleft)
        stages.add(noticed)
    mesh, kinds, noticed = held_part(mesh, kinds)
    stages.add(noticed)
    lips = CaseLipContact({}, kinds)
    if seam is not None:
        stages.begin("separating the lips")
        mesh, kinds, noticed = separated_at_seam(mesh, kinds, seam)
        stages.add(noticed)
        lips = lip_contact(
            mesh,
            kinds,
            seam,
            height=case.lips.height,
            arches=arches,
            contacts=contacts,
            segments=bones.segments,
        )
        kinds = lips.kinds
    if mesh.n_tets < whole or lips.regions:
        report = report_of_part(mesh, report)
    found = end_findings(
        mesh.nodes,
        mesh.boundary_triangles(),
        kinds,
        anatomy,
        tissue.region,
        segments=bones.segments,
        moved=moved,
    )
    stages.add(found)
    stages.add(untouched(case, mesh, kinds, bones))
    stages.drop_repeated()
    lifted = lifted_tissue(mesh.nodes, kinds, bones.segments, moved, options)
    return _Nodes(mesh, report, kinds, contacts, tissue.level, seam, lips, lifted)


def _assembled(
    head: _Head,
    stages: Stages,
    bones: PlannedBones,
    nodes: _Nodes,
    procedures: Sequence[Procedure],
) -> PatientModel:
    """The patient without muscles."""
    case, anatomy, kinds = head.case, head.anatomy, nodes.kinds
    stages.begin("assembling the scene")
    places, boundary = nodes.mesh.nodes, nodes.mesh.boundary_triangles()
    slid = nodes.contacts.of_scene(bones.segments, kinds)
    scene = _scene(case, nodes, bones, slid)
    departures = nodes.contacts.summary(bones.segments, kinds, places, slid)
    is_skin = on_skin(places, boundary, anatomy, nodes.level)
    if nodes.lips.regions:
        # What the lips turn to each other is inside the mouth.
        is_skin &= ~seam_faces(places, boundary)
    skin = boundary[is_skin]
    stages.end()
    return PatientModel(
        name=case.name,
        scene=scene,
        kinds=kinds,
        boundary_triangles=boundary,
        skin_triangles=skin,
        segments=bones.segments,
        anatomy=anatomy,
        fat=case.tissue,
        landmarks=head.landmarks,
        lifted=nodes.lifted,
        lips=nodes.lips.regions,
        findings=tuple(stages.findings),
        summary={
            **_summary(head, nodes, stages, procedures),
            "contact": departures,
            **({} if nodes.seam is None else {"lips": lip_summary(nodes.seam, nodes.lips)}),
            **({} if bones.achieved is None else {"achieved": bones.achieved.as_dict()}),
            **(
                {"plan_fits": {name: fit.as_dict() for name, fit in bones.fits.items()}}
                if bones.fits
                else {}
            ),
            "plan_sources": dict(bones.sources),
        },
        detailed_skin=partial(detailed_surface, "skin", anatomy.skin),
    )


def _draw(model: PatientModel, folder: Path) -> list[str]:
    """The names of the pictures drawn into a folder: none without PyVista or OpenGL."""
    anatomy, kinds = folder / "anatomy.png", folder / "node_kinds.png"
    try:
        picture_anatomy(anatomy, model.skin, model.segments)
        picture_node_kinds(
            kinds, model.scene.nodes, model.boundary_triangles, model.kinds, lips=model.lips
        )
    except CmfsimError as error:
        _log.warning("no pictures: %s", error)
    return [path.name for path in (anatomy, kinds) if path.exists()]


def _checked(case: Case) -> tuple[Finding, ...]:
    findings = diagnose(case)
    errors = [f for f in findings if f.severity == "error"]
    if errors:
        first = errors[0]
        more = f" ({len(errors) - 1} more: cmfsim doctor shows them)" if len(errors) > 1 else ""
        raise CaseInputError(f"{first.where}: {first.what}; {first.fix}{more}")
    return findings


def _procedures(case: Case, landmarks: Mapping[str, Floats]) -> list[Procedure]:
    placed = []
    for osteotomy in case.osteotomies:
        if osteotomy.procedure is not None:
            placed.append(place_procedure(osteotomy.procedure, landmarks, osteotomy.options))
        elif osteotomy.plane is not None:
            plane = CuttingPlane(osteotomy.plane.point, osteotomy.plane.normal)
            placed.append(free_cut(str(osteotomy.bone), str(osteotomy.name), (plane,)))
    return placed


def _kind_options(case: Case) -> KindOptions:
    """The options of [node_kinds], or an error that names their line."""
    try:
        return kind_options(case.node_kinds)
    except CaseInputError as error:
        raise CaseInputError(f"{case.where('node_kinds')}: {error}") from error


def _scene(
    case: Case, nodes: _Nodes, bones: PlannedBones, contacts: Mapping[str, SurfaceData]
) -> Scene:
    mesh, kinds, lips, lifted = nodes.mesh, nodes.kinds, nodes.lips, nodes.lifted
    data = segment_data(kinds, bones.segments, contacts=contacts)
    # Teeth that no node is attached to or slides on may still be before the lips.
    data |= {o.segment: SegmentData() for o in lips.obstacles if o.segment not in data}
    plan = {name: bones.motions.get(name, np.eye(4)) for name in data}
    fixed = kinds.nodes("fixed")
    if lifted is not None:
        fixed = lifted.fixed(fixed, plan[lifted.segment])
    return Scene(
        nodes=mesh.nodes,
        tets=mesh.tets,
        tissue=case.tissue,
        segments=data,
        plan=plan,
        fixed=fixed,
        options=case.solver,
        touching=lips.touching,
        obstacles=lips.obstacles,
    )


def _summary(
    head: _Head, nodes: _Nodes, stages: Stages, procedures: Sequence[Procedure]
) -> dict[str, Any]:
    case, kinds, grid = head.case, nodes.kinds, head.anatomy.skin
    inputs = input_hashes(case)
    return {
        "case": case.name,
        "note": case.note,
        "nodes": {name: len(kinds.nodes(name)) for name in NODE_KINDS},
        "segments": {
            name: {kind: len(kinds.nodes(kind, name)) for kind in ("joined", "sliding")}
            for name in kinds.segments
        },
        "mesh": nodes.report.as_dict(),
        "grid": {
            "shape": list(grid.values.shape),
            "spacing": grid.spacing.tolist(),
            "origin": grid.lowest.tolist(),
        },
        "bones": list(head.anatomy.bones),
        **({} if head.proposed is None else {"landmarks": landmark_summary(head.proposed)}),
        "osteotomies": [
            {"procedure": placed.kind, "options": dict(placed.options)} for placed in procedures
        ],
        "findings": [asdict(finding) for finding in stages.findings],
        "timings": dict(stages.seconds),
        "inputs": inputs,
        "inputs_key": case_key(case, inputs),
        "versions": {
            "cmfsim": __version__,
            "numpy": np.__version__,
            "python": platform.python_version(),
        },
    }
