"""Contacts of the tooth rows: the signed distance of each crown from the other row.

Distances are positive across a gap and negative where crowns overlap: there, the depth of a point
inside the other bone.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.planning.occlusion.rows import ToothRow, patient_rows, rigid_of
from cmfsim.surfaces.depth import distances
from cmfsim.surfaces.topology import connected_labels
from cmfsim.values.checks import Floats, as_rows
from cmfsim.values.patient_model import PatientModel
from cmfsim.values.surface_data import SurfaceData

# Crowns nearer than this touch, mm: bites planned on scans are accurate to some tenths.
TOUCH = 0.2


def signed_gaps(points: ArrayLike, surface: SurfaceData) -> Floats:
    """Distance of points (n, 3), mm, from a closed surface, (n,) mm: negative inside."""
    places = as_rows("points", points, 3)
    gaps = distances(places, surface.searched)
    return np.where(surface.searched.winding_number(places) > 0.5, -gaps, gaps)


@dataclass(frozen=True, eq=False)
class ContactMap:
    """The contacts of two tooth rows.

    Attributes
    ----------
    upper, lower : ToothRow
        Where they were compared.
    upper_gaps, lower_gaps : (v,) masked float64, mm
        Of the vertices of each row's surface from the other row; masked beyond the crowns.
    """

    upper: ToothRow
    lower: ToothRow
    upper_gaps: np.ma.MaskedArray[Any, np.dtype[np.float64]]
    lower_gaps: np.ma.MaskedArray[Any, np.dtype[np.float64]]

    @property
    def greatest_overlap(self) -> float:
        """How deep crowns lie inside the other row at most, mm; 0 where they do not."""
        return max(0.0, -self.least_gap)

    @property
    def least_gap(self) -> float:
        """The least signed distance of the rows, mm; negative where they overlap."""
        return float(min(self.upper_gaps.min(), self.lower_gaps.min()))

    @property
    def n_contacts(self) -> int:
        """The number of connected patches of the lower crowns that touch or overlap upper ones."""
        touching = np.ma.filled(self.lower_gaps <= TOUCH, fill_value=False)
        triangles = self.lower.surface.triangles.astype(np.int64)
        edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]]])
        labels = connected_labels(edges[touching[edges].all(axis=1)], len(touching))
        return len(np.unique(labels[touching]))

    def as_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return {
            "n_contacts": self.n_contacts,
            "greatest_overlap_mm": self.greatest_overlap,
            "least_gap_mm": self.least_gap,
        }


def contact_map(upper: ToothRow, lower: ToothRow) -> ContactMap:
    """The contacts of two tooth rows where they are.

    Parameters
    ----------
    upper, lower : ToothRow
        Moved as planned: `ToothRow.moved`.

    Raises
    ------
    CaseError
        (also `ValueError`) A jaw has no teeth.

    Examples
    --------
    >>> import cmfsim
    >>> upper, lower = cmfsim.tooth_rows(anatomy, segments, landmarks)
    >>> contacts = cmfsim.contact_map(upper.moved(cmfsim.rigid_motion((0, 0, 9))), lower)
    >>> contacts.n_contacts, contacts.greatest_overlap
    (0, 0.0)
    """
    return ContactMap(upper, lower, _gaps(upper, lower), _gaps(lower, upper))


def planned_contacts(patient: PatientModel) -> ContactMap:
    """The contacts of a patient's tooth rows as planned; `CaseError` where these are doubtful."""
    plan, rows = patient.scene.plan, patient_rows(patient)
    return contact_map(*(row.moved(rigid_of(plan.get(row.segment))) for row in rows))


def _gaps(row: ToothRow, other: ToothRow) -> np.ma.MaskedArray[Any, np.dtype[np.float64]]:
    crowns: NDArray[np.bool_] = row.crowns
    values = np.zeros(len(crowns))
    values[crowns] = signed_gaps(row.surface.vertices[crowns], other.surface)
    return np.ma.MaskedArray(values, mask=~crowns)
