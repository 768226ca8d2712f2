"""The tissue of tets from the shares of muscles that have moduli of their own."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from cmfsim._core import MuscleShares, Tissue
from cmfsim.errors import MaterialInputError
from cmfsim.values.checks import Floats, nearest
from cmfsim.values.finding import Finding
from cmfsim.values.moduli import MuscleModuli, TissueModuli, moduli_unusual
from cmfsim.values.tissue_data import TissueData

MODULI_CODES = frozenset({"muscle-moduli", "moduli-unusual"})


def mixed_tissue(
    shares: MuscleShares, names: Sequence[str], moduli: TissueModuli, mixing: str
) -> tuple[Tissue, TissueData | None]:
    """The tissue of every tet, and the arrays that a scene takes for it.

    With the share p_i of muscle i in the tet and p = Σ p_i: "moduli" mixes
    E = E_fat (1 − p) + Σ p_i E_i along and across the mean fibre, and ν likewise; "stiffness" mixes
    C = C_fat (1 − p) + Σ p_i C_i(a_i). Both are the rules of the presets where all E_i are equal.

    names: Of the muscles, in the order of the shares.
    moduli: Without gaps.
    Returns: None for "stiffness", whose arrays are those of the tissue.
    """
    rows = [moduli.muscles.get(name, moduli.muscle) for name in names]
    table = np.array([row.constants() for row in rows], dtype=np.float64).reshape(-1, 3)
    young, poisson = moduli.fat.constants()
    if mixing == "stiffness":
        return _by_stiffness(shares, table, Tissue.isotropic(young, poisson)), None
    tets, muscles, _, share, _ = shares.shares
    p = shares.fraction

    def mixed(of_fat: float, column: int) -> Floats:
        of_muscle = np.bincount(tets, weights=share * table[muscles, column], minlength=len(p))
        mean: Floats = of_fat * (1.0 - p) + of_muscle
        return mean

    along, across, ratio = mixed(young, 0), mixed(young, 1), mixed(poisson, 2)
    # Fat has no direction; any unit vector serves.
    fibre = np.where(p[:, np.newaxis] > 0.0, shares.fibre, [1.0, 0.0, 0.0])
    data = TissueData(
        "transversely_isotropic", young_along=along, young_across=across, poisson=ratio, fibre=fibre
    )
    return Tissue.transversely_isotropic(along, across, ratio, fibre), data


def _by_stiffness(shares: MuscleShares, table: Floats, fat: Tissue) -> Tissue:
    tets, muscles, _, share, fibre = shares.shares
    n_tets = len(shares.fraction)
    rest = np.maximum(1.0 - np.bincount(tets, weights=share, minlength=n_tets), 0.0)
    sums = rest[:, np.newaxis, np.newaxis] * fat.stiffness()[0]
    if len(tets):
        along, across, poisson = table[muscles].T.copy()
        each = Tissue.transversely_isotropic(along, across, poisson, fibre).stiffness()
        np.add.at(sums, tets, share[:, np.newaxis, np.newaxis] * each)
    return Tissue.from_stiffness(sums)


def check_muscle_names(moduli: TissueModuli, names: Sequence[str]) -> None:
    """Raises an error if moduli are given for a muscle that is not there.

    names: Of the muscles.
    Raises `MaterialError`: With the nearest name, and all of them.
    """
    for name in moduli.muscles:
        if name not in names:
            known = ", ".join(names) or "none"
            raise MaterialInputError(
                f"moduli are given for the muscle {name!r}, which does not "
                f"exist{nearest(name, tuple(names))} (muscles: {known})"
            )


def moduli_findings(moduli: TissueModuli, preset: str, where: str = "") -> Iterator[Finding]:
    """A note of moduli that are not the preset's; a warning of those that no muscle has.

    where: Of what states them.
    """
    if moduli.is_preset(preset):
        return
    own = moduli.resolved(preset)
    named: Mapping[str, MuscleModuli] = {"muscle": own.muscle, **own.muscles}
    stated = ["fat {:g} (poisson {:g})".format(*own.fat.constants())]
    stated += [
        "{} {:g} along and {:g} across (poisson {:g})".format(name, *m.constants())
        for name, m in named.items()
    ]
    yield Finding(
        "muscle-moduli",
        f"moduli differ from those of {preset}, MPa: {'; '.join(stated)}",
        where=where,
    )
    yield from moduli_unusual({"fat": own.fat, **named}, where)
