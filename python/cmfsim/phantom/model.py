"""One head made by code: its surfaces as level functions, and what is drawn from them."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.case import Anatomy, ImageData
from cmfsim.checks import Floats, as_positive, as_rows, check_one_of
from cmfsim.phantom.grid import Field, level_grid, level_surface
from cmfsim.phantom.head import HEAD_BOX, skin_shape
from cmfsim.phantom.muscles import Muscle, make_muscles
from cmfsim.phantom.parameters import HeadParameters
from cmfsim.phantom.shapes import Box, Level, Shape, smooth_max
from cmfsim.phantom.skull import airway_shape, brain_shape, cranium_shape, mandible_shape, teeth_shape
from cmfsim.phantom.warp import FaceWarp, JawWarp, JawWarped
from cmfsim.scene import SurfaceData

__all__ = ["BONES", "SURFACES", "PhantomHead", "make_head"]

BONES = ("cranium", "mandible", "upper_teeth", "lower_teeth")
SURFACES = ("skin", "cranium", "mandible", "teeth", "air", "brain")
# Soft tissue that covers bone and teeth at least, mm; the thinnest is over the nasal bones.
LEAST_COVER = 2.2
# Width over which the cover melts into the skin as drawn, mm.
COVER_MELT = 4.0
# Levels on grids are clipped to this many mm on either side.
CLIP = 3.0
# Room about the head on every image, mm.
MARGIN = 4.0


@dataclass(frozen=True, eq=False)
class PhantomHead:
    parameters: HeadParameters

    @cached_property
    def warp(self) -> FaceWarp:
        return FaceWarp(self.parameters)

    @cached_property
    def shapes(self) -> Mapping[str, Shape]:
        """The parts of the symmetric head, of which the left half is drawn."""
        p = self.parameters
        hard, soft = JawWarp(p, soft=False), JawWarp(p, soft=True)
        return MappingProxyType(
            {
                "cranium": cranium_shape(p),
                "mandible": JawWarped(mandible_shape(p), hard),
                "upper_teeth": teeth_shape(upper=True),
                "lower_teeth": JawWarped(teeth_shape(upper=False), hard),
                "air": airway_shape(),
                "brain": brain_shape(),
                "drawn_skin": JawWarped(skin_shape(p), soft),
            }
        )

    def drawn_level(self, name: str, x: Level, y: Level, z: Level) -> Level:
        """The level of a part in the symmetric head."""
        x = np.abs(x)
        if name == "teeth":
            parts = [self.shapes[n].level(x, y, z) for n in ("upper_teeth", "lower_teeth")]
            return np.maximum(*parts)
        if name == "bone":
            return np.maximum.reduce([self.shapes[n].level(x, y, z) for n in BONES])
        if name == "skin":
            bone = self.drawn_level("bone", x, y, z)
            return self._covered(self.shapes["drawn_skin"].level(x, y, z), bone)
        return self.shapes[name].level(x, y, z)

    @cached_property
    def muscles(self) -> Mapping[str, Muscle]:
        return make_muscles(self)

    @staticmethod
    def _covered(skin: Level, bone: Level) -> Level:
        """The skin pushed out where bone would come too close."""
        return smooth_max(skin, bone + LEAST_COVER, COVER_MELT)

    def field(self, name: str) -> Field:
        scale = self.parameters.scale

        def level(x: Level, y: Level, z: Level) -> Level:
            return scale * self.drawn_level(name, *self.warp.inverse(x, y, z))

        return level

    def skin_level(self, points: ArrayLike) -> Floats:
        rows = as_rows("points", points, 3)
        return np.asarray(self.field("skin")(*rows.T), dtype=np.float64)

    def bone_level(self, name: str, points: ArrayLike) -> Floats:
        check_one_of("bone", name, (*BONES, "teeth"))
        rows = as_rows("points", points, 3)
        return np.asarray(self.field(name)(*rows.T), dtype=np.float64)

    def box(self, name: str) -> tuple[Floats, Floats]:
        """The box of a part in the person's space, mm."""
        if name == "teeth":
            boxes = [self.shapes[n].box for n in ("upper_teeth", "lower_teeth")]
        elif name == "skin":
            boxes = [HEAD_BOX]
        else:
            boxes = [self.shapes[name].box]
        return _mapped(self.warp, boxes)

    def surface(self, name: str, spacing: float = 1.0) -> SurfaceData:
        check_one_of("surface", name, SURFACES)
        spacing = as_positive("spacing", spacing)
        low, high = self.box(name)
        return level_surface(self.field(name), low, high, spacing)


def _mapped(warp: FaceWarp, boxes: list[Box]) -> tuple[Floats, Floats]:
    """The box about what the warp makes of boxes of the left half and their mirror images."""
    low = np.min([b.low for b in boxes], axis=0)
    high = np.max([b.high for b in boxes], axis=0)
    low[0] = -high[0]
    steps = [np.linspace(a, b, 7) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
    moved = warp.forward(points)
    lowest, highest = moved.min(axis=0), moved.max(axis=0)
    return lowest, highest


def make_head(parameters: HeadParameters | None = None) -> PhantomHead:
    """The head of one person."""
    return PhantomHead(HeadParameters() if parameters is None else parameters)
