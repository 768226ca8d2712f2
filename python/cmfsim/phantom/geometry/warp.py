"""How one person differs from the next by moving space: size, height, asymmetry, jaw.

Shapes are drawn once, for a symmetric head of ordinary size with its teeth closed. A person is that
head seen through a map from the person's space back to the drawn one.
"""

from dataclasses import dataclass

import numpy as np

from cmfsim.phantom.geometry.shapes import REACH, Box, Level, Shape, smooth_step
from cmfsim.phantom.parameters import HeadParameters
from cmfsim.values.checks import Floats

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
