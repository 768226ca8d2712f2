"""The landmarks that a standard procedure is placed from, and estimates of those that are missing.

A site is estimated where the other sites of its jaw put it in an average head; where its partner on
the other side is known, it departs from there as the partner does.
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np

from cmfsim._core import rigid_fit
from cmfsim.errors import LandmarkInputError
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding
from cmfsim.values.landmark_sites import REFERENCE_PLACES, is_lower_site
from cmfsim.values.motion import carried

# The sites of each procedure. Nasion is not among those of Le Fort I: it would only state which
# side of the plane of the upper teeth is up.
NEEDED: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "le_fort_1": ("supradentale", "supra_m2_L", "supra_m2_R"),
        "le_fort_3": (
            "nasion",
            "supradentale",
            *(
                f"{name}_{side}"
                for name in (
                    "supra_m2",
                    "supraorbital",
                    "suborbital",
                    "lateral_orbit",
                    "zygomatic_arch",
                )
                for side in "LR"
            ),
        ),
        "bsso": (
            "infradentale",
            "menton",
            *(f"{name}_{s}" for name in ("sub_m2", "occlusal_line", "gonion") for s in "LR"),
        ),
        "genioplasty": (
            "infradentale",
            "menton",
            *(f"{name}_{s}" for name in ("sub_m2", "occlusal_line") for s in "LR"),
        ),
    }
)
# With these three, every procedure can be placed; the rest is estimated from them.
PLACING: Mapping[str, tuple[str, str, str]] = MappingProxyType(
    {
        "le_fort_1": ("supradentale", "supra_m2_L", "supra_m2_R"),
        "le_fort_3": ("nasion", "supra_m2_L", "supra_m2_R"),
        "bsso": ("infradentale", "gonion_L", "gonion_R"),
        "genioplasty": ("infradentale", "menton", "sub_m2_L"),
    }
)
# Known sites spread at least this far across their longest direction, mm: a line of sites does not
# show how the head is turned about it.
LEAST_SPREAD = 8.0


def with_missing_sites(
    kind: str, landmarks: Mapping[str, Floats]
) -> tuple[dict[str, Floats], tuple[Finding, ...]]:
    """The sites of a procedure, missing ones estimated, and a warning that lists those.

    Errors
    ------
    LandmarkError
        (also `ValueError`) The known sites do not place the others; it names at most three to
        place, which do.
    """
    points = {name: landmarks[name] for name in NEEDED[kind] if name in landmarks}
    missing = [name for name in NEEDED[kind] if name not in points]
    if not missing:
        return points, ()
    is_lower = is_lower_site(NEEDED[kind][0])
    reference = REFERENCE_PLACES["skull"]
    known = [n for n in reference if n in landmarks and is_lower_site(n) == is_lower]
    if not _spread([landmarks[name] for name in known]):
        asked = [name for name in PLACING[kind] if name not in landmarks]
        raise LandmarkInputError(
            f"{kind} needs the landmark {asked[0]!r}"
            + (f" and {len(asked) - 1} more ({', '.join(asked[1:])})" if asked[1:] else "")
            + ": place it, or give the planes of the cut"
        )
    average = np.array([reference[name] for name in known])
    matrix = rigid_fit(average, [landmarks[name] for name in known], scale=True).matrix
    back: Floats = np.linalg.inv(matrix).astype(np.float64)
    for name in missing:
        expected = reference[name]
        partner = {"_L": f"{name[:-2]}_R", "_R": f"{name[:-2]}_L"}.get(name[-2:], "")
        if partner in landmarks:
            own = carried(back, landmarks[partner])
            expected = expected + (own - reference[partner]) * [-1.0, 1.0, 1.0]
        points[name] = carried(matrix, expected)
    return points, (_estimated(kind, missing, len(known)),)


def _estimated(kind: str, missing: Sequence[str], count: int) -> Finding:
    return Finding(
        "cut-site-estimated",
        f"{kind} is placed with {', '.join(missing)} estimated from {count} other landmarks and an "
        "average head",
        where=kind,
    )


def _spread(points: Sequence[Floats]) -> bool:
    """Whether points are three and more, and no line."""
    if len(points) < 3:
        return False
    offsets = np.array(points) - np.mean(points, axis=0)
    return bool(np.linalg.svd(offsets, compute_uv=False)[1] >= LEAST_SPREAD)
