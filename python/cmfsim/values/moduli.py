"""Moduli of fat and muscle: those of the presets, and what a case or a caller sets instead."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from cmfsim._core import Tissue
from cmfsim.errors import MaterialError, MaterialInputError
from cmfsim.values.checks import Plain, as_number, as_text, check_instance, keep
from cmfsim.values.finding import Finding
from cmfsim.values.tissue_data import TissueData

# Young's moduli that a muscle or fat may have, MPa: from a thousandth of the softest fat that was
# measured to that of tendon. The largest ratio, 1e9, is far from where rounding makes a stiffness
# indefinite.
YOUNG_RANGE = (1e-6, 1e3)
# Above, the tets lock and the system is nearly singular; -1 itself is excluded.
MOST_POISSON = 0.4999
# Beyond these, moduli of soft tissue are a unit or a digit typed wrongly rather than a tissue, MPa:
# published values of fat and of whole passive muscle lie well within (docs/moduli.md). Poisson's
# ratio of tissue that is mostly water is 0.4 to 0.5, and 0.3 in the softest models of fat.
USUAL_YOUNG = (1e-4, 2.0)
USUAL_POISSON = 0.2


def moduli_unusual(named: Mapping[str, "FatModuli | MuscleModuli"], where: str) -> list[Finding]:
    """The warning about moduli that no soft tissue has, of tissues by name without gaps."""
    low, high = USUAL_YOUNG
    found = []
    for name, moduli in named.items():
        *young, poisson = moduli.constants()
        found += [f"{name} {value:g} MPa" for value in young if not low <= value <= high]
        if poisson < USUAL_POISSON:
            found.append(f"{name} with a Poisson's ratio of {poisson:g}")
    if not found:
        return []
    what = f"no soft tissue has these moduli: {', '.join(found)}"
    return [
        Finding(
            "moduli-unusual", what, severity="warning", where=where,
            facts={"low": low, "high": high, "least": USUAL_POISSON},
        )
    ]  # fmt: skip


def _check_young(name: str, value: float | None) -> None:
    low, high = YOUNG_RANGE
    if value is not None and not low <= as_number(name, value) <= high:
        raise MaterialInputError(
            f"{name} is {value:g} MPa: allowed is {low:g} to {high:g} MPa (10 kPa is 0.01)"
        )


def _check_poisson(value: float | None) -> None:
    if value is not None and not -1.0 < as_number("poisson", value) <= MOST_POISSON:
        raise MaterialInputError(
            f"poisson is {value:g}: the stiffness is positive definite above -1 and below 0.5; "
            f"allowed is {MOST_POISSON} at most"
        )


@dataclass(frozen=True)
class FatModuli:
    """Moduli of fat, isotropic.

    Attributes
    ----------
    young : float or None, MPa
        1e-6 to 1000; None takes the preset's.
    poisson : float or None
        Above -1, 0.4999 at most; None takes the preset's.

    Raises
    ------
    MaterialError
        (also `ValueError`) A value that is not a number within its range.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.FatModuli(young=0.002).young
    0.002
    """

    young: float | None = None
    poisson: float | None = None

    def __post_init__(self) -> None:
        _check_young("young", self.young)
        _check_poisson(self.poisson)

    def constants(self) -> tuple[float, float]:
        """Young's modulus (MPa) and Poisson's ratio, neither of them missing.

        Raises
        ------
        MaterialError
            (also `ValueError`) One of them is None.
        """
        if self.young is None or self.poisson is None:
            raise MaterialInputError(f"{self} has a gap: use TissueModuli.resolved")
        return self.young, self.poisson

    @classmethod
    def of(cls, fat: TissueData) -> "FatModuli":
        """The moduli of a case's fat, which lies between its muscles too.

        Parameters
        ----------
        fat : TissueData
            Isotropic, of one modulus; or of a preset.

        Raises
        ------
        MaterialError
            (also `ValueError`) Another kind of tissue, or moduli that differ by tet.
        """
        if fat.kind == "preset" and fat.preset in PRESET_MODULI:
            return PRESET_MODULI[fat.preset].fat
        values = fat.arrays()
        if fat.kind == "isotropic" and all(array.size == 1 for array in values.values()):
            return cls(**{name: array.item() for name, array in values.items()})
        raise MaterialInputError(
            f"fat is of kind {fat.kind!r}: the fat between muscles must be isotropic, with one "
            "young (MPa) and one poisson, or must be that of a preset"
        )


@dataclass(frozen=True)
class MuscleModuli:
    """Moduli of a muscle, transversely isotropic about its fibres.

    Attributes
    ----------
    young_along, young_across : float or None, MPa
        Along and across the fibres, 1e-6 to 1000; None takes what the muscle has otherwise.
    poisson : float or None
        For loading along the stiffer direction, above -1, 0.4999 at most; None as above. With it
        the law of the model is positive definite for every ratio of the two moduli.

    Raises
    ------
    MaterialError
        (also `ValueError`) A value that is not a number within its range.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.MuscleModuli(young_along=0.03).young_along
    0.03
    """

    young_along: float | None = None
    young_across: float | None = None
    poisson: float | None = None

    def __post_init__(self) -> None:
        _check_young("young_along", self.young_along)
        _check_young("young_across", self.young_across)
        _check_poisson(self.poisson)

    def over(self, base: "MuscleModuli") -> "MuscleModuli":
        """These moduli, and those of `base` where these are None."""
        return MuscleModuli(
            base.young_along if self.young_along is None else self.young_along,
            base.young_across if self.young_across is None else self.young_across,
            base.poisson if self.poisson is None else self.poisson,
        )

    def constants(self) -> tuple[float, float, float]:
        """Along, across (MPa) and Poisson's ratio, none of them missing.

        Raises
        ------
        MaterialError
            (also `ValueError`) One of them is None.
        """
        along, across, poisson = self.young_along, self.young_across, self.poisson
        if along is None or across is None or poisson is None:
            raise MaterialInputError(f"{self} has a gap: use TissueModuli.resolved")
        return along, across, poisson


@dataclass(frozen=True)
class TissueModuli(Plain):
    """Moduli that differ from a preset: of fat, all muscles, or single muscles.

    Attributes
    ----------
    fat : FatModuli
    muscle : MuscleModuli
        Of every muscle.
    muscles : mapping of str to MuscleModuli
        Of single muscles, by name such as "masseter_L"; they take precedence over `muscle`.

    Notes
    -----
    Under prescribed displacements, a linear model depends only on ratios of moduli: scaling all of
    them by one factor changes no displacement.

    Examples
    --------
    >>> import cmfsim
    >>> soft = cmfsim.MuscleModuli(young_along=0.03, young_across=0.02)
    >>> moduli = cmfsim.TissueModuli(muscles={"masseter_L": soft})
    >>> moduli.resolved("kim2010").muscles["masseter_L"].poisson
    0.43
    """

    fat: FatModuli = field(default_factory=FatModuli)
    muscle: MuscleModuli = field(default_factory=MuscleModuli)
    muscles: Mapping[str, MuscleModuli] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_instance("fat", self.fat, FatModuli)
        check_instance("muscle", self.muscle, MuscleModuli)
        for name, moduli in self.muscles.items():
            as_text("muscle name", name)
            check_instance(f"moduli of {name}", moduli, MuscleModuli)
        keep(self, muscles=self.muscles)

    def resolved(self, preset: str) -> "TissueModuli":
        """The same without gaps: each None replaced, from `muscle` and then from the preset.

        Parameters
        ----------
        preset : str
            One of `PRESETS`.

        Raises
        ------
        MaterialError
            (also `ValueError`) Moduli whose stiffness is not positive definite, with the muscle.
        """
        base = PRESET_MODULI[preset]
        fat = FatModuli(
            base.fat.young if self.fat.young is None else self.fat.young,
            base.fat.poisson if self.fat.poisson is None else self.fat.poisson,
        )
        muscle = self.muscle.over(base.muscle)
        muscles = {name: moduli.over(muscle) for name, moduli in self.muscles.items()}
        _check_definite("every muscle", muscle)
        for name, moduli in muscles.items():
            _check_definite(name, moduli)
        return TissueModuli(fat, muscle, muscles)

    def is_preset(self, preset: str) -> bool:
        """Whether every constant is the preset's."""
        base, own = PRESET_MODULI[preset], self.resolved(preset)
        return own.fat == base.fat and all(
            moduli == base.muscle for moduli in (own.muscle, *own.muscles.values())
        )


# As the core has them in `Preset::from_name`: muscle at rest in fat that can lose volume
# (docs/moduli.md); Table 1 of Kim et al. (2010) as printed, and with its muscle's moduli exchanged.
PRESET_MODULI: Mapping[str, TissueModuli] = MappingProxyType(
    {
        "passive": TissueModuli(FatModuli(0.003, 0.40), MuscleModuli(0.06, 0.03, 0.43)),
        "kim2010": TissueModuli(FatModuli(0.003, 0.46), MuscleModuli(0.5, 0.79, 0.43)),
        "kim2010-swapped": TissueModuli(FatModuli(0.003, 0.46), MuscleModuli(0.79, 0.5, 0.43)),
    }
)


def _check_definite(name: str, moduli: MuscleModuli) -> None:
    """The core's own check of a stiffness, with the name of the muscle."""
    try:
        Tissue.transversely_isotropic(*moduli.constants(), [1.0, 0.0, 0.0])
    except MaterialError as error:
        raise MaterialInputError(
            f"moduli of {name} have no positive definite stiffness: {error}; choose young_along "
            f"and young_across from {YOUNG_RANGE[0]:g} to {YOUNG_RANGE[1]:g} MPa, closer to each "
            "other, and poisson from 0 to 0.49"
        ) from error
