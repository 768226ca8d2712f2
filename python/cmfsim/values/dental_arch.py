"""Dental arches: where the teeth of one jaw stand."""

from dataclasses import dataclass

import numpy as np

from cmfsim.errors import CaseInputError
from cmfsim.values.checks import Floats, Frozen, as_number, as_point, check_one_of

JAWS = ("upper", "lower")
# Segments that may bear the upper and the lower teeth, the smallest first.
UPPER_BEARERS = ("maxilla", "midface", "cranium", "skull")
LOWER_BEARERS = ("mandible_body", "mandible")
# Half the width, and the length, of the smallest arch, mm: less is landmarks exchanged or in cm.
LEAST_ARCH = 2.0
# How far a node that slides lies from its contact sheet at most, mm: what lies deeper behind is on
# another face of the bone, on the palate or where teeth bite.
SHEET_DEPTH = 2.5


@dataclass(frozen=True, eq=False)
class DentalArch(Frozen):
    """The position of the teeth of one jaw.

    Attributes
    ----------
    jaw : str
        "upper" or "lower".
    tip, left, right : (3,) float64, mm
        On the alveolar bone: between the central incisors, and at the second molars (`supradentale`
        and `supra_m2`, or `infradentale` and `sub_m2`).
    out : (3,) float64
        Unit vector from the bite to the roots of this arch.
    depth_front, depth_molars : float, mm
        From `tip`, and from the middle between `left` and `right`, to the other arch's, against
        `out`: the edges of the teeth lie about half-way.

    Raises
    ------
    CaseError
        (also `ValueError`) Not three finite numbers, or places that span no arch.
    """

    jaw: str
    tip: Floats
    left: Floats
    right: Floats
    out: Floats
    depth_front: float
    depth_molars: float

    def __post_init__(self) -> None:
        check_one_of("jaw", self.jaw, JAWS)
        for name in ("tip", "left", "right", "out"):
            value = as_point(f"{self.jaw} arch: {name}", getattr(self, name))
            object.__setattr__(self, name, value)
        for name in ("depth_front", "depth_molars"):
            as_number(f"{self.jaw} arch: {name}", getattr(self, name))
        axes = self.axes()
        tip, left, right = self.tip, self.left, self.right
        if self.half_width < LEAST_ARCH or float(axes[1] @ (tip - self.middle)) < LEAST_ARCH:
            raise CaseInputError(
                f"{self.jaw} arch: its front {tip.round(1).tolist()} and its molars "
                f"{left.round(1).tolist()} and {right.round(1).tolist()} mm do not span an arch: "
                f"the front must be at least {LEAST_ARCH:g} mm in front of the molars, and the "
                "molars at least as far apart; check whether landmarks are swapped"
            )

    @property
    def middle(self) -> Floats:
        """Half-way between the molars, (3,) mm."""
        return 0.5 * (self.left + self.right)

    @property
    def half_width(self) -> float:
        """Half the distance between the molars, mm."""
        return 0.5 * float(np.linalg.norm(self.left - self.right))

    def axes(self) -> Floats:
        """Unit vectors to the left, ahead, and along `out`, as rows (3, 3).

        The last two are at right angles to the first, but not quite to each other: `ahead` is.
        """
        out = self.out
        across = self.left - self.right
        across = across / max(float(np.linalg.norm(across)), np.finfo(float).tiny)
        ahead = self.tip - self.middle
        ahead = ahead - (ahead @ across) * across - (ahead @ out) * out
        ahead = ahead / max(float(np.linalg.norm(ahead)), np.finfo(float).tiny)
        return np.stack([across, ahead, out])
