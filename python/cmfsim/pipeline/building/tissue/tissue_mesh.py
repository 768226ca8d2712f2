"""The soft tissue of a case as tets: where it ends behind, below and above, and its mesh."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim._core import TetMesh
from cmfsim.io import Case, read_surface, read_tet_mesh
from cmfsim.meshing import (
    MeshOptions,
    TissueRegion,
    mesh_findings,
    mesh_from_level,
    mesh_report,
    part_mesh,
    report_of_part,
)
from cmfsim.meshing.lips import LipSeam
from cmfsim.pipeline.building.tissue.refinement import (
    GAP_REFINEMENTS,
    allowed_halvings,
    lip_halvings,
    needed_halvings,
)
from cmfsim.values.anatomy import Anatomy
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding
from cmfsim.values.image_data import ImageData
from cmfsim.values.mesh_report import MeshReport

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

    It is refined along a seam between the lips, and not separated there: that follows when the
    kinds of its nodes are known.
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
    if case.mesh.parting is None or seam is not None:
        return made.mesh, made.report, made.findings
    units: str = "mm"
    frame: str | None = None
    if case.surfaces is not None:
        units, frame = case.surfaces.units, case.surfaces.frame
    parted = part_mesh(made.mesh, read_surface(case.mesh.parting, units=units, frame=frame))
    report = report_of_part(parted, made.report)
    return parted, report, mesh_findings(report)
