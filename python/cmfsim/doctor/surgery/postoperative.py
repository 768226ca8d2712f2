"""Whether what is given after the operation belongs together."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from cmfsim._core import Surface
from cmfsim.doctor.evidence import Evidence
from cmfsim.doctor.sites.placement import LANDMARK_WARNING
from cmfsim.errors import CmfsimError
from cmfsim.io import Case, read_landmark_file, read_surface
from cmfsim.values.finding import Finding
from cmfsim.values.surface_data import SurfaceData

# Vertices of two files that lie within this of each other are the same, mm: rounding in a file.
SAME = 1e-3


def check_after(evidence: Evidence) -> Iterator[Finding]:
    """A face after the operation that is the one before, or whose landmarks lie elsewhere."""
    given = evidence.case.postoperative
    # A file that is missing is reported where files are looked for.
    if given is None or given.skin is None or not given.skin.is_file():
        return
    try:
        skin = read_surface(given.skin, units=given.units, frame=given.frame)
    except CmfsimError as error:
        yield _unreadable(evidence.case.where("postoperative.skin"), error)
        return
    yield from _check_changed(evidence, skin, severity="warning" if given.verified else "error")
    if given.landmarks is not None and given.landmarks.is_file():
        yield from _check_landmarks(evidence.case, given.landmarks, skin)


def _unreadable(where: str, error: CmfsimError) -> Finding:
    return Finding(
        "input-unreadable",
        str(error),
        where=where,
        why="the prediction cannot be compared with the face after the operation",
    )


def _check_changed(evidence: Evidence, after: SurfaceData, *, severity: str) -> Iterator[Finding]:
    """Whether the face after is the surface before, though the plan moves bone."""
    case = evidence.case
    still = all(np.array_equal(matrix, np.eye(4)) for matrix in evidence.motions.values())
    before = evidence.skin
    if before is None or (still and not evidence.moved and not case.achieved):
        return
    here, there = before.surface.vertices, after.vertices
    if here.shape != there.shape or np.abs(here - there).max(initial=0.0) > SAME:
        return
    yield Finding(
        "postoperative-unchanged",
        "the face after the operation is the face before, vertex by vertex",
        severity=severity,
        where=case.where("postoperative.skin"),
    )


def _check_landmarks(case: Case, file: Path, skin: SurfaceData) -> Iterator[Finding]:
    """Landmarks after the operation that do not lie on the skin after it."""
    where = case.where("postoperative.landmarks")
    try:
        places = read_landmark_file(file, frame=case.landmarks.frame).points
        closest, _, _ = Surface(skin.vertices, skin.triangles).closest([*places.values()])
    except CmfsimError as error:
        yield _unreadable(where, error)
        return
    away = np.linalg.norm(closest - np.array([*places.values()]), axis=1)
    far = [n for n, d in zip(places, away, strict=True) if d > LANDMARK_WARNING]
    if far:
        more = ", …" if len(far) > 4 else ""
        yield Finding(
            "landmarks-off",
            f"{len(far)} of {len(away)} landmarks lie more than {LANDMARK_WARNING:g} mm from the "
            f"skin after the operation, {away.max():.1f} mm at most: {', '.join(far[:4])}{more}",
            severity="warning",
            where=where,
            why="these landmarks decide which points are compared, so their errors would count "
            "as errors of the prediction",
            fix="place them on the post-operative skin, not on the pre-operative one",
        )
