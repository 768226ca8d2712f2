"""The parameters that distinguish one phantom from another."""

from dataclasses import dataclass, fields
from types import MappingProxyType

import numpy as np

from cmfsim.errors import CaseInputError
from cmfsim.values.checks import as_number

# Lowest and highest value of each parameter. Within them every part stays inside the skin.
PARAMETER_RANGES = MappingProxyType({
    "scale": (0.85, 1.15), "face_height": (0.92, 1.10), "nose_length": (-4.0, 5.0),
    "nose_projection": (-4.0, 5.0), "lip_fullness": (0.7, 1.3), "lip_gap": (0.0, 8.0),
    "chin_projection": (-5.0, 5.0), "jaw_width": (0.92, 1.08), "mandible_advance": (-6.0, 6.0),
    "fat_thickness": (-1.0, 5.0), "asymmetry": (-5.0, 5.0), "bite_gap": (1.0, 6.0),
})  # fmt: skip


@dataclass(frozen=True)
class HeadParameters:
    """The measures of one person.

    Attributes
    ----------
    scale : float
        Size of the whole head, 0.85 to 1.15.
    face_height : float
        Height of the face below the nasion, 0.92 to 1.10; 1 gives 114 mm nasion to menton.
    nose_length, nose_projection : float, mm
        How much lower, and how much further forward the tip of the nose lies; −4 to 5.
    lip_fullness : float
        0.7 to 1.3.
    lip_gap : float, mm
        Height of the opening between the lips; 0 (closed) to 8.
    chin_projection : float, mm
        Chin further forward, on bone and skin; −5 to 5.
    jaw_width : float
        Width of mandible and lower face, 0.92 to 1.08.
    mandible_advance : float, mm
        Longer mandible: negative is towards class II, positive towards class III; −6 to 6.
    fat_thickness : float, mm
        Fat beyond the ordinary, −1 to 5.
    asymmetry : float, mm
        How far the chin lies to the left of the midline, −5 to 5.
    bite_gap : float, mm
        Distance of the upper from the lower teeth at the incisors, 1 to 6: the mandible turns about
        its condyles.

    Raises
    ------
    CaseError
        (also `ValueError`) A value outside its range, or no number.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.HeadParameters(face_height=1.05).face_height
    1.05
    """

    scale: float = 1.0
    face_height: float = 1.0
    nose_length: float = 0.0
    nose_projection: float = 0.0
    lip_fullness: float = 1.0
    lip_gap: float = 0.0
    chin_projection: float = 0.0
    jaw_width: float = 1.0
    mandible_advance: float = 0.0
    fat_thickness: float = 0.0
    asymmetry: float = 0.0
    bite_gap: float = 1.0

    def __post_init__(self) -> None:
        for item in fields(self):
            value = as_number(item.name, getattr(self, item.name))
            low, high = PARAMETER_RANGES[item.name]
            if not low <= value <= high:
                raise CaseInputError(
                    f"{item.name} is {value:g}: use a value from {low:g} to {high:g}"
                )
            object.__setattr__(self, item.name, value)

    @classmethod
    def random(cls, seed: int) -> "HeadParameters":
        """A plausible person; the same for the same seed.

        Lips are closed and teeth in occlusion, so that people differ by build alone.

        Examples
        --------
        >>> import cmfsim
        >>> cmfsim.HeadParameters.random(1) == cmfsim.HeadParameters.random(1)
        True
        """
        generator = np.random.default_rng(seed)
        values = {}
        for name, (low, high) in PARAMETER_RANGES.items():
            # Two throws: the middle of each range is commoner than its ends.
            value = float(low + (high - low) * generator.random(2).mean())
            if name not in {"lip_gap", "bite_gap"}:
                values[name] = value
        return cls(**values)
