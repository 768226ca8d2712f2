"""The open mouth of a virtual patient: lips apart down to the tooth rows, and no tissue between.

The slit in the skin of the phantom ends in front of the teeth, as on a CT. Lips that touch and
slide need separate surfaces: here the slit extends from corner to corner and back to the space
between the tooth rows. Everything is a level function, so that the surfaces of the mesh are smooth.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cmfsim._core import Surface, signed_distance_image
from cmfsim.errors import CaseInputError
from cmfsim.phantom import PhantomHead
from cmfsim.phantom.parameters import JawWarp
from cmfsim.phantom.skull import UPPER_ARCH
from cmfsim.values.anatomy import Anatomy
from cmfsim.values.checks import Floats

# The slit between the lips in the canonical head, mm: distance from the midline and height of its
# line, as in the phantom's skin. Its thickness is constant almost to the corner, because the mesh
# does not resolve a slit that narrows like the skin's.
DISTANCE = np.array([0.0, 12.0, 25.0])
LINE = np.array([-44.4, -44.0, -44.5])
# It is rounded from here to its end, mm from the midline: the corner of the mouth.
ROUNDED_FROM, CORNER = 20.0, 23.5
# Smallest gap between the lips of the phantom, mm: a narrower slit closes in the mesh.
LEAST_GAP = 1.0
# Extent of the lips above and below the line of the mouth, to the side, and past the middle of the
# tooth rows, mm. The parts that may touch the other lip are smaller by a margin, so that no closest
# point is at a border.
LIP_HEIGHT, LIP_SIDE, LIP_BACK = 16.0, 25.0, 4.0
MARGIN = 4.0
# Spacing of the surfaces of the tooth rows, and the range of their distances, mm.
TEETH_SPACING, TEETH_REACH = 1.0, 12.0


@dataclass(frozen=True, eq=False)
class MouthSlit:
    """The slit between the lips of a phantom.

    head: With a gap between the lips of `LEAST_GAP` or more.
    Raises `CaseError`: The gap is smaller.
    """

    head: PhantomHead

    def __post_init__(self) -> None:
        gap = self.head.parameters.lip_gap
        if gap < LEAST_GAP:
            raise CaseInputError(
                f"lip_gap is {gap:g} mm: {LEAST_GAP:g} mm or more is needed where lips are "
                "separate, because the mesh does not resolve a narrower slit"
            )

    def _drawn(self, points: Floats) -> tuple[Floats, Floats, Floats]:
        """Distance from the midline, front-to-back position, height in the canonical head, mm."""
        p = self.head.parameters
        u, v, w = self.head.warp.inverse(*points.T)
        u, v, w = JawWarp(p, soft=True).inverse(np.abs(u), v, w)
        return np.asarray(u), np.asarray(v), np.asarray(w)

    def height(self, points: Floats) -> Floats:
        """Height of points (k, 3) above the line of the mouth, (k,) mm; negative below it."""
        u, _, w = self._drawn(points)
        height: Floats = self.head.parameters.scale * (w - np.interp(u, DISTANCE, LINE))
        return height

    def level(self, points: Floats) -> Floats:
        """The level of the slit at points (k, 3), (k,) mm: positive between the lips."""
        p = self.head.parameters
        u, v, w = self._drawn(points)
        past = np.clip((u - ROUNDED_FROM) / (CORNER - ROUNDED_FROM), 0.0, 1.0)
        half = 0.5 * p.lip_gap * np.sqrt(1.0 - past**2) - np.maximum(u - CORNER, 0.0)
        level = half - np.abs(w - np.interp(u, DISTANCE, LINE))
        # It ends in the middle of the upper tooth row.
        slit: Floats = p.scale * np.minimum(level, _arch(u) - v)
        return slit

    def lips(self, points: Floats, margin: float = 0.0) -> NDArray[np.int8]:
        """The lip to which points (k, 3) belong, (k,): 1 the upper, −1 the lower, 0 none.

        With a margin, mm, only points further inside than that count.
        """
        u, v, _ = self._drawn(points)
        height = self.height(points)
        near = (u < LIP_SIDE - margin) & (np.abs(height) < LIP_HEIGHT - margin)
        near &= v < _arch(u) + LIP_BACK - margin
        return np.where(near, np.sign(height), 0.0).astype(np.int8)


def _arch(u: Floats) -> Floats:
    """Position from front to back of the middle line of the upper tooth row, mm."""
    x, y = np.array(UPPER_ARCH).T
    position: Floats = np.interp(u, x, y)
    return position


def with_open_mouth(head: PhantomHead, anatomy: Anatomy, bite: float) -> Anatomy:
    """The anatomy without tissue in the slit between the lips and between the tooth rows.

    anatomy: Level images of it.
    bite: mm. There is no tissue where the distances to both tooth rows add up to less than this.
    Raises `CaseError`: The gap between the lips is smaller than `LEAST_GAP`.
    """
    slit = MouthSlit(head)
    skin = anatomy.skin
    spacing, lowest = skin.spacing, skin.lowest
    rows = [head.surface(name, TEETH_SPACING) for name in ("upper_teeth", "lower_teeth")]
    places = np.vstack([row.vertices for row in rows])
    low, high = places.min(axis=0) - TEETH_REACH, places.max(axis=0) + TEETH_REACH
    # The slit begins in front of the lips.
    low[1] -= 2.0 * TEETH_REACH
    first = np.maximum(np.floor((low - lowest) / spacing).astype(int), 0)
    last = np.minimum(np.ceil((high - lowest) / spacing).astype(int) + 1, skin.values.shape)
    start = lowest + first * spacing
    shape = (int(last[0] - first[0]), int(last[1] - first[1]), int(last[2] - first[2]))
    axes = [start[a] + spacing[a] * np.arange(shape[a]) for a in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    air = slit.level(points).reshape(shape)
    between = np.full(shape, float(bite))
    step, corner = (float(s) for s in spacing), (float(c) for c in start)
    sx, sy, sz = step
    x, y, z = corner
    for row in rows:
        surface = Surface(row.vertices, row.triangles)
        between += signed_distance_image(surface, shape, (sx, sy, sz), (x, y, z), band=TEETH_REACH)
    # Half, because the sum of two distances changes twice as fast as one of them.
    air = np.maximum(air, 0.5 * between)
    values = np.array(skin.values)
    index = tuple(slice(a, b) for a, b in zip(first, last, strict=True))
    values[index] = np.minimum(values[index], -air.astype(values.dtype))
    return replace(anatomy, skin=skin.with_values(values))
