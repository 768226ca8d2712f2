"""Whether tooth rows pass through each other: depth of the lower teeth inside the upper ones.

Points of the lower row are looked up in a grid of the depth inside the upper row's bone, at its
place before the operation: both move rigidly, so one grid serves every plan.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from cmfsim._core import Surface
from cmfsim.errors import CaseInputError
from cmfsim.meshing.node_kinds import dental_arches
from cmfsim.values.anatomy import BoneSegment
from cmfsim.values.checks import Floats
from cmfsim.values.dental_arch import LOWER_BEARERS, UPPER_BEARERS, DentalArch
from cmfsim.values.image_data import ImageData
from cmfsim.values.patient_model import PatientModel

# The lower row: its bone within these of the arch, to the side, behind the molars, before the
# front teeth, and towards the roots, mm.
SIDE, BEHIND, AHEAD, ROOTS = 12.0, 8.0, 12.0, 4.0
# Points kept of it, and how far around them the grid reaches, mm.
MOST_POINTS, MARGIN = 4000, 8.0
SPACING, MOST_VOXELS = 1.0, 400_000


@dataclass(frozen=True, eq=False)
class ToothRows:
    """The lower row's points and the depth inside the upper row's bone.

    Attributes
    ----------
    upper, lower : str
        The segments that bear them; a segment that the plan does not move stays.
    points : (n, 3) float64, mm
        Of the lower row, before the operation.
    depth : ImageData
        Depth inside the upper row's bone, mm; 0 outside of it.
    """

    upper: str
    lower: str
    points: Floats
    depth: ImageData

    def passing(self, plan: Mapping[str, ArrayLike]) -> float:
        """How deep the lower row reaches into the upper one under a plan, mm; 0 where it does not.

        Parameters
        ----------
        plan : mapping of str to (4, 4) float64, mm
            Segments that it does not name stay.
        """
        up = np.asarray(plan.get(self.upper, np.eye(4)), dtype=np.float64)
        low = np.asarray(plan.get(self.lower, np.eye(4)), dtype=np.float64)
        both = np.linalg.inv(up) @ low
        places = self.points @ both[:3, :3].T + both[:3, 3]
        inside = ((places >= self.depth.lowest) & (places < self.depth.highest)).all(axis=1)
        if not inside.any():
            return 0.0
        return float(self.depth.sample(places[inside]).max())


def tooth_rows(patient: PatientModel) -> ToothRows:
    """The tooth rows of a patient.

    Raises
    ------
    CaseError
        (also `ValueError`) The arches, or the segments that bear them, are unknown.
    """
    arches = dental_arches(patient.anatomy, patient.segments, patient.landmarks.get("skull"))
    if "lower" not in arches.by_jaw:
        raise CaseInputError("neither skull landmarks nor the image locate the teeth")
    upper = _bearer(patient.segments, UPPER_BEARERS, "upper")
    lower = _bearer(patient.segments, LOWER_BEARERS, "lower")
    points = _row(lower, arches.by_jaw["lower"])
    low, high = points.min(axis=0) - MARGIN, points.max(axis=0) + MARGIN
    spacing = max(SPACING, float((np.prod(high - low) / MOST_VOXELS) ** (1.0 / 3.0)))
    counts = np.ceil((high - low) / spacing).astype(int) + 1
    axes = [start + spacing * np.arange(n) for start, n in zip(low, counts, strict=True)]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    depth = _depth(upper, places).reshape(counts)
    return ToothRows(
        upper.name, lower.name, points, ImageData(depth, (spacing, spacing, spacing), low)
    )


def _bearer(segments: tuple[BoneSegment, ...], names: tuple[str, ...], jaw: str) -> BoneSegment:
    by_name = {segment.name: segment for segment in segments}
    for name in names:
        if name in by_name:
            return by_name[name]
    raise CaseInputError(f"no segment bears the {jaw} teeth: one of {', '.join(names)} is needed")


def _row(bearer: BoneSegment, arch: DentalArch) -> Floats:
    """Vertices and triangle centres of a bone at its teeth."""
    vertices = bearer.surface.vertices
    points = np.concatenate([vertices, vertices[bearer.surface.triangles].mean(axis=1)])
    places = (points - arch.middle) @ arch.axes().T
    front = float((arch.tip - arch.middle) @ arch.axes()[1])
    chosen = points[
        (np.abs(places[:, 0]) <= arch.half_width + SIDE)
        & (places[:, 1] >= -BEHIND)
        & (places[:, 1] <= front + AHEAD)
        & (places[:, 2] <= ROOTS)
    ]
    if not len(chosen):
        raise CaseInputError(f"the surface of {bearer.name} has no teeth at its arch")
    step = -(-len(chosen) // MOST_POINTS)
    return chosen[::step]


def _depth(bearer: BoneSegment, places: Floats) -> Floats:
    """Depth of places inside a bone, mm; 0 outside."""
    surface = Surface(bearer.surface.vertices, bearer.surface.triangles)
    inside = surface.winding_number(places) > 0.5
    depth = np.zeros(len(places))
    if inside.any():
        closest, _, _ = surface.closest(places[inside])
        depth[inside] = np.linalg.norm(closest - places[inside], axis=1)
    return depth
