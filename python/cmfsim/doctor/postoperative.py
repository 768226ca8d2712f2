"""Whether what is given after the operation belongs together."""

from collections.abc import Iterator

import numpy as np

from cmfsim._core import Surface
from cmfsim.doctor.evidence import Evidence
from cmfsim.doctor.placement import LANDMARK_WARNING
from cmfsim.errors import CmfsimError
from cmfsim.io import read_landmark_file, read_surface
from cmfsim.values.finding import Finding

__all__ = ["check_after"]


def check_after(evidence: Evidence) -> Iterator[Finding]:
    """Landmarks after the operation that do not lie on the skin after it."""
    case = evidence.case
    given = case.postoperative
    if given is None or given.skin is None or given.landmarks is None:
        return
    if not (given.skin.is_file() and given.landmarks.is_file()):
        # Said where files are looked for.
        return
    where = case.where("postoperative.landmarks")
    try:
        skin = read_surface(given.skin, units=given.units, frame=given.frame)
        places = read_landmark_file(given.landmarks, frame=case.landmarks.frame).points
        closest, _, _ = Surface(skin.vertices, skin.triangles).closest([*places.values()])
    except CmfsimError as error:
        yield Finding.error(
            "postoperative-unreadable",
            str(error),
            where=where,
            why="the prediction cannot be compared with the face after the operation",
            fix="repair or replace the file",
        )
        return
    away = np.linalg.norm(closest - np.array([*places.values()]), axis=1)
    far = [n for n, d in zip(places, away, strict=True) if d > LANDMARK_WARNING]
    if far:
        more = ", …" if len(far) > 4 else ""
        yield Finding.warning(
            "postoperative-landmarks-off",
            f"{len(far)} of {len(away)} landmarks lie more than {LANDMARK_WARNING:g} mm from the "
            f"skin after the operation, {away.max():.1f} mm at most: {', '.join(far[:4])}{more}",
            where=where,
            why="these landmarks decide which points are compared, so their errors would count "
            "as errors of the prediction",
            fix="place them on the post-operative skin, not on the pre-operative one",
        )
