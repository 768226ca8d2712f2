"""Builds the patient's model of a case, and writes it."""

import logging
import platform
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cmfsim._core import Surface, TetMesh, __version__
from cmfsim.bones import (
    CuttingPlane,
    Procedure,
    check_segments,
    cut_bones,
    free_cut,
    place_procedure,
)
from cmfsim.checks import Floats
from cmfsim.doctor import SizedMotion, check_motion_size, diagnose
from cmfsim.doctor.landmarks import (
    LANDMARK_CODES,
    check_landmarks,
    nearest_of_level,
    nearest_of_surfaces,
)
from cmfsim.errors import CaseInputError, CmfsimError
from cmfsim.io import Case, CaseOrPath, as_case, write_model
from cmfsim.lips import seam_faces
from cmfsim.meshing import (
    MeshReport,
    report_of_part,
    tissue_level,
)
from cmfsim.node_kinds import (
    KindOptions,
    classify_nodes,
    dental_arches,
    kind_options,
    segment_data,
)
from cmfsim.pictures import picture_anatomy, picture_node_kinds
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
from cmfsim.pipeline.building.tissue_mesh import end_planes, region_of, tissue_mesh
from cmfsim.values.anatomy import NODE_KINDS, Anatomy, BoneSegment, Finding, NodeKinds
from cmfsim.values.patient_model import PatientModel
from cmfsim.values.scene import MovedSurface, Scene, SegmentData, SurfaceData

__all__ = ["build_case", "build_model"]

_log = logging.getLogger(__name__)

Progress = Callable[[str], None]
OnFindings = Callable[[Iterable[Finding]], None]


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
    stage = progress or _quiet
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
    case = as_case(case)
    options = _kind_options(case)
    findings = [*findings]
    stages = _Stages(progress or _quiet, findings, on_findings)
    if check:
        stages.begin("checking the case")
        findings += _checked(case)
    landmarks, noticed = read_case_landmarks(case)
    findings += noticed
    skull = landmarks.get("skull", {})
    if anatomy is None:
        anatomy, noticed = read_anatomy(case, skull, stages.begin)
        findings += noticed

    stages.begin("cutting the bones")
    cut = cut_bones(anatomy.bones, _procedures(case, skull))
    findings += cut.findings
    if case.achieved:
        stages.begin("reading the achieved plan")
    bones = planned_bones(case, cut.segments, after)
    findings += bones.findings
    findings += _plan_sizes(case, bones, findings)
    if case.image is not None:
        # What was compared with the voxels of the CT is compared with the bones made of them.
        findings[:] = [f for f in findings if f.code not in LANDMARK_CODES]
        findings += _misplaced(case, landmarks, anatomy, cut.segments)
    # Again for all of them together: pieces of two bones never met before.
    check_segments(bones.segments)
    moved = [*dict.fromkeys([*_cut_segments(case), *bones.motions])]

    stages.begin("finding the soft tissue")
    region = region_of(case, anatomy, skull)
    level, noticed = tissue_level(anatomy, region)
    findings += noticed

    arches = None
    if options.sliding or case.lips.contact:
        arches = dental_arches(anatomy, bones.segments, skull)
    seam = None
    if case.lips.contact:
        stages.begin("finding the seam between the lips")
        seam = find_seam(case, anatomy, arches, landmarks.get("skin", {}))
        findings += seam.findings

    stages.begin("filling the tissue with tets")
    mesh, report, noticed = tissue_mesh(case, level, anatomy, seam)
    findings += noticed
    _log.info("mesh: %d nodes, %d tets", mesh.n_nodes, mesh.n_tets)

    contacts = CaseContacts()
    if arches is not None:
        stages.begin("making the contact sheets")
        edge = case.mesh.edge_length if case.mesh.file is None else mean_edge(mesh)
        contacts = arch_sheets(anatomy, bones.segments, arches, options, edge)
        findings += contacts.findings

    stages.begin("classifying nodes")
    classified = classify_nodes(
        mesh.nodes,
        mesh.boundary_triangles(),
        anatomy,
        bones.segments,
        moved=moved,
        landmarks=skull,
        fixed_planes=end_planes(region),
        options=options,
        arches=arches,
        contacts=contacts.surfaces,
    )
    findings += classified.findings
    kinds, whole = classified.kinds, mesh.n_tets
    if case.mesh.file is None:
        mesh, kinds, noticed = without_clefts(mesh, kinds, bones.segments, moved, case.mesh.cleft)
        findings += noticed
    mesh, kinds, noticed = held_part(mesh, kinds)
    findings += noticed
    lips = CaseLipContact({}, kinds)
    if seam is not None:
        stages.begin("separating the lips")
        mesh, kinds, noticed = separated_at_seam(mesh, kinds, seam)
        findings += noticed
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
    findings += end_findings(
        np.asarray(mesh.nodes),
        np.asarray(mesh.boundary_triangles()),
        kinds,
        anatomy,
        region,
        segments=bones.segments,
        moved=moved,
    )
    findings += _untouched(case, mesh, kinds, bones)
    findings[:] = [*dict.fromkeys(findings)]

    stages.begin("assembling the scene")
    slid = contacts.of_scene(bones.segments, kinds)
    scene = _scene(case, mesh, kinds, bones, slid, lips)
    departures = contacts.summary(bones.segments, kinds, np.asarray(mesh.nodes), slid)
    boundary = np.asarray(mesh.boundary_triangles())
    is_skin = on_skin(np.asarray(mesh.nodes), boundary, anatomy, level)
    if lips.regions:
        # What the lips turn to each other is inside the mouth.
        is_skin &= ~seam_faces(mesh.nodes, boundary)
    skin = boundary[is_skin]
    stages.end()
    patient = PatientModel(
        name=case.name,
        scene=scene,
        kinds=kinds,
        boundary_triangles=boundary,
        skin_triangles=skin,
        segments=bones.segments,
        anatomy=anatomy,
        fat=case.tissue,
        landmarks=landmarks,
        lips=lips.regions,
        findings=tuple(findings),
        summary={
            **_summary(case, kinds, report, anatomy, findings, stages.seconds, cut.procedures),
            "contact": departures,
            **({} if seam is None else {"lips": lip_summary(seam, lips)}),
            **({} if bones.achieved is None else {"achieved": bones.achieved.as_dict()}),
            "plan_sources": dict(bones.sources),
        },
    )
    if case.muscles is None:
        return patient
    stages.begin("placing and sampling the muscles")
    # A case without muscles loads nothing of them.
    from cmfsim.pipeline.building.muscles import with_muscles  # noqa: PLC0415

    return with_muscles(patient, case.muscles, mesh=mesh)


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


class _Stages:
    """The stages as they pass, with the seconds that each took."""

    def __init__(
        self, progress: Progress, findings: list[Finding], on_findings: OnFindings | None
    ) -> None:
        self._progress = progress
        # The list that the stages add to, and what of it is known.
        self._findings, self._known, self._on_findings = findings, set(findings), on_findings
        self._name: str | None = None
        self._begun = 0.0
        self.seconds: dict[str, float] = {}

    def begin(self, name: str) -> None:
        self.end()
        self._name, self._begun = name, time.perf_counter()
        self._progress(name)

    def end(self) -> None:
        if self._name is not None:
            took = time.perf_counter() - self._begun
            self.seconds[self._name] = self.seconds.get(self._name, 0.0) + took
            self._name = None
        new = [finding for finding in self._findings if finding not in self._known]
        self._known.update(new)
        if new and self._on_findings is not None:
            self._on_findings(new)


def _quiet(stage: str) -> None:
    del stage


def _checked(case: Case) -> tuple[Finding, ...]:
    findings = diagnose(case)
    errors = [f for f in findings if f.severity == "error"]
    if errors:
        first = errors[0]
        more = f" ({len(errors) - 1} more: cmfsim doctor shows them)" if len(errors) > 1 else ""
        raise CaseInputError(f"{first.where}: {first.what}; {first.mend}{more}")
    return findings


def _misplaced(
    case: Case,
    landmarks: Mapping[str, Mapping[str, Floats]],
    anatomy: Anatomy,
    segments: tuple[BoneSegment, ...],
) -> list[Finding]:
    """Findings about landmarks that do not lie on the bones and the skin that were segmented."""
    surfaces = [Surface(s.surface.vertices, s.surface.triangles) for s in segments]
    findings: list[Finding] = []
    for key, places in landmarks.items():
        where = case.where(f"landmarks.{key}")
        on_bone = key == "skull"
        nearest = (
            nearest_of_surfaces(surfaces)
            if on_bone
            else nearest_of_level(anatomy.skin, 0.0, places)
        )
        findings += check_landmarks(key, places, where, nearest)
    # What is too far from the bone of the CT has ended the work before; what only lies far from the
    # bone that was segmented may lie on bone that was lost.
    return [replace(f, severity="warning") if f.severity == "error" else f for f in findings]


def _procedures(case: Case, landmarks: Mapping[str, Floats]) -> list[Procedure]:
    placed = []
    for osteotomy in case.osteotomies:
        if osteotomy.procedure is not None:
            placed.append(place_procedure(osteotomy.procedure, landmarks, osteotomy.options))
        elif osteotomy.plane is not None:
            plane = CuttingPlane(osteotomy.plane.point, osteotomy.plane.normal)
            placed.append(free_cut(str(osteotomy.bone), str(osteotomy.name), (plane,)))
    return placed


def _cut_segments(case: Case) -> list[str]:
    return [name for osteotomy in case.osteotomies for name in osteotomy.segments]


def _plan_sizes(case: Case, bones: PlannedBones, known: Iterable[Finding]) -> list[Finding]:
    """What is to be found about the sizes of the motions now that every segment has its surface.

    The doctor has no surface of bone that is still to be segmented. Raises what it would have
    raised: a bone that is torn away.
    """
    seen = {(finding.code, finding.where) for finding in known}
    surfaces = {segment.name: segment.surface for segment in bones.segments}
    found: list[Finding] = []
    for name, motion in bones.motions.items():
        if isinstance(motion, MovedSurface):
            continue
        given = case.plan.get(name)
        sized = SizedMotion(
            name,
            motion,
            case.where("plan" if case.achieved else f"plan.{name}"),
            points=np.asarray(surfaces[name].vertices),
            typed=given is not None and given.typed,
            has_centre=given is not None and given.centre is not None,
        )
        # A measured motion may be as small as it likes.
        found += [
            finding
            for finding in check_motion_size(sized)
            if (finding.code, finding.where) not in seen
            and not (case.achieved and finding.code.startswith("plan-tiny"))
        ]
    if case.surfaces is None and (errors := [f for f in found if f.severity == "error"]):
        raise CaseInputError(f"{errors[0].where}: {errors[0].what}; {errors[0].mend}")
    return found


def _untouched(
    case: Case, mesh: TetMesh, kinds: NodeKinds, bones: PlannedBones
) -> tuple[Finding, ...]:
    """A finding for each moved segment that lies beyond the mesh and holds none of its nodes.

    Raises
    ------
    CaseError
        (also `ValueError`) A moved segment that holds no node and is named in the case, or lies at
        the mesh: the face would not follow it.
    """
    findings = []
    segments = {segment.name: segment for segment in bones.segments}
    nodes = np.asarray(mesh.nodes)
    low, high = nodes.min(axis=0), nodes.max(axis=0)
    for name, motion in bones.motions.items():
        if len(kinds.nodes("joined", name)) or len(kinds.nodes("sliding", name)):
            continue
        if not isinstance(motion, MovedSurface) and np.array_equal(motion, np.eye(4)):
            continue
        vertices = np.asarray(segments[name].surface.vertices)
        beside = ((vertices > low) & (vertices < high)).all(axis=1).any()
        what = (
            f"segment {name!r} moves, but no node of the tissue is joined to it or slides on it "
            "(segment-touches-no-tissue)"
        )
        where = case.where(f"plan.{name}")
        mend = "check the cut that makes it, bone_distance in [node_kinds], and the posterior plane"
        if name in case.plan or name in _cut_segments(case) or beside:
            raise CaseInputError(f"{where}: {what}: the face would not follow it; {mend}")
        findings.append(
            Finding(
                "warning",
                "segment-touches-no-tissue",
                f"{what}; it lies beyond the meshed tissue, and the case does not name it",
                where,
                "its motion does not reach the face",
                "if it belongs to the face, widen [region]",
            )
        )
    return tuple(findings)


def _kind_options(case: Case) -> KindOptions:
    """The options of [node_kinds], or an error that names their line."""
    try:
        return kind_options(case.node_kinds)
    except CaseInputError as error:
        raise CaseInputError(f"{case.where('node_kinds')}: {error}") from error


def _scene(
    case: Case,
    mesh: TetMesh,
    kinds: NodeKinds,
    bones: PlannedBones,
    contacts: Mapping[str, SurfaceData],
    lips: CaseLipContact,
) -> Scene:
    data = segment_data(kinds, bones.segments, contacts=contacts)
    # Teeth that no node is attached to or slides on may still be before the lips.
    data |= {o.segment: SegmentData() for o in lips.obstacles if o.segment not in data}
    plan = {name: bones.motions.get(name, np.eye(4)) for name in data}
    return Scene(
        nodes=mesh.nodes,
        tets=mesh.tets,
        tissue=case.tissue,
        segments=data,
        plan=plan,
        fixed=kinds.nodes("fixed"),
        options=case.solver,
        touching=lips.touching,
        obstacles=lips.obstacles,
    )


def _summary(
    case: Case,
    kinds: NodeKinds,
    report: MeshReport,
    anatomy: Anatomy,
    findings: list[Finding],
    seconds: Mapping[str, float],
    procedures: tuple[Procedure, ...],
) -> dict[str, Any]:
    grid, inputs = anatomy.skin, input_hashes(case)
    return {
        "case": case.name,
        "note": case.note,
        "nodes": {name: len(kinds.nodes(name)) for name in NODE_KINDS},
        "segments": {
            name: {kind: len(kinds.nodes(kind, name)) for kind in ("joined", "sliding")}
            for name in kinds.segments
        },
        "mesh": report.as_dict(),
        "grid": {
            "shape": list(grid.values.shape),
            "spacing": np.asarray(grid.spacing).tolist(),
            "origin": grid.lowest.tolist(),
        },
        "bones": list(anatomy.bones),
        "osteotomies": [
            {"procedure": placed.kind, "options": dict(placed.options)} for placed in procedures
        ],
        "findings": [asdict(finding) for finding in findings],
        "timings": dict(seconds),
        "inputs": inputs,
        "inputs_key": case_key(case, inputs),
        "versions": {
            "cmfsim": __version__,
            "numpy": np.__version__,
            "python": platform.python_version(),
        },
    }
