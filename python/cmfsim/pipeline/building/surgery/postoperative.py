"""Post-operative data, registered to the frame of the pre-operative data."""

import logging
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from cmfsim._core import rigid_fit
from cmfsim.errors import CaseInputError, RegistrationError
from cmfsim.io import Case, read_landmark_file, read_surface
from cmfsim.io.images.dicom_series import study_date
from cmfsim.io.images.image_files import read_image_file
from cmfsim.pipeline.building.inputs import read_case_landmarks, refuse_errors, segment_options
from cmfsim.surfaces.levels import surface_of_level
from cmfsim.surfaces.repair import RepairOptions, repair_surface
from cmfsim.values.case_parts import CasePostoperative
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding
from cmfsim.values.image_data import ImageData
from cmfsim.values.motion import carried
from cmfsim.values.surface_data import SurfaceData

_log = logging.getLogger(__name__)

# Bones that jaw surgery does not change, by which scans are registered.
REFERENCES = ("cranium", "skull")
# Share of a skull's vertices that have no say in laying it on the one after: jaw, plates, cuts.
TRIM = 0.3
# A skull that is further than this from the one after, mm rms, is not registered to it.
LARGEST_RMS = 1.5
MOST_STEPS = 300


@dataclass(frozen=True, eq=False)
class Postoperative:
    """Face and bones after the operation, in the frame of the data before.

    landmarks: dict of str to (3,), mm, of the skin; empty where none are given.
    bones: By bone or segment; of an image "bone" alone, which is all of it.
    alignment: (4, 4), mm. What took the frame after the operation to that before it.
    """

    skin: SurfaceData | None
    landmarks: dict[str, Floats]
    bones: Mapping[str, SurfaceData] = field(default_factory=dict)
    alignment: Floats = field(default_factory=lambda: np.eye(4))
    findings: tuple[Finding, ...] = ()


def read_postoperative(case: Case) -> Postoperative:
    """Face and bones after the operation, registered if need be by the skull above the jaws.

    Raises `CaseError`: The case has no [postoperative], or nothing to align by.
    Raises `RegistrationError`: The scans do not fit each other.
    """
    given = case.postoperative
    if given is None:
        raise CaseInputError(
            f"{case.file.name}: the case has nothing to compare with: add [postoperative] skin "
            "or image"
        )
    findings: list[Finding] = []
    landmarks: dict[str, Floats] = {}
    if given.landmarks is not None:
        found = read_landmark_file(given.landmarks, frame=case.landmarks.frame)
        landmarks, findings = dict(found.points), [*found.findings]
    read = _surfaces(case, given) if given.image is None else _scanned(case, given)
    matrix = read.alignment
    moved = {n: matrix[:3, :3] @ place + matrix[:3, 3] for n, place in landmarks.items()}
    return replace(read, landmarks=moved, findings=(*findings, *read.findings))


def _surfaces(case: Case, given: CasePostoperative) -> Postoperative:
    """Skin and bones from surfaces."""
    bones = {
        name: read_surface(path, units=given.units, frame=given.frame)
        for name, path in given.bones.items()
    }
    matrix = np.eye(4) if given.aligned else _laid_on(case, bones)
    skin: SurfaceData | None = None
    noticed: tuple[Finding, ...] = ()
    if given.skin is not None:
        surface = read_surface(given.skin, units=given.units, frame=given.frame)
        # Inside out would turn every sign.
        skin, noticed = repair_surface(
            surface, "skin", RepairOptions(close_borders=False, outer_wall=True)
        )
        skin = _carried(skin, matrix)
    return Postoperative(
        skin, {}, {n: _carried(s, matrix) for n, s in bones.items()}, matrix, noticed
    )


def _laid_on(case: Case, bones: Mapping[str, SurfaceData]) -> Floats:
    """The motion that lays the skull after the operation on the one before."""
    before = {} if case.surfaces is None else case.surfaces.bones
    name = next((n for n in REFERENCES if n in bones and n in before), None)
    if name is None or case.surfaces is None:
        raise CaseInputError(
            f"{case.where('postoperative.aligned')}: surfaces are aligned on the skull: list it "
            f"({' or '.join(REFERENCES)}) in [surfaces.bones] and in [postoperative.bones], or "
            "align them first and write aligned = true"
        )
    still = read_surface(before[name], units=case.surfaces.units, frame=case.surfaces.frame)
    after = bones[name]
    here, there = still.vertices, after.vertices
    if still.has_triangles_of(after):
        return _trimmed_fit(there, here)
    start = np.eye(4)
    start[:3, 3] = here.mean(axis=0) - there.mean(axis=0)
    from cmfsim.registration import icp  # noqa: PLC0415

    fit = icp(after, still, initial=start, trim=TRIM, max_iterations=MOST_STEPS)
    if fit.rms > LARGEST_RMS:
        raise RegistrationError(
            f"{name} after the operation is {fit.rms:.1f} mm rms from that before it at the best "
            f"fit (allowed {LARGEST_RMS:g} mm): align the surfaces yourself by the skull above "
            "the jaws, and write aligned = true"
        )
    _log.info("%s after the operation aligned with the one before: %.2f mm rms", name, fit.rms)
    return fit.matrix


def _trimmed_fit(moving: Floats, fixed: Floats) -> Floats:
    """The rigid motion of most vertices onto their counterparts, ignoring the others."""
    kept = np.ones(len(moving), dtype=bool)
    for _ in range(MOST_STEPS):
        fit = rigid_fit(moving[kept], fixed[kept])
        matrix = fit.matrix
        left = np.linalg.norm(carried(matrix, moving) - fixed, axis=1)
        nearest = left <= np.quantile(left, 1.0 - TRIM)
        if np.array_equal(nearest, kept):
            break
        kept = nearest
    return matrix


def _scanned(case: Case, given: CasePostoperative) -> Postoperative:
    """Skin and bone from a CT after the operation."""
    _check_dates(case, given)
    read = read_image_file(Path(str(given.image)), series=given.series)
    skull = read_case_landmarks(case)[0].get("skull", {})
    matrix = np.eye(4) if given.aligned else _registered(case, read.image, skull)
    # The jaws have moved since, but not so far that a flood from their landmarks would miss them.
    back = np.linalg.inv(matrix)
    there = {name: back[:3, :3] @ place + back[:3, 3] for name, place in skull.items()}
    from cmfsim.imaging import segment_head  # noqa: PLC0415

    head = segment_head(read.image, segment_options(case), landmarks=there or None)
    refuse_errors(head, case.where("postoperative.image"))
    levels = list(head.bones.values())
    bone = levels[0].with_values(np.maximum.reduce([b.values for b in levels]))
    return Postoperative(
        _carried(surface_of_level("skin", head.skin), matrix),
        {},
        {"bone": _carried(surface_of_level("bone", bone), matrix)},
        matrix,
        (*read.findings, *head.findings),
    )


def _check_dates(case: Case, given: CasePostoperative) -> None:
    """Refuses scans whose dates are exchanged, unless the user states that they are right."""
    if case.image is None or given.image is None or given.verified:
        return
    before = study_date(case.image.file, case.image.series)
    after = study_date(given.image, given.series)
    if after < before and all(re.fullmatch(r"\d{8}", date) for date in (before, after)):
        raise CaseInputError(
            f"{case.where('postoperative.image')}: the scan after the operation is of {after} "
            f"(YYYYMMDD), the one before it, [image], of {before}: exchange them, or write "
            "verified = true here if the dates are wrong"
        )


def _registered(case: Case, after: ImageData, skull: Mapping[str, Floats]) -> Floats:
    if case.image is None or not skull:
        raise CaseInputError(
            f"{case.where('postoperative.image')}: aligning it needs the CT before the operation "
            "([image]) and skull landmarks"
        )
    before = read_image_file(case.image.file, series=case.image.series).image
    from cmfsim.imaging import register_volumes, undeformed_mask  # noqa: PLC0415

    matrix = register_volumes(after, before, mask=undeformed_mask(before, skull)).matrix
    _log.info("postoperative scan moved by %.2f mm", float(np.linalg.norm(matrix[:3, 3])))
    return matrix


def _carried(surface: SurfaceData, matrix: Floats) -> SurfaceData:
    return replace(surface, vertices=carried(matrix, surface.vertices))
