"""Crowns of intraoral scans in place of those of a CT, which metal and voxels blur."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from cmfsim.errors import CaseInputError, third_party
from cmfsim.io import read_surface
from cmfsim.meshing.levels import signed_level
from cmfsim.pipeline.building.case_checks import Head
from cmfsim.pipeline.building.stages import Stages
from cmfsim.planning.occlusion.final_bite import fitted_scan
from cmfsim.planning.occlusion.rows import ToothRow, tooth_rows
from cmfsim.surfaces.levels import SurfaceOptions, surface_of_level
from cmfsim.values.anatomy import BoneSegment
from cmfsim.values.case_parts import CaseBite
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding
from cmfsim.values.image_data import ImageData
from cmfsim.values.motion import carried
from cmfsim.values.surface_data import SurfaceData

# What the image shows as bone is replaced up to this far from the crowns of a scan, mm: a ramus
# begins some 5 mm beside the last molar.
REACH = 3.0
# Triangles that are enough to tell which bone bears a row.
BEARING = 20_000


def with_scanned_teeth(head: Head, scans: CaseBite, stages: Stages) -> Head:
    """The head with the crowns of its scans, registered to its rows, or a `CaseError`."""
    stages.begin("registering the scans of the teeth")
    anatomy = head.anatomy
    segments = [
        BoneSegment(n, level, surface_of_level(n, level, SurfaceOptions(max_triangles=BEARING)))
        for n, level in anatomy.bones.items()
    ]
    given = [read_surface(scans.upper), read_surface(scans.lower)]
    up = given[0].vertices.mean(axis=0) - given[1].vertices.mean(axis=0)
    levels = dict(anatomy.bones)
    try:
        rows = tooth_rows(anatomy, segments, head.skull, stages.findings)
        for row, scan, out in zip(rows, given, (up, -up), strict=True):
            fit, as_well = fitted_scan(row, scan, out)
            stages.add(_noticed(row.arch.jaw, fit.rms, as_well=as_well))
            back = np.asarray(np.linalg.inv(fit.matrix), dtype=np.float64)
            placed = SurfaceData(carried(back, scan.vertices), scan.triangles)
            own = ToothRow(row.segment, placed, row.arch)
            levels[row.segment] = _with_crowns(levels[row.segment], own, anatomy.skin)
    except CaseInputError as error:
        raise CaseInputError(f"{head.case.where('image.teeth')}: {error}") from error
    kept = {n: s for n, s in anatomy.surfaces.items() if levels.get(n) is anatomy.bones.get(n)}
    return replace(head, anatomy=replace(anatomy, bones=levels, surfaces=kept))


def _noticed(jaw: str, error: float, *, as_well: bool) -> Iterator[Finding]:
    yield Finding(
        "teeth-of-scan", f"the {jaw} crowns are those of the scan, which fits to {error:.2f} mm"
    )
    if as_well:
        what = f"the mirror image of the {jaw} scan fits the teeth as well"
        yield Finding("bite-scan-symmetric", what)


def _with_crowns(level: ImageData, row: ToothRow, skin: ImageData) -> ImageData:
    """The level of a bone with a scan's crowns; where its gum is nearest, the image stays."""
    spatial = third_party("scipy.spatial", "crowns are replaced", "imaging")
    vertices, step = row.surface.vertices, level.spacing
    low, high = (
        np.clip((end - level.lowest) / step, 0, np.array(level.values.shape)).astype(int)
        for end in _box(vertices[row.crowns], REACH + step)
    )
    box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    part = ImageData(level.values[box], step, level.lowest + low * step)
    crowns = signed_level(row.surface, part).values
    places = np.stack(np.broadcast_arrays(*part.axes()), axis=-1).reshape(-1, 3)
    away, nearest = spatial.cKDTree(vertices).query(places)
    taken = (row.crowns[nearest] & (away <= REACH)).reshape(crowns.shape)
    values = np.array(level.values)
    values[box] = np.where(taken, np.minimum(crowns, skin.values[box]), values[box])
    return level.with_values(values)


def _box(points: Floats, margin: Floats) -> tuple[Floats, Floats]:
    return points.min(axis=0) - margin, points.max(axis=0) + margin
