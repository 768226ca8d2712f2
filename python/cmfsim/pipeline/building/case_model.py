"""Builds the patient's model of a case, and puts it together with its summary."""

import logging
import platform
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from cmfsim._core import TetMesh, __version__
from cmfsim.bones.cuts.cutting import cut_bones
from cmfsim.bones.cuts.planes import Procedure
from cmfsim.bones.cuts.procedures import placed_cut
from cmfsim.bones.segment_checks import check_segments
from cmfsim.doctor import diagnose
from cmfsim.doctor.sites.landmarks import LANDMARK_CODES
from cmfsim.errors import CaseInputError
from cmfsim.io import Case, CaseOrPath, as_case
from cmfsim.meshing.levels import tissue_level
from cmfsim.meshing.lips.seam import seam_faces
from cmfsim.meshing.node_kinds.arches import dental_arches
from cmfsim.meshing.node_kinds.classification import segment_data
from cmfsim.meshing.node_kinds.options import KindOptions, kind_options
from cmfsim.pipeline.building.case_checks import (
    Head,
    MeshedTissue,
    Nodes,
    Tissue,
    jaws,
    misplaced,
    plan_sizes,
    turned_head,
)
from cmfsim.pipeline.building.inputs import (
    case_key,
    input_hashes,
    plan_key,
    plan_of_other_case,
    read_anatomy,
    read_case_landmarks,
)
from cmfsim.pipeline.building.landmarks import (
    check_bones_of_sites,
    check_pieces,
    found_landmarks,
    is_to_be_found,
    landmark_summary,
)
from cmfsim.pipeline.building.skin import check_skin, find_seam, lip_summary, on_skin, with_photo
from cmfsim.pipeline.building.stages import BuildKeywords, BuildOptions, Stages, build_options
from cmfsim.pipeline.building.surgery.motions import PlannedBones, planned_bones
from cmfsim.pipeline.building.surgery.postoperative import Postoperative
from cmfsim.pipeline.building.tissue.nodes import made_contacts, nodes_of, region_of, tissue_mesh
from cmfsim.surfaces.levels import detailed_surface
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding
from cmfsim.values.patient_model import PatientModel
from cmfsim.values.progress import expected_stages
from cmfsim.values.scene import NODE_KINDS, Scene, SegmentData
from cmfsim.values.surface_data import SurfaceData

if TYPE_CHECKING:
    from typing_extensions import Unpack
_log = logging.getLogger(__name__)


def assembled(
    head: Head, stages: Stages, bones: PlannedBones, nodes: Nodes, procedures: Sequence[Procedure]
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
        fat=case.fat,
        landmarks=head.landmarks,
        lifted=nodes.lifted,
        lips=nodes.lips.regions,
        findings=tuple(stages.findings),
        summary={
            **_summary(head, nodes, stages, procedures),
            "contact": departures,
            **({} if nodes.seam is None else {"lips": lip_summary(nodes.seam, nodes.lips)}),
            **({} if bones.achieved is None else {"achieved": bones.achieved.as_dict()}),
            **_fits(bones),
        },
        detailed_skin=partial(_detailed_skin, head),
        face_colours=head.colours,
    )


def _detailed_skin(head: Head) -> SurfaceData | None:
    return head.skin or detailed_surface("skin", head.anatomy.skin)


def _scene(
    case: Case, nodes: Nodes, bones: PlannedBones, contacts: Mapping[str, SurfaceData]
) -> Scene:
    mesh, kinds, lips, lifted = nodes.mesh, nodes.kinds, nodes.lips, nodes.lifted
    data = segment_data(kinds, bones.segments, contacts=contacts)
    # Teeth that no node is attached to or slides on may still be before the lips.
    data |= {o.segment: SegmentData() for o in lips.obstacles if o.segment not in data}
    plan = {name: bones.motions.get(name, np.eye(4)) for name in data}
    fixed = kinds.nodes("fixed")
    if lifted is not None:
        fixed, data = lifted.held(fixed, data, plan)
    return Scene(
        nodes=mesh.nodes,
        tets=mesh.tets,
        tissue=case.fat,
        segments=data,
        plan=plan,
        fixed=fixed,
        options=case.solver,
        touching=lips.touching,
        obstacles=lips.obstacles,
    )


def _summary(
    head: Head, nodes: Nodes, stages: Stages, procedures: Sequence[Procedure]
) -> dict[str, Any]:
    case, kinds, grid = head.case, nodes.kinds, head.anatomy.skin
    inputs = input_hashes(case)
    return {
        "case": case.name,
        "patient": case.patient,
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


def build_model(case: CaseOrPath, **options: "Unpack[BuildKeywords]") -> PatientModel:
    """The model of a case: read, segmented, cut, meshed and classified; nothing is written.

    Parameters
    ----------
    case : Case, or path of its file or folder
    **options
        Those of `BuildOptions`.

    Raises
    ------
    CmfsimError
        (also `ValueError` if the input is at fault) A stage cannot continue.

    Examples
    --------
    >>> import cmfsim
    >>> model = cmfsim.build_model(cmfsim.Case.load("case.toml"))  # doctest: +SKIP
    """
    with build_options(options, expected_stages()) as asked:
        return model_of(as_case(case), asked)


def model_of(case: Case, options: BuildOptions) -> PatientModel:
    """The model of a case, as `build_model` makes it."""
    kinds = kind_options_of(case)
    stages = Stages(options)
    head = _head(case, stages, options)
    stages.add(check_skin(head.anatomy, head.skull))
    if case.photo is not None:
        stages.begin("placing the 3D photo")
        skin, colours, placed = with_photo(head)
        head = replace(head, skin=skin, colours=colours)
        stages.add((placed,))
    # Tissue and muscles are placed by the anatomy and its landmarks, whatever becomes of the bones.
    with ThreadPoolExecutor(2) as beside:
        tissue = beside.submit(_meshed, head)
        if case.muscles is None:
            return _without_muscles(head, stages, kinds, options, tissue)[0]
        # A case without muscles loads nothing of them.
        from cmfsim.pipeline.building.tissue.muscles import NoMuscles, placed_muscles, with_muscles  # noqa: PLC0415

        placing = beside.submit(placed_muscles, case.muscles, head.skull)

        def show(bones: PlannedBones) -> None:
            if placing.done():
                placed = placing.result()
                if not isinstance(placed, NoMuscles):
                    options.observer.muscles(placed.muscles, bones.segments)

        patient, mesh = _without_muscles(head, stages, kinds, options, tissue, show=show)
        stages.begin("placing and sampling the muscles")
        return with_muscles(patient, case.muscles, mesh=mesh, placed=placing.result)


def replanned(
    patient: PatientModel, before: Case, case: Case, options: BuildOptions
) -> PatientModel:
    """The model of a case that differs only in its plan from the one `before`, of the patient."""
    old = {finding.what for finding in _of_plan(patient, before, Stages(BuildOptions()))[1]}
    stages = Stages(options)
    bones, found = _of_plan(patient, case, stages)
    new = {finding.what for finding in found}
    kept = [f for f in patient.findings if f.what not in old | new]
    moved = {n: motion for n, motion in bones.motions.items() if n in patient.scene.segments}
    model = patient.with_plan(moved)
    scene = replace(model.scene, options=case.solver)
    findings = tuple(dict.fromkeys([*found, *kept]))
    summary = {
        **{k: v for k, v in patient.summary.items() if k != "plan_fits"},
        "findings": [asdict(finding) for finding in findings],
        "timings": dict(stages.seconds),
        **_fits(bones),
    }
    return replace(model, scene=scene, findings=findings, summary=summary)


def _of_plan(
    patient: PatientModel, case: Case, stages: Stages
) -> tuple[PlannedBones, list[Finding]]:
    """The bones of a patient with the motions of a case, and what is found of its plan."""
    stages.begin("checking the case")
    stages.add(_checked(case))
    bones = planned_bones(case, patient.segments)
    _note_plan(stages, case, bones, patient.landmarks.get("skull", {}))
    if case.image is not None:
        stages.drop(LANDMARK_CODES)
    stages.end()
    return bones, stages.findings


def planned_head(
    case: Case, options: BuildOptions
) -> tuple[Head, PlannedBones, tuple[Finding, ...]]:
    """The head of a case and its bones with their motions, as `model_of` has them: no tissue."""
    stages = Stages(options)
    stages.add(plan_of_other_case(case, plan_key(case)))
    head = _head(case, stages, options)
    bones = _bones(head, stages, options.after)[0]
    return head, bones, tuple(stages.findings)


def _head(case: Case, stages: Stages, options: BuildOptions) -> Head:
    """What was read of a case, with the landmarks that were found and the teeth of its scans."""
    head = _read_head(case, stages, options)
    if case.image is not None and case.image.teeth is not None:
        # A case without scans loads nothing of tooth rows.
        from cmfsim.pipeline.building.teeth import with_scanned_teeth  # noqa: PLC0415

        return with_scanned_teeth(head, case.image.teeth, stages)
    return head


def _read_head(case: Case, stages: Stages, options: BuildOptions) -> Head:
    if options.check:
        stages.begin("checking the case")
        stages.add(_checked(case))
    landmarks, noticed = read_case_landmarks(case)
    stages.add(noticed)
    anatomy = options.anatomy
    if anatomy is None:
        skull = landmarks.get("skull", {})
        anatomy, noticed = read_anatomy(case, skull, stages.begin, options.opened)
        if options.opened is not None:
            # It is large, and needed no longer.
            options.opened.clear()
        stages.add(noticed)
    check_bones_of_sites(case, landmarks.get("skull", {}), anatomy, by_hand=True)
    if is_to_be_found(case, landmarks):
        is_read = options.anatomy is None
        head = found_landmarks(case, anatomy, stages, landmarks, is_read=is_read)
        check_bones_of_sites(case, head.skull, head.anatomy, by_hand=bool(landmarks))
        return head
    return Head(case, landmarks, anatomy)


def _without_muscles(
    head: Head,
    stages: Stages,
    kinds: KindOptions,
    options: BuildOptions,
    meshed: "Future[MeshedTissue]",
    *,
    show: Callable[[PlannedBones], None] = lambda _: None,
) -> tuple[PatientModel, TetMesh]:
    bones, procedures = _bones(head, stages, options.after)
    tissue = _tissue(head, stages, bones, kinds, meshed)
    show(bones)
    nodes = nodes_of(head, stages, bones, tissue, kinds)
    show(bones)
    return assembled(head, stages, bones, nodes, procedures), nodes.mesh


def _bones(
    head: Head, stages: Stages, after: Postoperative | None
) -> tuple[PlannedBones, tuple[Procedure, ...]]:
    """The segments of the bones with their motions, and the procedures that cut them."""
    case = head.case
    stages.begin("cutting the bones")
    placed = [placed_cut(osteotomy, head.skull) for osteotomy in case.osteotomies]
    cut = cut_bones(head.anatomy.bones, placed)
    stages.add(cut.findings)
    by_hand = not case.landmarks.proposed
    check_pieces(case, head.skull, cut.segments, cut.procedures, by_hand=by_hand)
    if case.achieved:
        stages.begin("reading the achieved plan")
    bones = planned_bones(case, cut.segments, after)
    _note_plan(stages, case, bones, head.skull)
    if case.image is not None:
        # What was compared with the voxels of the CT is compared with the bones made of them.
        stages.drop(LANDMARK_CODES)
        stages.add(misplaced(case, head.landmarks, head.anatomy, cut.segments))
    if bones.segments != cut.segments:
        # Again for all of them together: pieces of two bones never met before.
        check_segments(bones.segments)
    return bones, cut.procedures


def _note_plan(
    stages: Stages, case: Case, bones: PlannedBones, skull: Mapping[str, Floats]
) -> None:
    for name, fit in bones.fits.items():
        if fit.method == "shape":
            # By shape the size is known with an interval, and is no part of the motion.
            stages.drop({"moved-scaled"}, case.where(f"plan.{name}"))
    stages.add(bones.findings)
    stages.add(plan_sizes(case, bones, stages.findings))
    stages.add(turned_head(case, skull))
    stages.add(jaws(bones, skull, case, stages.findings))


def _fits(bones: PlannedBones) -> dict[str, Any]:
    """What the summary of a patient has of its plan."""
    fits = {name: fit.as_dict() for name, fit in bones.fits.items()}
    return {**({"plan_fits": fits} if fits else {}), "plan_sources": dict(bones.sources)}


def _meshed(head: Head) -> MeshedTissue:
    """The tissue of a head, with its mesh where no seam between the lips has to be found first."""
    region = region_of(head.case, head.anatomy, head.skull)
    level, findings = tissue_level(head.anatomy, region)
    filled = None if head.case.lips.contact else tissue_mesh(head.case, level, head.anatomy)
    return MeshedTissue(region, level, findings, filled)


def _tissue(
    head: Head,
    stages: Stages,
    bones: PlannedBones,
    options: KindOptions,
    meshed: "Future[MeshedTissue]",
) -> Tissue:
    case, anatomy = head.case, head.anatomy
    stages.begin("finding the soft tissue")
    arches = seam = None
    if options.sliding or case.lips.contact:
        arches = dental_arches(anatomy, bones.segments, head.skull)
    contacts = None
    if case.mesh.file is None:
        # While the tissue is meshed.
        contacts = made_contacts(head, stages, bones, arches, options)
    stages.begin("filling the tissue with tets")
    found = meshed.result()
    stages.add(found.findings)
    filled = found.filled
    if case.lips.contact:
        stages.begin("finding the seam between the lips")
        seam = find_seam(case, anatomy, arches, head.landmarks.get("skin", {}))
        stages.add(seam.findings)
        stages.begin("filling the tissue with tets")
    if filled is None:
        filled = tissue_mesh(case, found.level, anatomy, seam)
    mesh, report, noticed = filled
    stages.add(noticed)
    _log.info("mesh: %d nodes, %d tets", mesh.n_nodes, mesh.n_tets)
    if contacts is None:
        contacts = made_contacts(head, stages, bones, arches, options, mesh=mesh)
    return Tissue(found.region, found.level, mesh, report, arches, seam, contacts)


def _checked(case: Case) -> tuple[Finding, ...]:
    findings = diagnose(case)
    errors = [f for f in findings if f.severity == "error"]
    if errors:
        first = errors[0]
        more = f" ({len(errors) - 1} more: cmfsim doctor shows them)" if len(errors) > 1 else ""
        raise CaseInputError(f"{first.where}: {first.what}; {first.fix}{more}")
    return findings


def kind_options_of(case: Case) -> KindOptions:
    """The options of [node_kinds]; `CaseError`, with the line, where one is not valid."""
    for key, value in case.node_kinds.items():
        try:
            kind_options({key: value})
        except CaseInputError as error:
            raise CaseInputError(f"{case.where(f'node_kinds.{key}')}: {error}") from error
    return kind_options(case.node_kinds)
