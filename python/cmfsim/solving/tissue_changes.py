"""The tissue of a scene with one of its constants changed: what derivatives are taken of."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from cmfsim._core import Tissue
from cmfsim.errors import MaterialError
from cmfsim.values.checks import Floats
from cmfsim.values.moduli import PRESET_MODULI, FatModuli
from cmfsim.values.motion import rigid_motion
from cmfsim.values.tissue_data import TissueData


@dataclass(frozen=True, eq=False)
class TissueParts:
    """The share of fat and of muscle in the constants of each tet.

    With the fraction p of muscle, E = E_fat (1 − p) + E_m along and across, ν likewise.

    Attributes
    ----------
    fat_young : float, MPa
    fat_poisson : float
    fraction : (m,) float64
    along, across, poisson : (m,) float64
        What muscle adds, Σ p_i E_i in MPa and Σ p_i ν_i.
    fibre : (m, 3) float64
        Unit vectors.
    law : str
    """

    fat_young: float
    fat_poisson: float
    fraction: Floats
    along: Floats
    across: Floats
    poisson: Floats
    fibre: Floats
    law: str

    def tissue(self) -> Tissue:
        """The tissue of all tets.

        Raises
        ------
        MaterialError
            A stiffness that is not positive definite.
        """
        rest = 1.0 - self.fraction
        fat, poisson = rest * self.fat_young, rest * self.fat_poisson + self.poisson
        if not self.fraction.any():
            return Tissue.isotropic(fat, poisson)
        along, across = fat + self.along, fat + self.across
        return Tissue.transversely_isotropic(along, across, poisson, self.fibre, law=self.law)

    def changed(self, source: str, by: float) -> "TissueParts":
        """The parts with one source changed.

        Parameters
        ----------
        source : str
            Name of one of `TISSUE`.
        by : float
            In its unit; degrees for directions.
        """
        return _CHANGES[source](self, by)

    @property
    def sources(self) -> tuple[str, ...]:
        """The sources that have an effect: those of muscle only where there is muscle.

        Without muscle the modulus has none: displacements depend on ratios alone.
        """
        return tuple(_CHANGES) if self.fraction.any() else ("fat Poisson's ratio",)


def _turned(axis: tuple[float, float, float]) -> Callable[[TissueParts, float], TissueParts]:
    def change(parts: TissueParts, degrees: float) -> TissueParts:
        turn = rigid_motion(angle=degrees, axis=axis)[:3, :3]
        return replace(parts, fibre=parts.fibre @ turn.T)

    return change


def _more_muscle(parts: TissueParts, by: float) -> TissueParts:
    scale = 1.0 + by
    return replace(
        parts,
        fraction=scale * parts.fraction,
        along=scale * parts.along,
        across=scale * parts.across,
        poisson=scale * parts.poisson,
    )


_CHANGES: Mapping[str, Callable[[TissueParts, float], TissueParts]] = {
    "fat modulus": lambda p, by: replace(p, fat_young=p.fat_young * math.exp(by)),
    "muscle modulus along": lambda p, by: replace(p, along=p.along * math.exp(by)),
    "muscle modulus across": lambda p, by: replace(p, across=p.across * math.exp(by)),
    "fat Poisson's ratio": lambda p, by: replace(p, fat_poisson=p.fat_poisson + by),
    "muscle Poisson's ratio": lambda p, by: replace(p, poisson=p.poisson + by * p.fraction),
    "muscle fraction": _more_muscle,
    "fibre direction about L": _turned((1.0, 0.0, 0.0)),
    "fibre direction about P": _turned((0.0, 1.0, 0.0)),
    "fibre direction about S": _turned((0.0, 0.0, 1.0)),
}


def tissue_parts(
    data: TissueData, n_tets: int, fat: TissueData, fraction: Floats | None
) -> TissueParts | None:
    """Fat and muscle of a scene's tissue; None where they cannot be told apart.

    Parameters
    ----------
    data : TissueData
        Of the scene.
    n_tets : int
    fat : TissueData
        Between the muscles.
    fraction : (m,) float64 or None
        Share of muscle in each tet; None in a patient without.
    """
    if data.kind == "stiffness" or (data.kind == "preset" and data.mixing != "moduli"):
        return None
    arrays = {
        name: np.broadcast_to(value, (n_tets, *value.shape[1:]))
        for name, value in data.arrays().items()
    }
    none = np.zeros(n_tets)
    straight = np.broadcast_to([1.0, 0.0, 0.0], (n_tets, 3))
    if data.kind == "preset":
        moduli = PRESET_MODULI[data.preset]
        young, poisson = moduli.fat.constants()
        p = arrays["fraction"]
        along, across, ratio = (p * value for value in moduli.muscle.constants())
        law = "spencer"
    else:
        try:
            young, poisson = FatModuli.of(fat).constants()
        except MaterialError:
            return None
        law = data.law
        if data.kind == "isotropic":
            uniform = all(np.size(value) == 1 for value in data.arrays().values())
            if not uniform:
                return None
            young, poisson = float(arrays["young"][0]), float(arrays["poisson"][0])
            return TissueParts(young, poisson, none, none, none, none, straight, law)
        if fraction is None:
            return None
        p = fraction
        along, across = (arrays[n] - (1.0 - p) * young for n in ("young_along", "young_across"))
        ratio = arrays["poisson"] - (1.0 - p) * poisson
    # Fat has no direction; any unit vector serves.
    fibre = np.where(p[:, None] > 0.0, arrays.get("fibre", straight), straight)
    return TissueParts(young, poisson, p, along, across, ratio, fibre, law)
