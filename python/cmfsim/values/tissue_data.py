"""Tissue: what the tets of a mesh are made of."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from cmfsim.errors import CaseInputError
from cmfsim.values.checks import Floats, Frozen, as_floats, as_text, check_one_of, frozen, keep

# Arrays that each kind of tissue needs, with the number of axes after the first.
TISSUE_ARRAYS: Mapping[str, Mapping[str, tuple[int, ...]]] = MappingProxyType({
    "isotropic": {"young": (), "poisson": ()},
    "transversely_isotropic": {"young_along": (), "young_across": (), "poisson": (), "fibre": (3,)},
    "stiffness": {"stiffness": (6, 6)},
    "preset": {"fraction": (), "fibre": (3,)},
})  # fmt: skip
# Arrays of the above that may be left out.
TISSUE_OPTIONAL = frozenset({("preset", "fibre")})
# How the constants of fat and muscle mix: each modulus, or the whole stiffness.
MIXINGS = ("moduli", "stiffness")
# Constants of fat and muscle where nothing else is stated; docs/moduli.md has the reasons.
DEFAULT_PRESET = "passive"


@dataclass(frozen=True, eq=False)
class TissueData(Frozen):
    """The material of the tets, as the arrays that `cmfsim.Tissue` takes.

    Every array holds one value per tet, or a single one for all tets.

    Attributes
    ----------
    kind : str
        "isotropic" (`young`, `poisson`), "transversely_isotropic" (`young_along`, `young_across`,
        `poisson`, `fibre`, `law`), "stiffness" (`stiffness`) or "preset" (`preset`, `fraction`,
        `fibre`, `mixing`).
    young, young_along, young_across : (m,) or (1,) float64, MPa
    poisson, fraction : (m,) or (1,) float64
    fibre : (m, 3) or (1, 3) float64
        Unit vectors.
    stiffness : (m, 6, 6) or (1, 6, 6) float64, MPa
        Voigt order xx, yy, zz, yz, xz, xy with engineering shears, global axes.
    law, preset, mixing : str
        Names that `cmfsim.Tissue` knows.

    Raises
    ------
    CaseError
        (also `ValueError`) Unknown kind, an array missing, not wanted, misshapen or not finite.

    Examples
    --------
    >>> import cmfsim
    >>> fat = cmfsim.TissueData("isotropic", young=0.003, poisson=0.46)
    >>> fat.young.shape
    (1,)
    """

    kind: str
    young: Floats | None
    poisson: Floats | None
    young_along: Floats | None
    young_across: Floats | None
    fibre: Floats | None
    stiffness: Floats | None
    fraction: Floats | None
    law: str
    preset: str
    mixing: str

    def __init__(  # noqa: PLR0913, PLR0917 (one for each field)
        self,
        kind: str,
        young: ArrayLike | None = None,
        poisson: ArrayLike | None = None,
        young_along: ArrayLike | None = None,
        young_across: ArrayLike | None = None,
        fibre: ArrayLike | None = None,
        stiffness: ArrayLike | None = None,
        fraction: ArrayLike | None = None,
        law: str = "spencer",
        preset: str = DEFAULT_PRESET,
        mixing: str = "moduli",
    ) -> None:
        check_one_of("tissue kind", kind, tuple(TISSUE_ARRAYS))
        given = {
            "young": young, "poisson": poisson, "young_along": young_along, "fibre": fibre,
            "young_across": young_across, "stiffness": stiffness, "fraction": fraction,
        }  # fmt: skip
        keep(self, kind=kind)
        keep(self, **{name: self._checked(name, value) for name, value in given.items()})
        texts = {"law": law, "preset": preset, "mixing": mixing}
        keep(self, **{name: as_text(f"tissue {name}", text) for name, text in texts.items()})

    def _checked(self, name: str, value: ArrayLike | None) -> Floats | None:
        """One of the arrays, with a row for each tet or a single one."""
        wanted = TISSUE_ARRAYS[self.kind]
        if value is None:
            if name in wanted and (self.kind, name) not in TISSUE_OPTIONAL:
                raise CaseInputError(f"tissue of kind {self.kind!r} lacks {name!r}")
            return None
        if name not in wanted:
            raise CaseInputError(f"tissue of kind {self.kind!r} takes no {name!r}")
        array, tail = as_floats(f"tissue {name}", value), wanted[name]
        if array.shape == tail:
            array = array[np.newaxis]
        if array.shape[1:] != tail or array.ndim != 1 + len(tail):
            shape = ", ".join(str(n) for n in ("m", *tail))
            raise CaseInputError(f"tissue {name} has shape {array.shape}: ({shape}) is needed")
        return frozen(array)

    def arrays(self) -> dict[str, Floats]:
        """The arrays of this kind of tissue, by name."""
        return {
            name: getattr(self, name)
            for name in TISSUE_ARRAYS[self.kind]
            if getattr(self, name) is not None
        }
