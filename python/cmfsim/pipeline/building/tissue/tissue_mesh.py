"""The soft tissue of a case as tets: where it ends behind, below and above, and is refined."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim._core import Surface, TetMesh, distance_image
from cmfsim.io import Case, read_surface, read_tet_mesh
from cmfsim.meshing import (
    MeshOptions,
    TissueRegion,
    mesh_findings,
    mesh_from_level,
    mesh_report,
    near_skin,
    part_mesh,
    report_of_part,
)
from cmfsim.meshing.lips import LipSeam
from cmfsim.surfaces.levels import block_of
from cmfsim.values.anatomy import Anatomy
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding
from cmfsim.values.image_data import ImageData
from cmfsim.values.mesh_report import MeshReport

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

    level: Of the tissue, on the anatomy's grid.
    Returns: (nx, ny, nz) uint8.
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
    """How often the edge is halved at least along the seam between the lips, where these are thin.

    level: Of the tissue.
    seam: With a surface.
    edge_length: mm.
    Returns: (nx, ny, nz) uint8.
    """
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
    closest, _, _ = Surface(vertices, seam.surface.triangles).closest(points)
    near = index[np.linalg.norm(closest - points, axis=1) <= SEAM_REACH]
    needed[tuple(near.T)] = min(wanted, GAP_REFINEMENTS)
    return needed
