"""Registration: landmarks matched by name and judged, iterative closest points.

The splines and fits themselves are `cmfsim.ThinPlateSpline` and `cmfsim.rigid_fit` of the core.
"""

from cmfsim.registration.closest import icp as icp
from cmfsim.registration.consistency import LandmarkAgreement as LandmarkAgreement
from cmfsim.registration.consistency import common_shift as common_shift
from cmfsim.registration.consistency import leave_one_out as leave_one_out
from cmfsim.registration.consistency import mirror_agreement as mirror_agreement
from cmfsim.registration.consistency import swapped_names as swapped_names
from cmfsim.registration.landmarks import LandmarkMatch as LandmarkMatch
from cmfsim.registration.landmarks import match_landmarks as match_landmarks
from cmfsim.registration.landmarks import side_vectors as side_vectors
from cmfsim.registration.landmarks import wrong_sides as wrong_sides
