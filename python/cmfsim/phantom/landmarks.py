"""Skull and skin landmarks of the phantom, found on its surfaces by their definitions."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Protocol

import numpy as np

from cmfsim.phantom.geometry.shapes import Level
from cmfsim.phantom.grid import Field, to_surface
from cmfsim.phantom.parameters import FaceWarp, HeadParameters, JawWarp
from cmfsim.values.checks import Floats, frozen

# Rays are sampled at this step before the crossing is halved down, mm.
RAY_STEP = 1.0
# Halvings of the last step of a ray; the projection onto the surface does the rest.
HALVINGS = 10
# Lines on which extremes are sought lie this far apart, mm.
SCAN_STEP, SIDE_STEP = 0.25, 1.5
FRONT, BACK, UP = np.array([0.0, -1, 0]), np.array([0.0, 1, 0]), np.array([0.0, 0, 1])
INWARD = np.array([-1.0, 0, 0])
# Height above the glabella where the forehead begins to rise, mm.
SUPRAGLABELLA = 15.0

# Where the red of a lip ends, as a share of the radius of the lip above its middle.
LIP_BORDER = 0.8


class Drawn(Protocol):
    """What landmarks must know of the head."""

    @property
    def warp(self) -> FaceWarp:
        """From the person's space to the symmetric head."""

    def drawn_level(self, name: str, x: Level, y: Level, z: Level) -> Level:
        """The level of a part in the symmetric head."""

    def unmoved_level(self, name: str, x: Level, y: Level, z: Level) -> Level:
        """The level before the jaw's map."""


def _first_hit(field: Field, starts: Floats, direction: Floats, length: float) -> Floats:
    """The first points inside along rays, (n, 3) mm; NaN where a ray meets nothing."""
    steps = np.arange(0.0, length, RAY_STEP)
    places = starts[:, None, :] + steps[None, :, None] * direction
    inside = field(*places.reshape(-1, 3).T).reshape(len(starts), -1) > 0.0
    found = inside.any(axis=1)
    first = np.argmax(inside, axis=1)
    high = steps[first]
    low = high - RAY_STEP
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        deep = field(*(starts + middle[:, None] * direction).T) > 0.0
        high, low = np.where(deep, middle, high), np.where(deep, low, middle)
    hit: Floats = starts + high[:, None] * direction
    hit[~found] = np.nan
    return hit


def _front(field: Field, x: float, low: float, high: float) -> Floats:
    """The foremost points in the sagittal section at x, from z = low to high."""
    z = np.arange(low, high + SCAN_STEP, SCAN_STEP)
    starts = np.column_stack([np.full_like(z, x), np.full_like(z, -135.0), z])
    return _hits(_first_hit(field, starts, BACK, 75.0))


def _side(field: Field, y: Floats, z: Floats, start: float = 74.0, length: float = 48.0) -> Floats:
    """The outermost points at places of y and z, all pairs."""
    v, w = (np.arange(a[0], a[-1] + 0.1, SIDE_STEP) for a in (y, z))
    v, w = (grid.ravel() for grid in np.meshgrid(v, w))
    starts = np.column_stack([np.full_like(v, start), v, w])
    return _hits(_first_hit(field, starts, INWARD, length))


def _hits(points: Floats) -> Floats:
    return points[np.isfinite(points).all(axis=1)]


def _extreme(points: Floats, direction: Floats) -> Floats:
    """The point that lies furthest in a direction."""
    furthest: Floats = points[int(np.argmax(points @ direction))]
    return furthest


def _scan(low: float, high: float) -> Floats:
    return np.arange(low, high + SCAN_STEP, SCAN_STEP)


def find_skull_landmarks(head: Drawn) -> Mapping[str, Floats]:
    """The 32 bone sites, (3,) mm each, in the person's space."""

    def cranium(x: Level, y: Level, z: Level) -> Level:
        return head.unmoved_level("cranium", x, y, z)

    def jaw(x: Level, y: Level, z: Level) -> Level:
        return head.unmoved_level("mandible", x, y, z)

    glabella = _extreme(_front(cranium, 0.0, 38.0, 54.0), FRONT)
    above = glabella[2] + SUPRAGLABELLA
    fixed = {
        "supraglabella": _front(cranium, 0.0, above, above)[0],
        "glabella": glabella,
        "nasion": _extreme(_front(cranium, 0.0, 24.0, 38.0), BACK),
        "rhinion": _extreme(_front(cranium, 0.0, 4.0, 16.0), FRONT),
        "mid_philtrum": _extreme(_front(cranium, 0.0, -29.0, -22.5), BACK),
        "supradentale": _front(cranium, 0.0, -32.5, -32.5)[0],
        "frontal_eminence_L": _front(cranium, 31.5, 68.0, 68.0)[0],
        "supraorbital_L": _extreme(_front(cranium, 31.5, 30.0, 46.0), FRONT - UP),
        "suborbital_L": _extreme(_front(cranium, 31.5, -10.0, 6.0), FRONT + UP),
        "inferior_malar_L": _front(cranium, 31.5, -16.0, -16.0)[0],
        "lateral_orbit_L": _side(cranium, np.array([-64.0]), np.array([4.0]))[0],
        "zygomatic_arch_L": _extreme(_side(cranium, _scan(-46, -22), _scan(-3, 6)), -INWARD),
        "supraglenoid_L": _extreme(_side(cranium, np.array([-12.0]), _scan(2, 12)), -INWARD),
        "supra_m2_L": _side(cranium, np.array([-50.0]), np.array([-27.0]))[0],
    }
    moved = {
        "infradentale": _front(jaw, 0.0, -53.5, -53.5)[0],
        "supramentale": _extreme(_front(jaw, 0.0, -66.0, -55.0), BACK),
        "pogonion": _extreme(_front(jaw, 0.0, -80.0, -67.0), FRONT),
        "menton": _lowest(jaw),
        "gonion_L": _extreme(_side(jaw, _scan(-50, -6), _scan(-66, -34)), BACK - UP - 0.3 * INWARD),
        "occlusal_line_L": _side(jaw, np.array([-38.0]), np.array([-45.0]))[0],
        "sub_m2_L": _side(jaw, np.array([-49.0]), np.array([-62.0]))[0],
    }
    return _in_person(head, fixed, moved, soft=False, fields=("cranium", "mandible"))


def _lowest(field: Field) -> Floats:
    """The lowest midline point of the mandible."""
    y = _scan(-98.0, -70.0)
    starts = np.column_stack([np.zeros_like(y), y, np.full_like(y, -105.0)])
    return _extreme(_hits(_first_hit(field, starts, UP, 40.0)), -UP)


def find_skin_landmarks(head: Drawn) -> Mapping[str, Floats]:
    """The 14 skin points, (3,) mm each, in the person's space."""
    p: HeadParameters = head.warp.parameters

    def skin(x: Level, y: Level, z: Level) -> Level:
        return head.unmoved_level("skin", x, y, z)

    down, gap = -p.nose_length, 0.5 * p.lip_gap
    # The corner between column and lip is where rays from in front and below reach deepest.
    rise = _scan(-25.0, 25.0)
    base = np.array([0.0, -140.0, -62.0 + down])
    starts = base + rise[:, None] * np.array([0.0, -1.0, 1.0]) / np.sqrt(2.0)
    slanted = (BACK + UP) / np.sqrt(2.0)
    upper = -38.9 + gap + LIP_BORDER * 5.0 * p.lip_fullness
    lower = -49.0 - gap - LIP_BORDER * 5.3 * p.lip_fullness
    wing = _side(skin, _scan(-112, -100), _scan(-20 + down, -5 + down), start=30.0, length=25.0)
    fixed = {
        "nasion": _extreme(_front(skin, 0.0, 24.0, 40.0), BACK),
        "pronasale": _extreme(_front(skin, 0.0, -18.0 + down, 4.0), FRONT),
        "subnasale": _extreme(_hits(_first_hit(skin, starts, slanted, 90.0)), slanted),
        "labiale_superius": _front(skin, 0.0, upper, upper)[0],
        "exocanthion_L": _front(skin, 45.5, 18.0, 18.0)[0],
        "endocanthion_L": _front(skin, 16.8, 17.5, 17.5)[0],
        "alare_L": _extreme(wing, -INWARD),
        "cheilion_L": _front(skin, 25.5, -44.7, -44.7)[0],
    }
    moved = {
        "labiale_inferius": _front(skin, 0.0, lower, lower)[0],
        "pogonion": _extreme(_front(skin, 0.0, -88.0, -64.0), FRONT),
    }
    return _in_person(head, fixed, moved, soft=True, fields=("skin", "skin"))


def _in_person(
    head: Drawn,
    fixed: Mapping[str, Floats],
    moved: Mapping[str, Floats],
    *,
    soft: bool,
    fields: tuple[str, str],
) -> Mapping[str, Floats]:
    """Landmarks of the drawn left half as points on the surfaces of the person, both sides."""
    jaw = JawWarp(head.warp.parameters, soft=soft)
    found: dict[str, Floats] = {}
    for points, name, moves in ((fixed, fields[0], soft), (moved, fields[1], True)):
        places = np.array(list(points.values()))
        if moves:
            places = jaw.forward(places)

        def level(x: Level, y: Level, z: Level, part: str = name) -> Level:
            return head.drawn_level(part, x, y, z)

        places = to_surface(level, places, longest=0.5, rounds=20)
        # Midline points stay on the midline, where the gradient has no sideways part.
        places[[not key.endswith("_L") for key in points], 0] = 0.0
        for key, place in zip(points, places, strict=True):
            found[key] = place
            if key.endswith("_L"):
                found[key.removesuffix("_L") + "_R"] = place * np.array([-1.0, 1.0, 1.0])
    order = sorted(found)
    rows = head.warp.forward(np.array([found[key] for key in order]))
    return MappingProxyType({key: frozen(row) for key, row in zip(order, rows, strict=True)})
