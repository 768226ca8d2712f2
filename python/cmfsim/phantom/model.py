"""One head made by code: its surfaces as level functions, and all that is drawn from them."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.errors import CaseInputError
from cmfsim.phantom.grid import HOUNSFIELD, Field, level_grid, level_surface, mixed, noisy
from cmfsim.phantom.head import HEAD_BOX, find_skin_landmarks, find_skull_landmarks, skin_shape
from cmfsim.phantom.muscles import Muscle, make_muscles
from cmfsim.phantom.parameters import FaceWarp, HeadParameters, JawWarp, JawWarped
from cmfsim.phantom.shapes import Level, Shape, Within, smooth_max
from cmfsim.phantom.skull import (
    airway_shape,
    brain_shape,
    cranium_shape,
    mandible_shape,
    teeth_shape,
)
from cmfsim.values.anatomy import Anatomy
from cmfsim.values.checks import (
    Floats,
    as_number,
    as_positive,
    as_rows,
    check_instance,
    check_one_of,
)
from cmfsim.values.image_data import ImageData
from cmfsim.values.surface_data import SurfaceData

BONES = ("cranium", "mandible", "upper_teeth", "lower_teeth")
# Parts that `surface` draws besides the muscles.
PARTS = ("skin", *BONES, "teeth", "air", "brain")
# Numbers of the label image.
LABELS: Mapping[str, int] = MappingProxyType({
    "outside": 0, "fat": 1, "muscle": 2, "cranium": 3, "mandible": 4, "upper_teeth": 5,
    "lower_teeth": 6, "air": 7, "brain": 8,
})  # fmt: skip
# Soft tissue that covers bone and teeth at least, mm; the thinnest is over the nasal bones.
LEAST_COVER = 2.2
# Width over which the cover melts into the skin as drawn, mm.
COVER_MELT = 4.0
# Mucosa between airway and bone, and the least tissue between airway and skin, mm.
MUCOSA, AIR_BELOW_SKIN = 1.0, 2.5
# Levels on grids are clipped to this many mm on either side, and to this many voxels where more.
CLIP, CLIP_VOXELS = 3.0, 1.5
# Room about the head on every image, mm.
MARGIN = 4.0
# Grids are refused above this many voxels: 4 bytes each for about a dozen levels.
MOST_VOXELS = 60_000_000
# Thickness of the skin and depth from which tissue is lean rather than fat, on images, mm.
SKIN_THICKNESS, LEAN_DEPTH = 1.8, 16.0
# Thickness of cortical bone, mm.
CORTEX = 2.2
# Least thickness of bone about the cavity of the vault, mm: at the temples and the orbits' roofs.
LEAST_VAULT = 2.5


@dataclass(frozen=True, eq=False)
class PhantomHead:
    """A synthetic head, known exactly: skin, skull, mandible, teeth, airway and muscles.

    Coordinates are LPS mm: x to the left, y backwards, z up; the origin lies midway between the ear
    canals and z = 0 is the Frankfort plane. Without asymmetry the right half is the exact mirror
    image of the left.

    Examples
    --------
    >>> import cmfsim
    >>> head = cmfsim.make_head()
    >>> bool(head.skin_level([[0.0, 0.0, 50.0]])[0] > 0.0)
    True
    """

    parameters: HeadParameters

    def __post_init__(self) -> None:
        check_instance("parameters", self.parameters, HeadParameters)

    @cached_property
    def warp(self) -> FaceWarp:
        """The map from the person's space to the symmetric head that is drawn, and back."""
        return FaceWarp(self.parameters)

    @cached_property
    def _unmoved(self) -> Mapping[str, Shape]:
        """The parts before the jaw's map; the left half is drawn."""
        p = self.parameters
        return {
            "cranium": cranium_shape(),
            "mandible": mandible_shape(p),
            "upper_teeth": teeth_shape(upper=True),
            "lower_teeth": teeth_shape(upper=False),
            "air": airway_shape(),
            "brain": Within(brain_shape(), cranium_shape(), LEAST_VAULT),
            "drawn_skin": skin_shape(p),
        }

    @cached_property
    def _shapes(self) -> Mapping[str, Shape]:
        """The parts of the symmetric head."""
        hard, soft = (JawWarp(self.parameters, soft=soft) for soft in (False, True))
        warps = {"mandible": hard, "lower_teeth": hard, "drawn_skin": soft}
        return {
            name: JawWarped(shape, warps[name]) if name in warps else shape
            for name, shape in self._unmoved.items()
        }

    def unmoved_level(self, name: str, x: Level, y: Level, z: Level) -> Level:
        """The level of a part in the symmetric head before the jaw's map, (x, y, z broadcast)."""
        return self._level(self._unmoved, name, np.abs(x), y, z)

    def drawn_level(self, name: str, x: Level, y: Level, z: Level) -> Level:
        """The level of a part in the symmetric head, (x, y, z broadcast)."""
        return self._level(self._shapes, name, np.abs(x), y, z)

    def skin_and_bone(self, x: Level, y: Level, z: Level) -> tuple[Level, Level]:
        """The levels of the skin, and of all bones and teeth, in the symmetric head."""
        x = np.abs(x)
        bone = self._level(self._shapes, "bone", x, y, z)
        return _covered(self._shapes["drawn_skin"].level(x, y, z), bone), bone

    def _level(self, shapes: Mapping[str, Shape], name: str, x: Level, y: Level, z: Level) -> Level:
        if name == "skin":
            bone = self._level(shapes, "bone", x, y, z)
            return _covered(shapes["drawn_skin"].level(x, y, z), bone)
        if name == "air":
            bone = self._level(shapes, "bone", x, y, z)
            return _airway(shapes["air"].level(x, y, z), shapes["drawn_skin"].level(x, y, z), bone)
        unions = {"bone": BONES, "teeth": BONES[2:]}
        level: Level = np.maximum.reduce(
            [shapes[part].level(x, y, z) for part in unions.get(name, (name,))]
        )
        return level

    def field(self, name: str) -> Field:
        """The level of a part or muscle as a function of x, y, z in the person's space, mm."""
        scale, warp = self.parameters.scale, self.warp
        is_part = name in {*PARTS, "bone", "drawn_skin"}

        def level(x: Level, y: Level, z: Level) -> Level:
            places = warp.inverse(x, y, z)
            if is_part:
                return scale * self.drawn_level(name, *places)
            return scale * self.muscles[name].drawn_level(*places)

        return level

    def skin_level(self, points: ArrayLike) -> Floats:
        """The level of the skin at points, (n,): positive inside, near the skin the distance in mm.

        Parameters
        ----------
        points : (n, 3) float64, mm
        """
        rows = as_rows("points", points, 3)
        return np.asarray(self.field("skin")(*rows.T), dtype=np.float64)

    def bone_level(self, name: str, points: ArrayLike) -> Floats:
        """The level of a bone or tooth row at points, (n,): positive inside.

        The cranium is solid: the cavities that it encloses count as bone.

        Parameters
        ----------
        name : str
            "cranium", "mandible", "upper_teeth", "lower_teeth"; "teeth" for both rows, "bone" for
            all together.
        points : (n, 3) float64, mm
        """
        check_one_of("bone", name, (*BONES, "teeth", "bone"))
        rows = as_rows("points", points, 3)
        return np.asarray(self.field(name)(*rows.T), dtype=np.float64)

    @cached_property
    def muscles(self) -> Mapping[str, Muscle]:
        """The muscles by name, such as "masseter_L"; see `Muscle`."""
        return make_muscles(self)

    @cached_property
    def skull_landmarks(self) -> Mapping[str, Floats]:
        """The 32 bone sites by label, (3,) mm each, on the surfaces of the bones."""
        return find_skull_landmarks(self)

    @cached_property
    def skin_landmarks(self) -> Mapping[str, Floats]:
        """The 14 skin points by label, (3,) mm each, on the surface of the skin."""
        return find_skin_landmarks(self)

    def surface(self, name: str, spacing: float = 1.0) -> SurfaceData:
        """The closed surface of a part or muscle, outward normals.

        Parameters
        ----------
        name : str
            "skin", "cranium", "mandible", "upper_teeth", "lower_teeth", "teeth", "air", "brain" or
            the name of a muscle.
        spacing : float, mm
            Edge of the marching cubes. Parts thinner than that break up.

        Raises
        ------
        CaseError
            (also `ValueError`) Unknown name; spacing not positive, or too coarse for the part.
        ImportError
            scikit-image is not installed.
        """
        if name not in PARTS:
            check_one_of("surface", name, (*PARTS, *self.muscles))
        low, high = self._box(name)
        return level_surface(self.field(name), low, high, as_positive("spacing", spacing))

    def _box(self, name: str) -> tuple[Floats, Floats]:
        """A box that holds a part in the person's space, mm."""
        if name in PARTS:
            names = BONES[2:] if name == "teeth" else (name,)
            box_of = {"skin": HEAD_BOX}
            boxes = [box_of.get(n) or self._shapes[n].box for n in names]
            low = np.min([b.low for b in boxes], axis=0)
            high = np.max([b.high for b in boxes], axis=0)
            low[0] = -high[0]
        else:
            box = self.muscles[name].box
            low, high = np.array(box.low), np.array(box.high)
        steps = [np.linspace(a, b, 7) for a, b in zip(low, high, strict=True)]
        points = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
        moved = self.warp.forward(points)
        return moved.min(axis=0), moved.max(axis=0)

    def _grid(self, spacing: ArrayLike) -> tuple[Floats, tuple[Floats, Floats, Floats]]:
        """Spacing and axes of an image about the head; x = 0 is in the middle of the grid."""
        step = np.asarray(spacing, dtype=np.float64)
        step = as_rows("spacing", np.broadcast_to(step, (1, 3)), 3)[0]
        if (step <= 0.0).any():
            raise CaseInputError(f"spacing is {step.tolist()} mm: must be above 0")
        low, high = self._box("skin")
        low, high = low - MARGIN, high + MARGIN
        half = np.ceil(max(-low[0], high[0]) / step[0])
        axes = (
            step[0] * np.arange(-half, half + 1.0),
            *(
                low[a] + step[a] * np.arange(np.ceil((high[a] - low[a]) / step[a]) + 1.0)
                for a in (1, 2)
            ),
        )
        size = int(np.prod([len(axis) for axis in axes]))
        if size > MOST_VOXELS:
            raise CaseInputError(
                f"spacing {step.tolist()} mm gives {size} voxels, more than {MOST_VOXELS}: "
                "use a larger spacing"
            )
        return step, (axes[0], axes[1], axes[2])

    def _levels(
        self, axes: tuple[Floats, Floats, Floats], clip: float, names: tuple[str, ...]
    ) -> dict[str, NDArray[np.float32]]:
        """Levels on a grid by name; "skin", "bone" and "air" follow from the parts."""
        scale = self.parameters.scale
        # The cover feels bone from further away than the clip.
        wide = max(clip, scale * (LEAST_COVER + COVER_MELT) + clip)
        parts = {name: self._part_grid(name, axes, wide) for name in (*BONES, "air", *names)}
        bone = np.maximum.reduce([parts[name] for name in BONES])
        drawn = level_grid(self.field("drawn_skin"), axes, wide)
        skin = scale * _covered(drawn / scale, bone / scale)
        parts["skin"] = skin.astype(np.float32)
        parts["bone"] = bone
        airway = scale * _airway(parts["air"] / scale, parts["skin"] / scale, bone / scale)
        parts["air"] = airway.astype(np.float32)
        for level in parts.values():
            np.clip(level, -clip, clip, out=level)
        return parts

    def _part_grid(
        self, name: str, axes: tuple[Floats, Floats, Floats], clip: float
    ) -> NDArray[np.float32]:
        """The level of a part as drawn, evaluated in its box alone."""
        values = np.full([len(axis) for axis in axes], -clip, dtype=np.float32)
        scale, warp, shape = self.parameters.scale, self.warp, self._shapes[name]

        def level(x: Level, y: Level, z: Level) -> Level:
            u, v, w = warp.inverse(x, y, z)
            return scale * shape.level(np.abs(u), v, w)

        index, crop = _crop(axes, self._box(name), clip)
        values[index] = level_grid(level, crop, clip)
        return values

    def anatomy(self, spacing: ArrayLike = 1.0) -> Anatomy:
        """The head as level images: skin; cranium and mandible, each with its teeth; air; teeth.

        Parameters
        ----------
        spacing : float or (3,) float64, mm

        Raises
        ------
        CaseError
            (also `ValueError`) Spacing not positive, or so small that the grid would be too large.
        """
        step, axes = self._grid(spacing)
        clip = max(CLIP, CLIP_VOXELS * float(step.max()))
        level = self._levels(axes, clip, ())
        origin = [axis[0] for axis in axes]

        def image(*names: str) -> ImageData:
            return ImageData(np.maximum.reduce([level[n] for n in names]), step, origin)

        return Anatomy(
            skin=image("skin"),
            bones={
                "cranium": image("cranium", "upper_teeth"),
                "mandible": image("mandible", "lower_teeth"),
            },
            air=image("air"),
            teeth=image("upper_teeth", "lower_teeth"),
        )

    def _muscle_grid(
        self,
        axes: tuple[Floats, Floats, Floats],
        skin: NDArray[np.float32],
        bone: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """The level of all muscles together on a grid, each evaluated in its own box."""
        scale, warp = self.parameters.scale, self.warp
        clip = CLIP
        together = np.full(skin.shape, -clip, dtype=np.float32)
        for name, muscle in self.muscles.items():
            index, crop_axes = _crop(axes, self._box(name), clip)

            def strap(x: Level, y: Level, z: Level, one: Muscle = muscle) -> Level:
                return scale * one.strap_level(*warp.inverse(x, y, z))

            crop = level_grid(strap, crop_axes, clip)
            crop = Muscle.clipped(crop, skin[index], bone[index])
            np.maximum(together[index], crop, out=together[index])
        return together

    def labels(self, spacing: ArrayLike = 1.0) -> ImageData:
        """The head as a label image, uint8: what the centre of each voxel lies in; see `LABELS`.

        "fat" is all soft tissue without a name, "brain" the cavity of the cranium.

        Parameters
        ----------
        spacing : float or (3,) float64, mm
        """
        step, axes = self._grid(spacing)
        level = self._levels(axes, CLIP, ("brain",))
        labels = np.zeros(level["skin"].shape, dtype=np.uint8)
        labels[level["skin"] > 0.0] = LABELS["fat"]
        labels[self._muscle_grid(axes, level["skin"], level["bone"]) > 0.0] = LABELS["muscle"]
        for name in ("air", "cranium", "brain", "mandible", "upper_teeth", "lower_teeth"):
            labels[level[name] > 0.0] = LABELS[name]
        return ImageData(labels, step, [axis[0] for axis in axes])

    def ct(
        self, spacing: ArrayLike = (1.0, 1.0, 1.0), *, noise: float = 12.0, seed: int = 0
    ) -> ImageData:
        """The head as a CT would show it, int16 HU, with partial volume at every surface.

        Bone has a cortex around cancellous bone; tissue deep in the head is lean. The neck ends in
        a flat cut.

        Parameters
        ----------
        spacing : float or (3,) float64, mm
        noise : float, HU
            Standard deviation of the noise of a voxel, 0 or more.
        seed : int
            Draws the noise; the same seed gives the same image.
        """
        noise = as_number("noise", noise)
        if noise < 0.0:
            raise CaseInputError(f"noise is {noise:g} HU: must be 0 or more")
        step, axes = self._grid(spacing)
        level = self._levels(axes, LEAN_DEPTH + 2.0, ("brain",))
        width = float(np.cbrt(np.prod(step)))
        image = np.full(level["skin"].shape, HOUNSFIELD["air"], dtype=np.float32)
        muscle = self._muscle_grid(axes, level["skin"], level["bone"])
        layers: tuple[tuple[str, Level], ...] = (
            ("skin", level["skin"]),
            ("fat", level["skin"] - SKIN_THICKNESS),
            ("muscle", level["skin"] - LEAN_DEPTH),
            ("muscle", muscle),
            ("air", level["air"]),
            ("cortical", np.maximum(level["cranium"], level["mandible"])),
            ("cancellous", np.maximum(level["cranium"], level["mandible"]) - CORTEX),
            ("brain", level["brain"]),
            ("tooth", np.maximum(level["upper_teeth"], level["lower_teeth"])),
        )
        for tissue, inside in layers:
            mixed(image, HOUNSFIELD[tissue], inside, width)
        return ImageData(noisy(image, noise, seed), step, [axis[0] for axis in axes])


def _crop(
    axes: tuple[Floats, Floats, Floats], box: tuple[Floats, Floats], margin: float
) -> tuple[tuple[slice, ...], list[Floats]]:
    """The part of a grid within a margin of a box: slices and axes."""
    index = tuple(
        slice(int(np.searchsorted(axis, a - margin)), int(np.searchsorted(axis, b + margin)))
        for axis, a, b in zip(axes, *box, strict=True)
    )
    return index, [axis[i] for axis, i in zip(axes, index, strict=True)]


def _covered(skin: Level, bone: Level) -> Level:
    """The skin pushed out where bone would come too close."""
    return smooth_max(skin, bone + LEAST_COVER, COVER_MELT)


def _airway(air: Level, skin: Level, bone: Level) -> Level:
    """The airway kept off bone and skin."""
    level: Level = np.minimum(np.minimum(air, -bone - MUCOSA), skin - AIR_BELOW_SKIN)
    return level


def make_head(parameters: HeadParameters | None = None) -> PhantomHead:
    """The head of one person; the ordinary one without parameters.

    Examples
    --------
    >>> import cmfsim
    >>> head = cmfsim.make_head(cmfsim.HeadParameters(chin_projection=3.0))
    >>> len(head.skull_landmarks), len(head.skin_landmarks)
    (32, 14)
    """
    parameters = HeadParameters() if parameters is None else parameters
    check_instance("parameters", parameters, HeadParameters)
    return _kept_head(parameters)


@lru_cache(maxsize=8)
def _kept_head(parameters: HeadParameters) -> PhantomHead:
    """One head for equal parameters: its landmarks and muscles take seconds to find."""
    return PhantomHead(parameters)
