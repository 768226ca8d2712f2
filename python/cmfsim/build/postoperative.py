"""The skin after the operation, brought into the frame of the data before it."""

import logging
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cmfsim.case import Finding
from cmfsim.checks import Floats
from cmfsim.errors import CaseInputError
from cmfsim.imaging import SegmentOptions, register_volumes, segment_head, undeformed_mask
from cmfsim.io import Case, read_landmark_file, read_surface
from cmfsim.io.images import read_image_file
from cmfsim.osteotomy import surface_of_level
from cmfsim.patient import CasePostoperative
from cmfsim.scene import SurfaceData
from cmfsim.surface_repair import RepairOptions, repair_surface

__all__ = ["Postoperative", "read_postoperative"]

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Postoperative:
    """The face after the operation.

    Attributes
    ----------
    skin : SurfaceData
        In the frame of the data before the operation.
    landmarks : dict of str to (3,) float64, mm
        Of the skin; empty where none are given.
    findings : tuple of Finding
    """

    skin: SurfaceData
    landmarks: dict[str, Floats]
    findings: tuple[Finding, ...] = ()


def read_postoperative(case: Case) -> Postoperative:
    """The face after the operation, as the case has it.

    A scan that is not aligned yet is laid on the one before by the skull above the jaws.

    Raises
    ------
    CaseError
        (also `ValueError`) The case has no [postoperative], or surfaces that are not aligned.
    RegistrationError
        The scans do not fit each other.
    """
    given = case.postoperative
    if given is None:
        raise CaseInputError(
            f"{case.file.name}: there is nothing to compare with: add [postoperative] skin or image"
        )
    findings: list[Finding] = []
    landmarks: dict[str, Floats] = {}
    if given.landmarks is not None:
        found = read_landmark_file(given.landmarks, frame=case.landmarks.frame)
        landmarks, findings = dict(found.points), [*found.findings]
    if given.skin is not None:
        if not given.aligned:
            raise CaseInputError(
                f"{case.where('postoperative.aligned')}: a surface is not aligned here, only an "
                "image is: give the CT after the operation as image, or align the surface first"
            )
        surface = read_surface(given.skin, units=given.units, frame=given.frame)
        # Inside out would turn every sign.
        mended, noticed = repair_surface(surface, "skin", RepairOptions(close_borders=False))
        return Postoperative(mended, landmarks, (*findings, *noticed))
    skin, matrix, noticed = _scanned(case, given)
    moved = {n: matrix[:3, :3] @ place + matrix[:3, 3] for n, place in landmarks.items()}
    return Postoperative(skin, moved, (*findings, *noticed))


def _scanned(
    case: Case, given: CasePostoperative
) -> tuple[SurfaceData, Floats, tuple[Finding, ...]]:
    """Skin from a CT after the operation, and the motion that laid it on the one before."""
    read = read_image_file(Path(str(given.image)))
    head = segment_head(read.image, SegmentOptions())
    skin = surface_of_level("skin", head.skin)
    if given.aligned:
        return skin, np.eye(4), (*read.findings, *head.findings)
    if case.image is None or case.landmarks.skull is None:
        raise CaseInputError(
            f"{case.where('postoperative.image')}: aligning it needs the CT before the operation "
            "([image]) and skull landmarks"
        )
    before = read_image_file(case.image.file).image
    skull = read_landmark_file(case.landmarks.skull, frame=case.landmarks.frame).points
    matrix = register_volumes(read.image, before, mask=undeformed_mask(before, skull)).matrix
    _log.info("postoperative scan moved by %.2f mm", float(np.linalg.norm(matrix[:3, 3])))
    vertices = np.asarray(skin.vertices) @ matrix[:3, :3].T + matrix[:3, 3]
    return replace(skin, vertices=vertices), matrix, (*read.findings, *head.findings)
