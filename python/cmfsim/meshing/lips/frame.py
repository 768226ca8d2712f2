"""The frame of a mouth: left, ahead and up along the dental arches."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cmfsim.values.checks import Floats
from cmfsim.values.dental_arch import DentalArch


@dataclass(frozen=True, eq=False)
class MouthFrame:
    """Axes of a mouth, with its origin half-way between the fronts of the two arches.

    origin: (3,), mm.
    axes: (3, 3). Rows: unit vectors to the left, ahead and up, at right angles. The frame is
        left-handed in LPS, where ahead is −y.
    reach_up, reach_down: mm. Heights of the fronts of the upper and lower arch: between them the
        lips meet.
    half_width: mm. Half the distance between the second molars.
    molars: mm. Forward position of the second molars relative to the origin; negative.
    """

    origin: Floats
    axes: Floats
    reach_up: float
    reach_down: float
    half_width: float
    molars: float

    def into(self, points: Floats) -> Floats:
        """Coordinates to the left, ahead and up of points in space, (n, 3) mm."""
        return (points - self.origin) @ self.axes.T

    def out_of(self, places: Floats) -> Floats:
        """The points in space of coordinates to the left, ahead and up, (n, 3) mm."""
        return self.origin + places @ self.axes


def mouth_frame(arches: Mapping[str, DentalArch]) -> MouthFrame:
    """The frame of a mouth from its two dental arches.

    arches: "upper" and "lower".
    """
    upper, lower = arches["upper"], arches["lower"]
    up = upper.out - lower.out
    up = up / np.linalg.norm(up)
    left = upper.left - upper.right
    left = left + lower.left - lower.right
    left = left - (left @ up) * up
    left = left / np.linalg.norm(left)
    tips = [upper.tip, lower.tip]
    molars = 0.5 * (upper.middle + lower.middle)
    origin = 0.5 * (tips[0] + tips[1])
    ahead = np.cross(left, up)
    ahead = ahead * np.sign(ahead @ (origin - molars))
    return MouthFrame(
        origin,
        np.stack([left, ahead, up]),
        float((tips[0] - origin) @ up),
        float((tips[1] - origin) @ up),
        0.5 * (upper.half_width + lower.half_width),
        float((molars - origin) @ ahead),
    )
