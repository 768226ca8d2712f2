"""Tissue that slides on moving bones and teeth, may lift off, and is pushed back out of them.

This contact belongs to the true face: a penalty on smooth distances, without the surfaces,
constraints and active sets of the models under test.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError, third_party
from cmfsim.values.checks import Floats, as_positive
from cmfsim.values.image_data import ImageData

# Pressure per depth of penetration, MPa/mm: under the pressures of soft tissue (a few kPa), nodes
# penetrate by less than a tenth of a mm.
STIFFNESS = 0.1
# Depth over which the stiffness grows, mm: nodes that lie on bone would otherwise be at a kink.
ONSET = 0.1
# Standard deviation of the blur that rounds gaps between teeth, mm: half an edge of the mesh.
RELIEF = 1.0
# Step of the central differences, mm: the splines are smooth over a voxel.
DIFFERENCE = 1e-2


class SmoothDistance:
    """The distance outside a bone, negative inside, twice continuously differentiable near it.

    level: Positive inside, about a distance near the surface.
    relief: mm. Standard deviation of the Gaussian that the level is blurred with.
    """

    def __init__(self, level: ImageData, relief: float = RELIEF) -> None:
        ndimage = third_party("scipy.ndimage", "contact of virtual patients is found", "study")
        spacing = level.spacing
        values = level.values.astype(np.float64)
        blurred = ndimage.gaussian_filter(values, as_positive("relief", relief) / spacing)
        self._spline = ndimage.spline_filter(-blurred, order=3, mode="mirror")
        self._origin, self._spacing = level.lowest, spacing
        self._sample = ndimage.map_coordinates

    def __call__(self, points: Floats) -> Floats:
        """The distances of points (k, 3), mm."""
        place = ((points - self._origin) / self._spacing).T
        found: Floats = self._sample(self._spline, place, order=3, mode="mirror", prefilter=False)
        return found

    def slope(self, points: Floats) -> Floats:
        """The gradients at points, (k, 3)."""
        columns = []
        for axis in range(3):
            step = np.zeros(3)
            step[axis] = DIFFERENCE
            columns.append((self(points + step) - self(points - step)) / (2.0 * DIFFERENCE))
        return np.column_stack(columns)

    def curvature(self, points: Floats) -> Floats:
        """The second derivatives at points, (k, 3, 3), symmetric."""
        columns = []
        for axis in range(3):
            step = np.zeros(3)
            step[axis] = DIFFERENCE
            columns.append((self.slope(points + step) - self.slope(points - step)) / 2.0)
        found = np.stack(columns, axis=2) / DIFFERENCE
        return 0.5 * (found + found.transpose(0, 2, 1))


@dataclass(frozen=True, eq=False)
class BoneContact:
    """Nodes that moving bones push, without friction and without pull.

    A node that starts inside the blurred bone may stay at that depth.

    points: (n, 3), mm. All nodes at rest.
    nodes: (k,) whole numbers. Nodes that may touch bone.
    area: (k,), mm². Boundary area around each.
    bones: At rest.
    motion: The rigid motion (4, 4) of each bone after a fraction of it, 0 to 1.
    stiffness: MPa/mm.
    """

    points: Floats
    nodes: NDArray[Any]
    area: Floats
    bones: Mapping[str, SmoothDistance]
    motion: Mapping[str, Callable[[float], Floats]]
    stiffness: float = STIFFNESS

    def __post_init__(self) -> None:
        rest = {name: np.minimum(b(self.points[self.nodes]), 0.0) for name, b in self.bones.items()}
        object.__setattr__(self, "_rest", rest)
        for name in self.bones:
            if name not in self.motion:
                raise CaseInputError(f"contact with {name!r}, whose motion is not given")

    def depths(self, displacements: Floats, part: float) -> dict[str, Floats]:
        """Depth of each touching node in each bone, (k,) mm; 0 outside."""
        rest: Mapping[str, Floats] = self.__dict__["_rest"]
        return {
            name: np.maximum(rest[name] - bone(self._seen(name, displacements, part)), 0.0)
            for name, bone in self.bones.items()
        }

    def _seen(self, name: str, displacements: Floats, part: float) -> Floats:
        """The moved nodes in the frame of a bone after a fraction of its motion."""
        matrix = self.motion[name](part)
        moved = (self.points + displacements)[self.nodes]
        back: Floats = (moved - matrix[:3, 3]) @ matrix[:3, :3]
        return back

    def energy(self, displacements: Floats, part: float) -> float:
        """∫ ∫ pressure d(depth) d(area), N·mm.

        The pressure is k d² / 2δ to the depth δ of its onset, from there k (d − δ/2).
        """
        total = 0.0
        for d in self.depths(displacements, part).values():
            shallow = d**3 / (6.0 * ONSET)
            deep = 0.5 * (d - 0.5 * ONSET) ** 2 + ONSET**2 / 24.0
            total += float(self.area @ np.where(d < ONSET, shallow, deep))
        return self.stiffness * total

    def forces(self, displacements: Floats, part: float) -> tuple[Floats, Floats]:
        """The gradient of the energy, (n, 3) N, and the stiffness of each node, (n, 3, 3) N/mm.

        Of the bone's curvature, only that of hollows counts, which stiffens, not that of edges.
        """
        force = np.zeros_like(self.points)
        blocks = np.zeros((len(self.points), 3, 3))
        for name, depth in self.depths(displacements, part).items():
            touching = np.flatnonzero(depth > 0.0)
            if not len(touching):
                continue
            seen = self._seen(name, displacements, part)[touching]
            turn = self.motion[name](part)[:3, :3]
            normal = self.bones[name].slope(seen) @ turn.T
            bend = turn @ self.bones[name].curvature(seen) @ turn.T
            weight, d = self.stiffness * self.area[touching], depth[touching]
            pressing = np.where(d < ONSET, 0.5 * d**2 / ONSET, d - 0.5 * ONSET)
            rise = weight * np.minimum(d / ONSET, 1.0)
            at = self.nodes[touching]
            force[at] -= (weight * pressing)[:, None] * normal
            blocks[at] += rise[:, None, None] * normal[:, :, None] * normal[:, None, :]
            values, axes = np.linalg.eigh(-(weight * pressing)[:, None, None] * bend)
            blocks[at] += (axes * np.maximum(values, 0.0)[:, None]) @ axes.transpose(0, 2, 1)
        return force, blocks

    def coupling(self, displacements: Floats, part: float) -> None:
        """None: nodes touch only bones, not each other."""
        del displacements, part
