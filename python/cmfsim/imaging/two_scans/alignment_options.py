"""Options of the registration of two volumes."""

import itertools
from dataclasses import dataclass

import numpy as np

from cmfsim.errors import RegistrationInputError
from cmfsim.values.checks import as_number, as_positive


@dataclass(frozen=True)
class AlignmentOptions:
    """Options of the registration of two volumes; the defaults suit a CT of a head.

    Attributes
    ----------
    resolutions : tuple of float, mm
        Voxel sizes, coarse to fine. Starts further away than ten of the first may fail.
    samples : int
        Points of the mask that the metric is taken over, at random places (Mattes et al. 2003).
    bins : int
        Of the joint histogram, along each axis.
    max_iterations : int
        At each resolution.
    least_overlap : float
        Share of the mask that must lie in the moving volume at the end.
    least_similarity : float
        Correlation of both volumes over the mask that is needed at the end. Scans of one head reach
        0.9; of two heads, or at a wrong place, 0.3.
    seed : int

    Raises
    ------
    RegistrationError, CaseError
        (also `ValueError`) A value out of its range; not a number.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.AlignmentOptions(resolutions=(8, 4)).samples
    60000
    """

    resolutions: tuple[float, ...] = (6.0, 3.0, 1.5)
    samples: int = 60_000
    bins: int = 48
    max_iterations: int = 300
    least_overlap: float = 0.5
    least_similarity: float = 0.5
    seed: int = 0

    def __post_init__(self) -> None:
        sizes = tuple(as_positive("resolution", s) for s in self.resolutions)
        if not sizes or any(a <= b for a, b in itertools.pairwise(sizes)):
            raise RegistrationInputError(
                f"resolutions are {sizes} mm: give at least one, each finer than the last"
            )
        object.__setattr__(self, "resolutions", sizes)
        for name, least in (("samples", 1000), ("bins", 8), ("max_iterations", 1), ("seed", 0)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
                raise RegistrationInputError(
                    f"{name} is {value!r}: a whole number of at least {least} is needed"
                )
        for name in ("least_overlap", "least_similarity"):
            if not 0.0 <= as_number(name, getattr(self, name)) <= 1.0:
                raise RegistrationInputError(
                    f"{name} is {getattr(self, name):g}: must be from 0 to 1"
                )
