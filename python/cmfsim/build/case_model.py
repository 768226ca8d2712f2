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
from numpy.typing import ArrayLike, NDArray

from cmfsim._core import TetMesh, __version__
from cmfsim.build.clefts import without_clefts
from cmfsim.build.held import held_part
from cmfsim.build.inputs import (
    check_output,
    input_hashes,
    read_anatomy,
    read_case_landmarks,
)
from cmfsim.build.motions import planned_bones
from cmfsim.build.postoperative import Postoperative
from cmfsim.build.refinement import GAP_REFINEMENTS, allowed_halvings, needed_halvings
from cmfsim.build.skin_part import on_skin
from cmfsim.case import NODE_KINDS, Anatomy, BoneSegment, Finding, ImageData, NodeKinds
from cmfsim.checks import Floats
from cmfsim.doctor import diagnose
from cmfsim.errors import CaseInputError, CmfsimError
from cmfsim.io import Case, read_surface, read_tet_mesh, write_model
from cmfsim.meshing import (
    MeshOptions,
    MeshReport,
    TissueRegion,
    mesh_findings,
    mesh_from_level,
    mesh_report,
    part_mesh,
    report_of_part,
    tissue_level,
)
from cmfsim.model import PatientModel
from cmfsim.node_kinds import KindOptions, classify_nodes, segment_data
from cmfsim.osteotomy import (
    CuttingPlane,
    Procedure,
    contact_surface,
    cut_bones,
    free_cut,
    place_procedure,
)
from cmfsim.pictures import picture_anatomy, picture_node_kinds
from cmfsim.scene import MovedSurface, Scene

__all__ = ["build_case", "build_model"]

_log = logging.getLogger(__name__)

Progress = Callable[[str], None]

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


def build_case(
    case: Case,
    *,
    progress: Progress | None = None,
    check: bool = True,
    findings: Iterable[Finding] = (),
) -> PatientModel:
    """The model of a case, written to its output folder.

    Parameters
    ----------
    case : Case
    progress : callable, optional
        Called with the name of each stage as it begins.
    check : bool
        Whether the doctor looks at the case first; an error that it finds ends the work.
    findings : iterable of Finding
        What is known of the case already; the model keeps it.

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
    check_output(case)
    model = build_model(case, progress=progress, check=check, findings=findings)
    stage = progress or _quiet
    stage("writing the model")
    begun = time.perf_counter()
    names = write_model(case.output, model, partial(_draw, model))
    timings = {**model.summary["timings"], "writing the model": time.perf_counter() - begun}
    more = {"timings": timings, "output": str(case.output), "files": names}
    return replace(model, summary={**model.summary, **more})


def build_model(
    case: Case,
    *,
    progress: Progress | None = None,
    check: bool = True,
    findings: Iterable[Finding] = (),
    anatomy: Anatomy | None = None,
    after: Postoperative | None = None,
) -> PatientModel:
    """The model of a case: read, segmented, cut, meshed and classified; nothing is written.

    Parameters
    ----------
    case : Case
    progress : callable, optional
    check : bool
    findings : iterable of Finding
        As for `build_case`.
    anatomy : Anatomy, optional
        The head, where it is known; the image or surfaces of the case are then not read.
    after : Postoperative, optional
        What `read_postoperative` gives, where it is known already; an achieved plan is read off it.

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
    stages = _Stages(progress or _quiet)
    findings = [*findings]
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
    moved = [*dict.fromkeys([*_cut_segments(case), *bones.motions])]

    stages.begin("finding the soft tissue")
    region = _region(case, anatomy, skull)
    level, noticed = tissue_level(anatomy, region)
    findings += noticed

    stages.begin("filling the tissue with tets")
    mesh, report, noticed = _mesh(case, level, anatomy)
    findings += noticed
    _log.info("mesh: %d nodes, %d tets", mesh.n_nodes, mesh.n_tets)

    stages.begin("classifying nodes")
    classified = classify_nodes(
        mesh.nodes,
        mesh.boundary_triangles(),
        anatomy,
        bones.segments,
        moved=moved,
        landmarks=skull,
        fixed_planes=_planes(region),
        options=KindOptions(**case.node_kinds),
    )
    findings += classified.findings
    kinds, whole = classified.kinds, mesh.n_tets
    if case.mesh.file is None:
        mesh, kinds, noticed = without_clefts(mesh, kinds, bones.segments, moved, case.mesh.cleft)
        findings += noticed
    mesh, kinds, noticed = held_part(mesh, kinds)
    findings += noticed
    if mesh.n_tets < whole:
        report = report_of_part(mesh, report)
    findings += _untouched(case, kinds, bones.motions)
    findings = [*dict.fromkeys(findings)]

    stages.begin("assembling the scene")
    scene = _scene(case, mesh, kinds, bones.segments, bones.motions)
    boundary = np.asarray(mesh.boundary_triangles())
    skin = boundary[on_skin(np.asarray(mesh.nodes), boundary, anatomy, level)]
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
        findings=tuple(findings),
        summary={
            **_summary(case, kinds, report, anatomy, findings, stages.seconds, cut.procedures),
            **({} if bones.achieved is None else {"achieved": bones.achieved.as_dict()}),
        },
    )
    if case.muscles is None:
        return patient
    stages.begin("placing and sampling the muscles")
    # A case without muscles loads nothing of them.
    from cmfsim.build.muscles import with_muscles  # noqa: PLC0415

    return with_muscles(patient, case.muscles, mesh=mesh)


def _draw(model: PatientModel, folder: Path) -> list[str]:
    """The names of the pictures drawn into a folder: none without PyVista or OpenGL."""
    anatomy, kinds = folder / "anatomy.png", folder / "node_kinds.png"
    try:
        picture_anatomy(anatomy, model.skin, model.segments)
        picture_node_kinds(kinds, model.scene.nodes, model.boundary_triangles, model.kinds)
    except CmfsimError as error:
        _log.warning("no pictures: %s", error)
    return [path.name for path in (anatomy, kinds) if path.exists()]


class _Stages:
    """The stages as they pass, with the seconds that each took."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
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


def _region(case: Case, anatomy: Anatomy, landmarks: Mapping[str, Floats]) -> TissueRegion:
    """The region of the case; where the head was cut off below or above, tissue ends on a plane."""
    inside = np.asarray(anatomy.skin.values) > 0.0
    lowest, spacing = anatomy.skin.lowest, np.asarray(anatomy.skin.spacing)
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


def _planes(region: TissueRegion) -> dict[str, tuple[ArrayLike, ArrayLike]]:
    planes: dict[str, tuple[ArrayLike, ArrayLike]] = {"posterior": (region.point, region.normal)}
    for name, side in (("lower", -1.0), ("upper", 1.0)):
        height = getattr(region, name)
        if height is not None:
            planes[name] = ((0.0, 0.0, height), (0.0, 0.0, side))
    return planes


def _mesh(
    case: Case, level: ImageData, anatomy: Anatomy
) -> tuple[TetMesh, MeshReport, tuple[Finding, ...]]:
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
    made = mesh_from_level(level, options, allowed=allowed, needed=needed)
    if case.mesh.parting is None:
        return made.mesh, made.report, made.findings
    units, frame = ("mm", "LPS")
    if case.surfaces is not None:
        units, frame = case.surfaces.units, case.surfaces.frame
    parted = part_mesh(made.mesh, read_surface(case.mesh.parting, units=units, frame=frame))
    # A crack parts tets and changes none: what was said of the whole holds.
    return parted, replace(made.report, n_nodes=parted.n_nodes), made.findings


def _untouched(case: Case, kinds: NodeKinds, motions: Iterable[str]) -> list[Finding]:
    return [
        Finding(
            "warning",
            "segment-touches-no-tissue",
            f"segment {name!r} moves, but no node of the tissue is joined to it",
            case.where(f"plan.{name}"),
            "its motion does not reach the face",
            "check the cut that makes it, bone_distance in [node_kinds], and the posterior plane",
        )
        for name in motions
        if not len(kinds.nodes("joined", name)) and not len(kinds.nodes("sliding", name))
    ]


def _scene(
    case: Case,
    mesh: TetMesh,
    kinds: NodeKinds,
    segments: tuple[BoneSegment, ...],
    motions: Mapping[str, Floats | MovedSurface],
) -> Scene:
    contacts = {
        segment.name: contact_surface(segment)
        for segment in segments
        if len(kinds.nodes("sliding", segment.name))
    }
    data = segment_data(kinds, segments, contacts=contacts)
    plan = {name: motions.get(name, np.eye(4)) for name in data}
    return Scene(
        nodes=mesh.nodes,
        tets=mesh.tets,
        tissue=case.tissue,
        segments=data,
        plan=plan,
        fixed=kinds.nodes("fixed"),
        options=case.solver,
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
    grid = anatomy.skin
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
        "inputs": input_hashes(case),
        "versions": {
            "cmfsim": __version__,
            "numpy": np.__version__,
            "python": platform.python_version(),
        },
    }
