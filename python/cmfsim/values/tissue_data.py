"""Tissue: what the tets of a mesh are made of."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from cmfsim.checks import (
    Floats,
    as_floats,
    as_text,
    check_one_of,
    frozen,
)
from cmfsim.errors import CaseInputError
from cmfsim.values.frozen import Frozen

__all__ = ["MIXINGS", "TISSUE_ARRAYS", "TISSUE_OPTIONAL", "TissueData"]

# Arrays that each kind of tissue needs, with the number of axes after the first.
TISSUE_ARRAYS: Mapping[str, Mapping[str, tuple[int, ...]]] = MappingProxyType(
    {
        "isotropic": {"young": (), "poisson": ()},
        "transversely_isotropic": {
            "young_along": (),
            "young_across": (),
            "poisson": (),
            "fibre": (3,),
        },
        "stiffness": {"stiffness": (6, 6)},
        "preset": {"fraction": (), "fibre": (3,)},
    }
)
# Arrays of the above that may be left out.
TISSUE_OPTIONAL = frozenset({("preset", "fibre")})
# How the constants of fat and muscle mix: each modulus, or the whole stiffness.
MIXINGS = ("moduli", "stiffness")


@dataclass(frozen=True, eq=False)
class TissueData(Frozen):
    """What the tets are made of, as the arrays that `cmfsim.Tissue` takes.

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
    young: ArrayLike | None = None
    poisson: ArrayLike | None = None
    young_along: ArrayLike | None = None
    young_across: ArrayLike | None = None
    fibre: ArrayLike | None = None
    stiffness: ArrayLike | None = None
    fraction: ArrayLike | None = None
    law: str = "spencer"
    preset: str = "kim2010"
    mixing: str = "moduli"

    def __post_init__(self) -> None:
        check_one_of("tissue kind", self.kind, tuple(TISSUE_ARRAYS))
        wanted = TISSUE_ARRAYS[self.kind]
        for name in sorted({n for arrays in TISSUE_ARRAYS.values() for n in arrays}):
            value = getattr(self, name)
            if name not in wanted:
                if value is not None:
                    raise CaseInputError(f"tissue of kind {self.kind!r} takes no {name!r}")
            elif value is not None:
                array = as_floats(f"tissue {name}", value)
                tail = wanted[name]
                if array.shape == tail:
                    array = array[np.newaxis]
                if array.shape[1:] != tail or array.ndim != 1 + len(tail):
                    shape = ", ".join(str(n) for n in ("m", *tail))
                    raise CaseInputError(
                        f"tissue {name} has shape {array.shape}: ({shape}) is needed"
                    )
                object.__setattr__(self, name, frozen(array))
            elif (self.kind, name) not in TISSUE_OPTIONAL:
                raise CaseInputError(f"tissue of kind {self.kind!r} lacks {name!r}")
        for name in ("law", "preset", "mixing"):
            as_text(f"tissue {name}", getattr(self, name))

    def arrays(self) -> dict[str, Floats]:
        """The arrays of this kind of tissue, by name."""
        return {
            name: np.asarray(getattr(self, name), dtype=np.float64)
            for name in TISSUE_ARRAYS[self.kind]
            if getattr(self, name) is not None
        }
