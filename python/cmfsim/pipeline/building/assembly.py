"""Puts the patient's model together: scene, skin and the summary of the build."""

import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np

from cmfsim._core import __version__
from cmfsim.bones import Procedure
from cmfsim.io import Case
from cmfsim.meshing.lips import seam_faces
from cmfsim.meshing.node_kinds import segment_data
from cmfsim.pipeline.building.inputs import case_key, input_hashes
from cmfsim.pipeline.building.parts import Head, Nodes
from cmfsim.pipeline.building.sites.landmarks import landmark_summary
from cmfsim.pipeline.building.skin.lips import lip_summary
from cmfsim.pipeline.building.skin.skin_part import on_skin
from cmfsim.pipeline.building.stages import Stages
from cmfsim.pipeline.building.surgery.motions import PlannedBones
from cmfsim.surfaces.levels import detailed_surface
from cmfsim.values.node_kinds import NODE_KINDS
from cmfsim.values.patient_model import PatientModel
from cmfsim.values.scene import Scene, SegmentData
from cmfsim.values.surface_data import SurfaceData


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
            **(
                {"plan_fits": {name: fit.as_dict() for name, fit in bones.fits.items()}}
                if bones.fits
                else {}
            ),
            "plan_sources": dict(bones.sources),
        },
        detailed_skin=partial(_detailed_skin, head),
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
