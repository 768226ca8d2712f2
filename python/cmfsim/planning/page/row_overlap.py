"""Whether tooth rows pass through each other: depth of the lower crowns inside the upper row.

Points of the lower crowns are looked up in a grid of the depth inside the upper row's bone, at its
place before the operation: both move rigidly, so one grid serves every plan.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from cmfsim._core import signed_distance_image
from cmfsim.planning.occlusion.rows import patient_rows
from cmfsim.values.checks import Floats
from cmfsim.values.image_data import ImageData
from cmfsim.values.motion import carried
from cmfsim.values.patient_model import PatientModel

# Points kept of the lower crowns, how far around them the grid reaches, and its spacing, mm.
MOST_POINTS, MARGIN, SPACING = 4000, 8.0, 1.0


@dataclass(frozen=True, eq=False)
class RowOverlap:
    """The lower row's crowns, (n, 3) mm, at rest, and the depth inside the upper row's bone.

    upper, lower: The segments that bear them; a segment that the plan does not move stays.
    depth: mm, up to `MARGIN`; 0 outside of the bone.
    """

    upper: str
    lower: str
    points: Floats
    depth: ImageData

    def passing(self, plan: Mapping[str, ArrayLike]) -> float:
        """How deep the lower row reaches into the upper under a plan, mm; others stay."""
        up = np.asarray(plan.get(self.upper, np.eye(4)), dtype=np.float64)
        low = np.asarray(plan.get(self.lower, np.eye(4)), dtype=np.float64)
        both = np.linalg.inv(up) @ low
        places = carried(both, self.points)
        inside = ((places >= self.depth.lowest) & (places < self.depth.highest)).all(axis=1)
        if not inside.any():
            return 0.0
        return float(self.depth.sample(places[inside]).max())


def row_overlap(patient: PatientModel) -> RowOverlap:
    """The overlap of a patient's tooth rows; raises as `patient_rows`."""
    upper, lower = patient_rows(patient)
    crowns = lower.surface.vertices[lower.crowns]
    points = crowns[:: -(-len(crowns) // MOST_POINTS)]
    low = points.min(axis=0) - MARGIN
    nx, ny, nz = (np.ceil((points.max(axis=0) + MARGIN - low) / SPACING).astype(int) + 1).tolist()
    x, y, z = low.tolist()
    spacing = (SPACING, SPACING, SPACING)
    depth = signed_distance_image(
        upper.surface.searched, (nx, ny, nz), spacing, (x, y, z), band=MARGIN
    )
    return RowOverlap(
        upper.segment, lower.segment, points, ImageData(np.maximum(depth, 0.0), spacing, low)
    )
