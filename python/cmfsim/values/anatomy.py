"""Anatomy: a head as level images, and the segments of its bones.

An image and everything made from it lies on one axis-aligned grid in LPS. Anatomy is kept as *level
images*: positive inside, negative outside, zero on the surface between voxels, so that a surface is
known better than its voxels and cutting a bone by a plane is a minimum of two numbers.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from cmfsim.errors import CaseInputError
from cmfsim.values.checks import Frozen, as_text, check_instance
from cmfsim.values.finding import Finding
from cmfsim.values.image_data import ImageData
from cmfsim.values.surface_data import SurfaceData


@dataclass(frozen=True, eq=False)
class Anatomy(Frozen):
    """A head as level images on one grid: positive inside, zero on the surface.

    Attributes
    ----------
    skin : ImageData
        Inside the outer skin, including bones and hollows; float32. Its values are clipped, so it
        is a distance only near zero, and there only up to a factor.
    bones : mapping of str to ImageData
        Each bone with the hollows that it encloses (cranial cavity, sinuses, marrow): "cranium" and
        "mandible", or "skull" if they were not separated.
    air : ImageData or None
        Hollows inside the skin that no bone encloses: airway, nasal and oral cavity.
    teeth : ImageData or None
        Teeth and adjacent material, if they could be distinguished from bone.
    findings : tuple of Finding
    surfaces : mapping of str to SurfaceData
        The surfaces that levels were made from ("skin" and bones), where surfaces were given.
    """

    skin: ImageData
    bones: Mapping[str, ImageData]
    air: ImageData | None = None
    teeth: ImageData | None = None
    findings: tuple[Finding, ...] = ()
    surfaces: Mapping[str, SurfaceData] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_instance("skin", self.skin, ImageData)
        others = {f"bone {name!r}": level for name, level in self.bones.items()}
        others |= {n: v for n, v in (("air", self.air), ("teeth", self.teeth)) if v is not None}
        for name, level in others.items():
            check_instance(name, level, ImageData)
            same = (
                level.values.shape == self.skin.values.shape
                and np.array_equal(level.lowest, self.skin.lowest)
                and np.array_equal(level.spacing, self.skin.spacing)
            )
            if not same:
                raise CaseInputError(f"{name} is not on the same grid as the skin")
        object.__setattr__(self, "bones", MappingProxyType(dict(self.bones)))
        object.__setattr__(self, "surfaces", MappingProxyType(dict(self.surfaces)))


@dataclass(frozen=True, eq=False)
class BoneSegment(Frozen):
    """A piece of bone that moves as one, or that stays.

    Attributes
    ----------
    name : str
        "cranium", "maxilla", "mandible_body", "ramus_left", "chin", …
    level : ImageData
        Positive inside; on the grid of the anatomy.
    surface : SurfaceData
        Its surface, outward normals; the contact surface of nodes that slide on it.
    """

    name: str
    level: ImageData
    surface: SurfaceData

    def __post_init__(self) -> None:
        as_text("segment name", self.name)
        check_instance(f"level of segment {self.name!r}", self.level, ImageData)
        check_instance(f"surface of segment {self.name!r}", self.surface, SurfaceData)
