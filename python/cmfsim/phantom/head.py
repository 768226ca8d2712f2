"""The skin of the phantom, and its landmarks."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Protocol

import numpy as np

from cmfsim.phantom.grid import Field, to_surface
from cmfsim.phantom.parameters import FaceWarp, HeadParameters, JawWarp
from cmfsim.phantom.shapes import (
    Blend,
    Box,
    Egg,
    Engraving,
    Level,
    Loft,
    Plane,
    Step,
    Table,
    Tube,
    smooth_curve,
    turn_about_z,
)
from cmfsim.values.checks import Floats, frozen

# The box of the head, mm, with the neck cut off below.
NECK_CUT = -122.0
HEAD_BOX = Box((0.0, -140.0, NECK_CUT), (100.0, 115.0, 145.0))


def _tube(points: list[list[float]], steps: int = 4) -> Tube:
    return Tube.round(smooth_curve(points, steps))


def _engrave(points: list[list[float]], width: float, behind: float = -40.0) -> Engraving:
    """An engraving through rows of x, z, depth."""
    rows = smooth_curve(points, 4)
    return Engraving(rows[:, :2], width, rows[:, 2], behind)


def skin_shape(p: HeadParameters) -> Blend:
    """The skin of one person in the canonical frame."""
    steps: list[Step | Engraving] = [*_head(p), *_eyes(), *_nose(p), *_mouth(p), *_ear()]
    steps.append(Step("meet", Plane((0.0, 0.0, NECK_CUT), (0.0, 0.0, -1.0)), 0.0))
    return Blend(tuple(steps), HEAD_BOX)


def _head(p: HeadParameters) -> list[Step | Engraving]:
    """Vault, face without features, jaw, chin and neck."""
    fat = p.fat_thickness
    vault = Egg((0, 4, 50), (77, 101, 70), (77, 97, 84), power=2.25)
    chin = -p.chin_projection
    return [
        Step("join", vault),
        Step("join", _lower_face(fat), 10.0),
        Step("join", _neck(fat), 12.0),
        # Cheekbones, cheeks, the muzzle that the lips lie on, and the chin.
        Step("join", Egg((42, -58, -4), (22 + 0.4 * fat, 24, 17)), 12.0),
        Step("join", Egg((36, -62, -30), (16 + fat, 18 + 0.5 * fat, 20)), 12.0),
        Step("join", Egg((0, -72, -40), (31, 27, 28), power=2.3), 10.0),
        Step("join", Egg((0, -86, -30), (15, 15.5, 15)), 10.0),
        Step("join", Egg((20, -77, -18), (15, 14, 20)), 12.0),
        Step("join", Egg((0, -81 + chin, -75), (24, 18, 15), power=2.2), 12.0),
        Step("join", Egg((42, -25, -55), (13 + fat, 18, 14)), 12.0),
        # Brow ridge and glabella.
        Step("join", _tube([[0, -89, 43, 8], [14, -88, 41, 8.5], [30, -83, 42, 8], [46, -71, 37, 7],
                            [53.5, -61, 25, 6.5], [54.5, -59.5, 12, 6.5], [54, -60, 2, 5]]), 9.0),
    ]  # fmt: skip


def _lower_face(fat: float) -> Blend:
    """The face below the vault, cut off along the lower border of the jaw."""
    # The section widens to the cheekbones and dives under the vault above the brows.
    z = (-95.0, -80.0, -65.0, -50.0, -35.0, -20.0, -5.0, 10.0, 25.0, 40.0, 55.0, 70.0)
    front = (-86.0, -92.0, -93.0, -93.0, -93.0, -92.0, -90.0, -88.0, -90.0, -93.0, -87.0, -72.0)
    width = (48.0, 53.0, 57.5, 61.0, 64.0, 68.5, 72.5, 73.5, 73.0, 70.0, 62.0, 50.0)
    power = (1.9, 1.95, 2.0, 2.1, 2.15, 2.25, 2.35, 2.3, 2.2, 2.2, 2.2, 2.2)
    back = (0.0, 4.0, 8.0, 14.0, 20.0, 28.0, 35.0, 40.0, 42.0, 40.0, 34.0, 24.0)
    face = Loft(
        middle=-16.0,
        front=Table(z, [v - 0.5 * fat for v in front]),
        back=Table(z, back),
        width=Table(z, [v + fat for v in width]),
        power=Table(z, power),
        box=Box((0, -110, -110), (80, 60, 80)),
    )
    jaw_slope = 0.36
    length = float(np.hypot(1.0, jaw_slope))
    jaw = Plane((0, -92, -89 - 0.6 * fat), (0, jaw_slope / length, -1.0 / length))
    return Blend(
        (
            Step("join", face),
            Step("meet", jaw, 12.0),
            Step("meet", Plane((0, 0, 62), (0, 0, 1)), 12.0),
        ),
        face.box,
    )


def _neck(fat: float) -> Tube:
    return _tube([[0, 21, -150, 53 + fat], [0, 16, -95, 48 + fat], [0, 14, -55, 47 + 0.5 * fat],
                  [0, 18, -20, 48], [0, 22, 15, 48]], 12)  # fmt: skip


def _eyes() -> list[Step | Engraving]:
    """Hollows of the eyes, eyeballs under closed lids, the slit and the lid crease."""
    return [
        Step("cut", Egg((32, -98, 19), (19, 13, 12), turn=turn_about_z(18)), 9.0),
        Step("join", Egg((31.5, -75.5, 18.5), (15, 12.4, 12.6)), 6.0),
        # Slit between the lids, the lower rim of the lower lid, the crease above.
        _engrave([[16.5, 17.5, 0.5], [23, 14.6, 1.2], [31, 13.2, 1.3], [39, 14.6, 1.2],
                  [46, 18.0, 0.4]], 2.0, -50.0),
        _engrave([[17, 19, 0.2], [23, 24.0, 0.8], [31, 26.2, 1.1], [39, 25.0, 0.9],
                  [46.5, 20.5, 0.2]], 2.6, -50.0),
        _engrave([[18, 13, 0.1], [24, 8.0, 0.4], [34, 5.0, 0.4], [43, 7, 0.0]], 4.0, -50.0),
    ]  # fmt: skip


def _nose(p: HeadParameters) -> list[Step | Engraving]:
    """Bridge, side walls, tip, wings, column and nostrils."""
    out, down = -p.nose_projection, -p.nose_length
    tip_y, tip_z = -113.0 + out, -7.0 + down
    return [
        Step("join", _tube([[0, -87.5, 34, 6.0], [0, -91.5 + 0.2 * out, 22, 6.2],
                            [0, -98.5 + 0.6 * out, 9 + 0.4 * down, 7.2],
                            [0, -106.5 + 0.9 * out, -0.5 + 0.8 * down, 7.6],
                            [0, tip_y, tip_z, 7.8]]), 8.0),
        Step("join", Egg((5.5, -92 + 0.5 * out, 1 + 0.5 * down), (9.0, 9, 15)), 8.0),
        Step("join", Egg((0, -102 + 0.6 * out, -10 + down), (12.0, 15, 8.5)), 6.0),
        Step("join", Egg((3.2, tip_y - 0.2, tip_z), (5.5, 7.6, 7)), 4.0),
        Step("join", Egg((7.5, -103 + 0.7 * out, -6.5 + down), (7.0, 9.5, 8)), 6.0),
        # Wings.
        Step("join", Egg((12.2, -102.0 + 0.6 * out, -12.0 + down), (5.2, 8.5, 7.2),
                         turn=turn_about_z(14)), 3.5),
        # Column.
        Step("join", _tube([[0, tip_y - 2, tip_z - 6, 3.4], [0, -103, -17.5 + down, 4.2]]), 4.0),
        # Nostrils.
        Step("cut", Egg((6.6, -107 + 0.7 * out, -20.0 + down), (2.8, 5.8, 5.0),
                        turn=turn_about_z(24)), 2.0),
        # Fold behind the wing.
        _engrave([[9, -2 + down, 0.1], [13.5, -3 + down, 0.8], [17.4, -8 + down, 1.2],
                  [18.2, -14 + down, 1.2], [15, -20 + down, 0.6]], 3.0, -85.0),
    ]  # fmt: skip


def _mouth(p: HeadParameters) -> list[Step | Engraving]:
    """Lips, mouth line or slit, philtrum, and the folds about the mouth."""
    full, gap = p.lip_fullness, 0.5 * p.lip_gap
    upper = [
        [0, -99.4, -38.9 + gap, 5.0 * full],
        [4.5, -99.8, -38.2 + gap, 5.3 * full],
        [12, -96.6, -40.0 + 0.8 * gap, 4.3 * full],
        [19, -91.7, -42.2 + 0.4 * gap, 2.9 * full],
        [25, -86.5, -43.9, 1.4],
    ]
    lower = [
        [0, -97.0, -49.0 - gap, 5.3 * full],
        [8, -96.2, -48.8 - gap, 5.2 * full],
        [15, -92.8, -47.3 - 0.6 * gap, 4.1 * full],
        [24.0, -86.5, -44.4, 1.3],
    ]
    line = [[0, -44.6, 2.4], [5, -43.9, 2.3], [12, -44.2, 2.1], [20, -44.4, 1.8], [26, -44.8, 0.6]]
    steps: list[Step | Engraving] = [
        Step("join", _tube(upper), 1.6),
        Step("join", _tube(lower), 2.0),
        _engrave(line, 1.9, -70.0),
        # Philtrum and its ridges.
        _engrave([[0, -22, 0.3], [0, -29, 1.0], [0, -34, 0.9]], 4.2, -80.0),
        _engrave([[4.0, -23, -0.1], [5.0, -29, -0.4], [5.8, -34, -0.5]], 3.6, -80.0),
        # Fold from nose to mouth, corner of the mouth, fold between lip and chin.
        _engrave([[18, -12, 0.2], [24, -23, 0.9], [29, -34, 0.9], [32, -45, 0.1]], 6.0),
        _engrave([[25.0, -44.4, 0.7], [27.5, -46, 0.3]], 3.5),
        _engrave([[0, -60, 2.6], [10, -59.5, 2.2], [19, -57, 0.8], [24, -54, 0.1]], 7.0),
    ]
    if gap > 0.0:
        slit = Tube(
            np.array([[0, -98, -44.4], [12, -96, -44.0], [25.0, -89, -44.5]], dtype=np.float64),
            np.array([[0, 0, 1]] * 3, dtype=np.float64),
            np.array([gap, 0.8 * gap, 0.2]),
            np.array([9.0, 8.0, 5.0]),
        )
        steps.append(Step("cut", slit, 1.0))
    return steps


def _ear() -> list[Step | Engraving]:
    """An auricle with helix, concha, tragus and lobule."""
    turn = turn_about_z(-20)
    helix = [
        [72, -6, 4, 2.2],
        [75, -9, 16, 2.4],
        [79, -3, 27, 2.6],
        [83, 9, 31, 2.7],
        [86, 20, 24, 2.7],
        [86, 22, 8, 2.5],
        [83, 15, -10, 2.5],
        [78.5, 6, -22, 3.2],
        [75, 0, -26, 3.6],
        [72.5, -4, -21, 3.2],
        [71, -6, -12, 2.4],
    ]
    return [
        Step("join", Egg((77, 8, 4), (3.6, 15.5, 27), power=2.2, turn=turn), 3.0),
        Step("join", _tube(helix, 4), 2.4),
        # Antihelix, then the hollows on either side of it.
        Step("cut", Egg((82.5, 3, 0), (5.5, 8.0, 11), turn=turn), 2.5),
        Step("cut", Egg((85.5, 13, 18), (3.5, 6.5, 8), turn=turn), 2.5),
        Step("join", Egg((73.5, -7.5, -1), (3.6, 3.0, 5.5)), 2.5),
    ]


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
    """What landmarks and muscles must know of the head."""

    @property
    def warp(self) -> FaceWarp:
        """From the person's space to the symmetric head."""

    def drawn_level(self, name: str, x: Level, y: Level, z: Level) -> Level:
        """The level of a part in the symmetric head."""

    def unmoved_level(self, name: str, x: Level, y: Level, z: Level) -> Level:
        """The level before the jaw's map."""

    def skin_and_bone(self, x: Level, y: Level, z: Level) -> tuple[Level, Level]:
        """The levels of the skin, and of all bones and teeth, in the symmetric head."""


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
