"""The part of a head that an image shows: it ends at planes."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmfsim.values.checks import Floats


@dataclass(frozen=True, eq=False)
class ShownRegion:
    """A convex region: what lies behind each of some planes. A round one has many.

    normals: (m, 3), unit, towards what is not shown.
    places: (m,), of the planes along their normals, mm (or voxels).
    """

    normals: Floats
    places: Floats

    def depths(self, points: Floats) -> Floats:
        """How far points (n, 3) lie behind each plane, (n, m); negative beyond it."""
        found: Floats = self.places - points @ self.normals.T
        return found

    def nearest(self, points: Floats) -> tuple[Floats, NDArray[np.int64]]:
        """How far points (n, 3) lie within the region, (n,), and the plane nearest to each.

        Plane by plane: a round region has some 90, and a head millions of voxels.
        """
        depth, plane = np.full(len(points), np.inf), np.zeros(len(points), dtype=np.int64)
        for row, (normal, place) in enumerate(zip(self.normals, self.places, strict=True)):
            behind = place - points @ normal
            nearer = behind < depth
            depth[nearer], plane[nearer] = behind[nearer], row
        return depth, plane

    def depth(self, points: Floats) -> Floats:
        """How far points (n, 3) lie within the region, (n,); negative outside of it."""
        return self.nearest(points)[0]

    def scaled(self, spacing: Floats, origin: Floats) -> "ShownRegion":
        """The region of voxels in mm."""
        normals = self.normals / spacing
        lengths = np.linalg.norm(normals, axis=1)
        normals /= lengths[:, None]
        return ShownRegion(normals, self.places / lengths + normals @ origin)

    def and_behind(self, other: "ShownRegion") -> "ShownRegion":
        """What both show."""
        return ShownRegion(
            np.vstack([self.normals, other.normals]), np.append(self.places, other.places)
        )


def box_region(low: Floats, high: Floats) -> ShownRegion:
    """The region between two corners (3,); infinite ones give no plane."""
    axes = np.vstack([-np.eye(3), np.eye(3)])
    places = np.append(-low, high)
    return ShownRegion(axes[np.isfinite(places)], places[np.isfinite(places)])
