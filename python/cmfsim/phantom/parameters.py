"""The parameters that distinguish one phantom from another, and the warp that they make."""

from dataclasses import dataclass, fields
from types import MappingProxyType

import numpy as np

from cmfsim.errors import CaseInputError
from cmfsim.phantom.shapes import REACH, Box, Level, Shape, smooth_step
from cmfsim.values.checks import Floats, as_number

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


Triple = tuple[Level, Level, Level]

# The face is stretched from the nasion down to below the chin, mm above the Frankfort plane.
STRETCH_TOP, STRETCH_BOTTOM, STRETCH_ROUNDING = 32.0, -95.0, 10.0
# The chin leaves the midline from below the orbits to the chin, and in front of the ears only, mm.
LEAN_TOP, LEAN_BOTTOM, LEAN_BACK, LEAN_FRONT = 10.0, -75.0, 5.0, -50.0
# Axis through the condyles: y and z, mm; and its distance to the lower incisors.
HINGE_Y, HINGE_Z, LEVER = -13.0, -5.0, 75.0
# The body of the mandible lengthens from the ramus to the premolars, mm.
GROW_BACK, GROW_FRONT = -28.0, -64.0


@dataclass(frozen=True)
class FaceWarp:
    """The map between a person's space and the symmetric head, and back.

    It holds scale, face height and asymmetry: x' depends on all, y and z on themselves alone.
    """

    parameters: HeadParameters

    def inverse(self, x: Level, y: Level, z: Level) -> Triple:
        """Places in the symmetric head."""
        p = self.parameters
        kind = x.dtype
        x, y, z = x / p.scale, y / p.scale, z / p.scale
        lean = smooth_step(z, LEAN_TOP, LEAN_BOTTOM) * smooth_step(y, LEAN_BACK, LEAN_FRONT)
        x_drawn = x - p.asymmetry * lean if p.asymmetry else x
        z_drawn = z + (1.0 / p.face_height - 1.0) * _ramp(z) if p.face_height != 1.0 else z
        return x_drawn.astype(kind), y.astype(kind), z_drawn.astype(kind)

    def forward(self, points: Floats) -> Floats:
        """Places in the person's space, (n, 3) mm."""
        p = self.parameters
        x, y, z_drawn = np.array(points, dtype=np.float64).T
        z = z_drawn.copy()
        # z + a ramp(z) = z_drawn with |a ramp'| ≤ 0.09: each round gains a digit.
        for _ in range(40):
            z = z_drawn - (1.0 / p.face_height - 1.0) * _ramp(z)
        lean = smooth_step(z, LEAN_TOP, LEAN_BOTTOM) * smooth_step(y, LEAN_BACK, LEAN_FRONT)
        return p.scale * np.column_stack([x + p.asymmetry * lean, y, z])


def _ramp(z: Level) -> Level:
    """0 above the top, slope 1 between, constant below the bottom; corners rounded."""
    return _hinge(z - STRETCH_TOP) - _hinge(z - STRETCH_BOTTOM)


def _hinge(t: Level) -> Level:
    """min(t, 0) with its corner rounded."""
    r = STRETCH_ROUNDING
    return np.where(t < -r, t, np.where(t > r, 0.0, -((t - r) ** 2) / (4.0 * r)))


@dataclass(frozen=True)
class JawWarp:
    """The map from this person's jaw to the drawn one: width, length and opening.

    soft: Whether it acts on skin, where it fades towards upper lip and neck.
    """

    parameters: HeadParameters
    soft: bool

    @property
    def idle(self) -> bool:
        """Whether nothing moves."""
        p = self.parameters
        return p.jaw_width == 1.0 and p.mandible_advance == 0.0 and p.bite_gap == 1.0

    def inverse(self, x: Level, y: Level, z: Level) -> Triple:
        """Places in the drawn jaw."""
        p = self.parameters
        kind = x.dtype
        angle = (p.bite_gap - 1.0) / LEVER
        wide = (p.jaw_width - 1.0) * smooth_step(z, -2.0, -45.0)
        if self.soft:
            share = smooth_step(z, -38.0, -54.0) * smooth_step(z, -118.0, -88.0)
            wide = wide * smooth_step(z, -118.0, -80.0) * smooth_step(y, 20.0, -15.0)
            dz = angle * np.maximum(HINGE_Y - y, 0.0) * share
            z_drawn = z + dz
            y_drawn = y + p.mandible_advance * _growth(y, p.mandible_advance) * share
        else:
            c, s = np.cos(angle), np.sin(angle)
            # Opening turns the chin down and back about the x axis through the condyles.
            v, w = y - HINGE_Y, z - HINGE_Z
            y_shut = c * v + s * w + HINGE_Y
            z_drawn = -s * v + c * w + HINGE_Z
            y_drawn = y_shut + p.mandible_advance * _growth(y_shut, p.mandible_advance)
        return (x / (1.0 + wide)).astype(kind), y_drawn.astype(kind), z_drawn.astype(kind)

    def forward(self, points: Floats) -> Floats:
        """Places in the person's jaw, (n, 3) mm: the inverse of `inverse`, by fixed point."""
        target = np.array(points, dtype=np.float64)
        place = target.copy()
        for _ in range(60):
            back = np.column_stack(self.inverse(place[:, 0], place[:, 1], place[:, 2]))
            place += target - back
        return place


def _growth(y: Level, advance: float) -> Level:
    """How much of the advance is reached: all of it before the premolars, none at the ramus."""
    return smooth_step(y, GROW_BACK, GROW_FRONT - advance)


@dataclass(frozen=True, eq=False)
class JawWarped:
    """A shape that the jaw's map moves."""

    shape: Shape
    warp: JawWarp

    @property
    def box(self) -> Box:
        """Where the level can be above 0."""
        return self.shape.box.grown(REACH)

    def level(self, x: Level, y: Level, z: Level) -> Level:
        """The level of the drawn shape where the point comes from."""
        if self.warp.idle:
            return self.shape.level(x, y, z)
        return self.shape.level(*self.warp.inverse(x, y, z))
