"""The part of a head that a case asks for, and where it ends behind."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from cmfsim.errors import CaseInputError
from cmfsim.values.checks import Floats, Frozen, as_direction, as_point, as_rows

# Distance of the posterior plane behind the roots of the zygomatic arches, mm: behind the whole
# ramus and its joint, so that the jaw moves inside tissue, and before the mastoid and neck.
POSTERIOR_DEPTH = 10.0
# Share of the head's depth, from the foremost point of the skin, in front of the plane where there
# are no landmarks: the same plane on a head of ordinary proportions.
POSTERIOR_SHARE = 0.6
# Landmarks that the posterior plane is placed from: the roots of the arches, in front of the ears.
POSTERIOR_LANDMARKS = ("supraglenoid_L", "supraglenoid_R")


@dataclass(frozen=True, eq=False)
class Plane(Frozen):
    """A plane in space.

    point: (3,), mm, LPS.
    normal: (3,). Unit vector; given at any length but zero.
    Raises `CaseError`: Not three finite numbers, a normal of length zero.
    """

    point: Floats
    normal: Floats

    def __init__(self, point: ArrayLike, normal: ArrayLike) -> None:
        object.__setattr__(self, "point", as_point("plane point", point))
        object.__setattr__(self, "normal", as_direction("plane normal", normal))

    def distance(self, points: ArrayLike) -> Floats:
        """The signed distances of (n, 3) points from the plane, mm: positive along its normal."""
        offsets = as_rows("points", points, 3) - self.point
        return offsets @ self.normal


@dataclass(frozen=True)
class Region:
    """The part of the head that is meshed: the face, in front of a posterior plane.

    posterior_plane: Its normal points out of the region, backwards.
    posterior_depth: mm. Distance of a coronal plane behind the roots of the zygomatic arches
        (`supraglenoid_L` and `_R`); below 0 in front of them. 10 mm if neither it nor the plane is
        given.
    lower, upper: mm. Heights (S axis) that bound the region; None keeps what the skin has.
    """

    posterior_plane: Plane | None = None
    posterior_depth: float | None = None
    lower: float | None = None
    upper: float | None = None

    def __post_init__(self) -> None:
        if self.lower is not None and self.upper is not None and self.lower >= self.upper:
            raise CaseInputError(f"lower is {self.lower:g}, upper {self.upper:g}: lower < upper")

    def plane(self, landmarks: Mapping[str, ArrayLike], foremost: float, hindmost: float) -> Plane:
        """The posterior plane: as given, or coronal, from landmarks or from the head's depth.

        landmarks: mapping of str to (3,), mm. Skull landmarks; may be empty.
        foremost, hindmost: mm. P coordinates of the skin's first and last point.
        Returns: Its normal points backwards, out of the region.
        """
        if self.posterior_plane is not None:
            return self.posterior_plane
        depth = POSTERIOR_DEPTH if self.posterior_depth is None else self.posterior_depth
        roots = [np.asarray(landmarks[n]) for n in POSTERIOR_LANDMARKS if n in landmarks]
        if len(roots) == len(POSTERIOR_LANDMARKS):
            height = float(np.mean([root[1] for root in roots])) + depth
        elif self.posterior_depth is not None:
            names = " and ".join(POSTERIOR_LANDMARKS)
            raise CaseInputError(
                f"posterior_depth is {depth:g} mm behind {names}, which are not among the "
                "landmarks: add them, or give posterior_plane"
            )
        else:
            height = foremost + POSTERIOR_SHARE * (hindmost - foremost)
        return Plane((0.0, height, 0.0), (0.0, 1.0, 0.0))
