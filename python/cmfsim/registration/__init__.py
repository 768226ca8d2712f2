"""Registration: landmarks matched by name and judged, folds of a warp, iterative closest points.

The splines and fits themselves are `cmfsim.ThinPlateSpline` and `cmfsim.rigid_fit` of the core.
"""

from cmfsim.registration.closest import icp
from cmfsim.registration.consistency import (
    LandmarkAgreement,
    common_shift,
    leave_one_out,
    mirror_agreement,
    swapped_names,
)
from cmfsim.registration.folds import FoldReport, fold_report
from cmfsim.registration.landmarks import LandmarkMatch, match_landmarks, side_vectors, wrong_sides

__all__ = [
    "FoldReport",
    "LandmarkAgreement",
    "LandmarkMatch",
    "common_shift",
    "fold_report",
    "icp",
    "leave_one_out",
    "match_landmarks",
    "mirror_agreement",
    "side_vectors",
    "swapped_names",
    "wrong_sides",
]
