"""Pairs of points that lie nearest to one another and look the same way."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import third_party
from cmfsim.registration.proposed.shape_model.state import POSE_UNITS
from cmfsim.values.checks import Floats

# Normals at a right angle count as this far apart times √2, mm of the average head.
NORMAL_REACH = 14.0


class Finder:
    """Looks up the nearest of a set of points with normals."""

    def __init__(self, points: Floats, normals: Floats) -> None:
        spatial = third_party("scipy.spatial", "landmarks are found", "imaging")
        self.points, self.normals = points, normals
        self._tree: Any = spatial.cKDTree(_joined(points, normals))

    def nearest(self, points: Floats, normals: Floats) -> tuple[Floats, NDArray[np.int64]]:
        """Distance, with that of the normals, and index, both of the leading shape of points."""
        gaps, index = self._tree.query(_joined(points, normals).reshape(-1, 6))
        return gaps.reshape(points.shape[:-1]), index.reshape(points.shape[:-1])


def _joined(points: Floats, normals: Floats) -> Floats:
    return np.concatenate([points, NORMAL_REACH * normals], axis=-1)


def pose_columns(goal: Floats, moved: Floats, normals: Floats) -> Floats:
    """Derivatives of n·(x − goal), over the scale, by a small similarity of x, in lengths.

    Divided by the scale, distances count in the patient's mm: else a patient who shrinks to a point
    would lie near everything.
    """
    grow = (normals * goal).sum(axis=-1, keepdims=True)
    columns = np.concatenate([grow, np.cross(moved, normals), normals], axis=-1)
    lengths: Floats = columns / POSE_UNITS
    return lengths
