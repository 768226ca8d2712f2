"""The bones of the phantom: cranium with orbits, arches and nasal opening; mandible; teeth.

Canonical frame as in `head`: x to the left (x ≥ 0 drawn), y backwards, z up, mm, z = 0 the
Frankfort plane, origin midway between the ear canals. The cranium is solid: the cavities that it
encloses count as bone, as `Anatomy.bones` wants it; `brain_shape` and the like are for images.
"""

import numpy as np

from cmfsim.phantom.parameters import HeadParameters
from cmfsim.phantom.shapes import Blend, Box, Egg, Step, Tube, smooth_curve, turn_about_z

# Centre of the left condyle, mm: the mandible opens about the axis through both.
CONDYLE = (50.0, -13.0, -5.0)
# Middle line of the alveolar arch of either jaw as seen from above: x, y in mm.
UPPER_ARCH = (
    (0.0, -90.0), (9.0, -88.0), (18.0, -81.0), (24.0, -70.0), (27.5, -57.0), (28.5, -45.0),
)  # fmt: skip
LOWER_ARCH = (
    (0.0, -87.5), (8.0, -85.5), (16.5, -79.0), (23.0, -68.5), (27.0, -56.0), (29.0, -43.0),
)  # fmt: skip
# Widths along the arch of incisors, canine, premolars and molars without the third, mm.
UPPER_WIDTHS = (8.6, 6.6, 7.6, 7.0, 6.8, 10.0, 9.4)
LOWER_WIDTHS = (5.4, 6.0, 6.9, 7.1, 7.1, 10.9, 10.4)
# Half the thickness across the arch, mm, and half the height of the crown.
UPPER_DEPTHS = (3.4, 3.2, 3.9, 4.4, 4.5, 5.2, 5.1)
LOWER_DEPTHS = (2.9, 3.1, 3.7, 3.9, 4.1, 5.0, 4.9)
# Heights of the cutting edges and cusps, mm.
UPPER_EDGES = (-44.2, -43.6, -44.4, -43.6, -43.4, -43.2, -43.0)
LOWER_EDGES = (-45.2, -45.2, -45.6, -44.9, -44.7, -44.5, -44.3)
# Heights of the edges between tooth and bone, mm: prosthion and infradentale.
UPPER_NECK, LOWER_NECK = -33.5, -53.0
ROOT = 8.0


def _tube(points: list[list[float]], steps: int = 3) -> Tube:
    return Tube.round(smooth_curve(points, steps))


def _plate(rows: list[list[float]], normal: tuple[float, float, float], steps: int = 3) -> Tube:
    """A blade through rows of x, y, z, half thickness, half width."""
    curve = smooth_curve(rows, steps)
    unit = np.asarray(normal) / np.linalg.norm(normal)
    return Tube(curve[:, :3], np.tile(unit, (len(curve), 1)), curve[:, 3], curve[:, 4])


def cranium_shape() -> Blend:
    """The cranium without teeth: vault, face and base in one.

    It is the same for all: people differ by the map of the whole head, by mandible and skin.
    """
    steps = (
        *_vault(),
        *_midface(),
        *_orbits_and_arches(),
        *_alveolar_process(),
        *_nose(),
        # Joint sockets, with room for the disc about the condyle.
        Step("cut", Egg(CONDYLE, (12.0, 7.6, 7.0)), 1.5),
    )
    return Blend(steps, Box((0, -104, -46), (74, 98, 132)))


def _vault() -> tuple[Step, ...]:
    """Vault, skull base and brow, with the hollow of the temples behind its rim."""
    return (
        Step("join", Egg((0, 2, 48), (70, 93, 60), (70, 91, 80), power=2.3)),
        # Skull base down to the occiput, sphenoid, mastoid and the condyles of the neck.
        Step("join", Egg((0, 20, -2), (48, 52, 22)), 12.0),
        Step("join", Egg((0, -28, 4), (26, 26, 24)), 12.0),
        Step("join", Egg((52, 8, -12), (9, 11, 17)), 9.0),
        Step("join", Egg((46, -4, 8), (18, 22, 10)), 8.0),
        # Brow: glabella and the upper rim of the orbit.
        Step("join", _tube([[0, -85, 43, 7], [14, -84, 42, 7.5], [30, -80, 41, 7], [45, -69, 35, 6],
                            [51, -62, 26, 5.5]]), 8.0),
        # Temples are hollow behind the rim.
        Step("cut", Egg((67, -43, 18), (14, 21, 25)), 8.0),
    )  # fmt: skip


def _midface() -> tuple[Step, ...]:
    """Body of the maxilla, cheekbone and floor of the orbit."""
    return (
        # Midface: body of the maxilla, cheekbone, floor of the orbit.
        Step("join", Egg((0, -58, -4), (33, 31, 22), power=2.6), 8.0),
        Step("join", Egg((18, -62, -14), (17, 21, 18), power=2.3), 8.0),
        Step("join", Egg((46, -62, -4), (12, 10, 11), turn=turn_about_z(35)), 9.0),
        Step("join", _tube([[40, -69, -1, 6], [30, -75, 0, 5], [20, -80, 5, 5], [14, -84, 16, 5],
                            [11, -84, 30, 6]]), 6.0),
        Step("join", _tube([[48, -66, 0, 6], [52, -63, 10, 5], [51.5, -63, 20, 5],
                            [51, -62, 28, 5.5]]), 4.0),
        Step("join", _tube([[47, -62, -14, 4.5], [36, -62, -24, 5], [29, -60, -30, 5]]), 6.0),
    )  # fmt: skip


def _orbits_and_arches() -> tuple[Step, ...]:
    """The orbits with their lateral walls, and the zygomatic arches."""
    return (
        # Orbits: open cones towards the optic canal.
        Step("cut", Egg((32, -74, 18.5), (18.5, 20, 16.5), power=2.3, turn=turn_about_z(14)),
             3.0),
        Step("cut", _tube([[32, -76, 18.5, 15.5], [24, -54, 19, 11], [17, -38, 20, 3]], 10), 3.0),
        # Lateral wall of the orbit, between it and the temple.
        Step("join", _plate([[40.5, -50, 18, 1.6, 10.5], [38, -47, 18.5, 1.6, 10]],
                            (0.82, 0.57, 0)), 3.0),
        # Arch: from the cheekbone free of the temple to the ear.
        Step("join", _tube([[49, -62, -3, 6.0], [56.5, -54, -1, 4.4], [61.8, -42, 1, 3.6],
                            [63.2, -30, 2, 3.5], [61.5, -18, 3.5, 4.2], [57, -8, 5, 6.0]]), 4.0),
    )  # fmt: skip


def _alveolar_process() -> tuple[Step, ...]:
    """Upper alveolar process and palate, pterygoid processes and canine fossa."""
    return (
        # Alveolar process and palate.
        Step("join", _arch(UPPER_ARCH, -23.0, 6.2, 11.0), 5.0),
        Step("join", Egg((0, -62, -19), (24, 26, 4)), 5.0),
        # Pterygoid processes behind the molars.
        Step("join", _tube([[17, -38, 2, 7], [17, -40, -14, 5], [18, -41, -28, 3.5]]), 6.0),
        # Canine fossa.
        Step("cut", Egg((25, -88, -16), (9, 9, 9)), 8.0),
    )


def _nose() -> tuple[Step, ...]:
    """Nasal bones, the opening under them, septum and nasal spine."""
    return (
        # Nasal bones, then the opening under them.
        Step("join", _tube([[0, -82, 34, 6.5], [0, -86, 24, 5.0], [0, -92, 14, 4.5],
                            [0, -96, 9, 3.6]]), 6.0),
        Step("join", _tube([[4, -82, 32, 5.5], [6, -86, 18, 5], [7.5, -89, 8, 4.6],
                            [13.5, -85, -3, 4.6], [15, -82, -12, 5]]), 5.0),
        Step("cut", _nasal_opening(), 2.5),
        # Septum and the spine in front of it.
        Step("join", _plate([[0, -84, -6, 1.2, 9], [0, -60, -6, 1.2, 11], [0, -42, -6, 1.2, 9]],
                            (1, 0, 0)), 1.0),
        Step("join", _tube([[0, -88, -21, 3.0], [0, -93.5, -19.5, 1.6]]), 3.0),
    )  # fmt: skip


def _nasal_opening() -> Blend:
    """The bony opening of the nose and the cavity behind it."""
    return Blend(
        (
            # Pear-shaped opening, wider below, and the nasal cavity behind it.
            Step("join", Egg((4.6, -90, -11), (8.2, 16, 8.8))),
            Step("join", Egg((0, -94, 0), (6.5, 16, 10.5)), 4.0),
            Step(
                "join",
                Tube.round(np.array([[3.5, -88, -8, 7.5], [4, -60, -8, 9.0], [5, -36, -8, 8.0]])),
                5.0,
            ),
        ),
        Box((0, -115, -25), (18, -26, 10)),
    )


def _arch(curve: tuple[tuple[float, float], ...], z: float, thick: float, high: float) -> Tube:
    """The alveolar process: a wall that stands on the arch."""
    rows = smooth_curve(curve, 4)
    along = np.gradient(rows, axis=0)
    across = np.column_stack([along[:, 1], -along[:, 0], np.zeros(len(rows))])
    across /= np.linalg.norm(across, axis=1)[:, None]
    points = np.column_stack([rows, np.full(len(rows), z)])
    return Tube(points, across, np.full(len(rows), thick), np.full(len(rows), high))


def mandible_shape(p: HeadParameters) -> Blend:
    """The mandible without teeth, as it lies with the teeth 1 mm apart."""
    chin = -p.chin_projection
    body = _body()
    steps = (
        Step("join", body),
        Step("join", _arch(LOWER_ARCH, -58.5, 4.2, 6.0), 5.0),
        # Chin: mental eminence and tubercles, hollow above.
        Step("join", Egg((0, -83.6 + chin, -74.5), (11, 6.6, 8.0)), 6.0),
        Step("join", Egg((10, -80 + chin, -76), (8, 6, 6)), 8.0),
        # Ramus, angle, coronoid and condyle.
        Step("join", _plate([[45.5, -31, -50, 4.0, 14], [46.5, -27, -40, 3.6, 15.5],
                             [47.5, -25, -28, 3.4, 16], [48, -24, -20, 3.2, 15]], (1, 0, 0.08)),
             5.0),
        Step("join", Egg((44.8, -29, -48), (4.8, 13, 12)), 10.0),
        Step("join", _plate([[47.5, -36, -22, 3.0, 7], [47.8, -36.5, -11, 2.4, 5],
                             [48, -36, -5, 1.8, 3]], (1, 0, 0)), 4.0),
        Step("join", _tube([[48, -17, -26, 4.0], [49, -14.5, -14, 4.0], [50, -13, -7, 4.5]]), 4.0),
        Step("join", Egg(CONDYLE, (9.0, 4.6, 4.4), turn=turn_about_z(-14)), 3.0),
        # Notch between the two.
        Step("cut", Egg((48, -25.5, -6), (12, 7.0, 11)), 3.0),
    )  # fmt: skip
    return Blend(steps, Box((0, -98, -92), (64, -4, 6)))


def _body() -> Tube:
    rows = smooth_curve([[0, -82.5, -70.0, 5.0, 12.0], [11, -80.5, -69.5, 5.2, 12.0],
                         [22, -72.5, -65.5, 5.4, 11.5], [31, -60, -61, 5.6, 11.0],
                         [38.5, -46, -56, 5.4, 11.0], [44, -33, -50, 4.8, 12.0]], 4)  # fmt: skip
    along = np.gradient(rows[:, :2], axis=0)
    across = np.column_stack([along[:, 1], -along[:, 0], np.zeros(len(rows))])
    across /= np.linalg.norm(across, axis=1)[:, None]
    return Tube(rows[:, :3], across, rows[:, 3], rows[:, 4])


def teeth_shape(*, upper: bool) -> Blend:
    """One tooth row: crowns with roots in the bone, without third molars."""
    arch, widths = (UPPER_ARCH, UPPER_WIDTHS) if upper else (LOWER_ARCH, LOWER_WIDTHS)
    depths, edges = (UPPER_DEPTHS, UPPER_EDGES) if upper else (LOWER_DEPTHS, LOWER_EDGES)
    curve = smooth_curve(arch, 12)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    steps: list[Step] = []
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    place = 0.0
    for width, depth, edge in zip(widths, depths, edges, strict=True):
        centre = place + 0.5 * width
        place += width
        x, y = (float(np.interp(centre, length, curve[:, a])) for a in (0, 1))
        ahead = [float(np.interp(centre + 1.0, length, curve[:, a])) for a in (0, 1)]
        angle = float(np.degrees(np.arctan2(ahead[1] - y, ahead[0] - x)))
        y -= 2.2 if upper else 0.0
        turn = turn_about_z(angle)
        root = UPPER_NECK + ROOT if upper else LOWER_NECK - ROOT
        middle, half = 0.5 * (edge + root), 0.5 * abs(edge - root)
        tooth = Egg((x, y, middle), (0.5 * width - 0.05, depth, half), power=2.8, turn=turn)
        steps.append(Step("join", tooth, 0.4))
        low = np.minimum(low, tooth.box.low)
        high = np.maximum(high, tooth.box.high)
    return Blend(tuple(steps), Box(tuple(low.tolist()), tuple(high.tolist())))


def brain_shape() -> Egg:
    """The cavity of the vault: 6 mm of bone about it."""
    return Egg((0, 2, 48), (64, 87, 46), (64, 85, 74), power=2.3)


def airway_shape() -> Blend:
    """Air of the nasal cavity and the throat: the only hollows that no bone encloses."""
    steps = (
        Step("join", Tube.round(np.array([[4.6, -84, -8, 2.4], [5, -60, -7, 4.6],
                                          [5, -38, -8, 5.5]]))),
        Step("join", Tube.round(np.array([[4, -34, -8, 6.0], [3, -27, -20, 7.0], [3, -22, -60, 7.0],
                                          [0, -18, -150, 8.0]])), 4.0),
    )  # fmt: skip
    return Blend(steps, Box((0, -92, -160), (16, -8, 4)))
