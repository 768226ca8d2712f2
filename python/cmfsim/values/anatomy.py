"""Anatomy: a head as level images, the segments of its bones, and where its teeth stand.

An image and everything made from it lies on one axis-aligned grid in LPS. Anatomy is kept as *level
images*: positive inside, negative outside, zero on the surface between voxels, so that a surface is
known better than its voxels and cutting a bone by a plane is a minimum of two numbers.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from cmfsim.errors import CaseInputError
from cmfsim.values.checks import (
    Floats,
    Frozen,
    as_number,
    as_point,
    as_text,
    brief,
    check_instance,
    check_one_of,
    keep,
)
from cmfsim.values.finding import Finding
from cmfsim.values.image_data import ImageData
from cmfsim.values.shown_region import ShownRegion
from cmfsim.values.surface_data import SurfaceData

# Of segments, in pictures and pages alike.
SEGMENT_COLOURS: Mapping[str, str] = MappingProxyType({
    "cranium": "#e6dcc3", "skull": "#e6dcc3", "midface": "#f2a33a", "maxilla": "#f2a33a",
    "mandible": "#5aa469", "mandible_body": "#5aa469", "ramus_left": "#4e79a7",
    "ramus_right": "#a678b8", "chin": "#d9534f",
})  # fmt: skip
# For segments of other names, in their order.
OTHER_COLOURS = ("#76b7b2", "#b6992d", "#d37295", "#79706e", "#86bcb6", "#9d7660")


def segment_colours(names: Sequence[str]) -> dict[str, str]:
    """The colour of each segment, by name; the same for the same names."""
    others = iter(OTHER_COLOURS * (1 + len(names) // len(OTHER_COLOURS)))
    return {n: SEGMENT_COLOURS[n] if n in SEGMENT_COLOURS else next(others) for n in names}


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
    shown : ShownRegion or None
        What padding surrounds in the image, mm; None where there is none.
    attached : tuple of (2, 3) float64
        The lowest and the highest corner of each thing on the face that is no part of it, mm.
    vessels : (n, 3) float64, mm
        Where vessels with contrast agent were taken out of the bone.
    """

    skin: ImageData
    bones: Mapping[str, ImageData]
    air: ImageData | None = None
    teeth: ImageData | None = None
    findings: tuple[Finding, ...] = ()
    surfaces: Mapping[str, SurfaceData] = field(default_factory=dict)
    shown: ShownRegion | None = None
    attached: tuple[Floats, ...] = ()
    vessels: Floats = field(default_factory=lambda: np.zeros((0, 3)), repr=False)

    __repr__ = brief

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
        keep(self, bones=self.bones, surfaces=self.surfaces)


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


JAWS = ("upper", "lower")
# Segments that may bear the upper and the lower teeth, the smallest first.
UPPER_BEARERS = ("maxilla", "midface", "cranium", "skull")
LOWER_BEARERS = ("mandible_body", "mandible")
# Half the width, and the length, of the smallest arch, mm: less is landmarks exchanged or in cm.
LEAST_ARCH = 2.0
# How far a node that slides lies from its contact sheet at most, mm: what lies deeper behind is on
# another face of the bone, on the palate or where teeth bite.
SHEET_DEPTH = 2.5


@dataclass(frozen=True, eq=False)
class DentalArch(Frozen):
    """The position of the teeth of one jaw.

    Attributes
    ----------
    jaw : str
        "upper" or "lower".
    tip, left, right : (3,) float64, mm
        On the alveolar bone: between the central incisors, and at the second molars (`supradentale`
        and `supra_m2`, or `infradentale` and `sub_m2`).
    out : (3,) float64
        Unit vector from the bite to the roots of this arch.
    depth_front, depth_molars : float, mm
        From `tip`, and from the middle between `left` and `right`, to the other arch's, against
        `out`: the edges of the teeth lie about half-way.

    Raises
    ------
    CaseError
        (also `ValueError`) Not three finite numbers, or places that span no arch.
    """

    jaw: str
    tip: Floats
    left: Floats
    right: Floats
    out: Floats
    depth_front: float
    depth_molars: float

    def __post_init__(self) -> None:
        check_one_of("jaw", self.jaw, JAWS)
        for name in ("tip", "left", "right", "out"):
            keep(self, **{name: as_point(f"{self.jaw} arch: {name}", getattr(self, name))})
        for name in ("depth_front", "depth_molars"):
            as_number(f"{self.jaw} arch: {name}", getattr(self, name))
        axes = self.axes()
        tip, left, right = self.tip, self.left, self.right
        if self.half_width < LEAST_ARCH or float(axes[1] @ (tip - self.middle)) < LEAST_ARCH:
            raise CaseInputError(
                f"{self.jaw} arch: its front {tip.round(1).tolist()} and its molars "
                f"{left.round(1).tolist()} and {right.round(1).tolist()} mm do not span an arch: "
                f"the front must be at least {LEAST_ARCH:g} mm in front of the molars, and the "
                "molars at least as far apart; check whether landmarks are swapped"
            )

    @property
    def middle(self) -> Floats:
        """Half-way between the molars, (3,) mm."""
        return 0.5 * (self.left + self.right)

    @property
    def half_width(self) -> float:
        """Half the distance between the molars, mm."""
        return 0.5 * float(np.linalg.norm(self.left - self.right))

    def axes(self) -> Floats:
        """Unit vectors to the left, ahead, and along `out`, as rows (3, 3).

        The last two are at right angles to the first, but not quite to each other: `ahead` is.
        """
        out = self.out
        across = self.left - self.right
        across = across / max(float(np.linalg.norm(across)), np.finfo(float).tiny)
        ahead = self.tip - self.middle
        ahead = ahead - (ahead @ across) * across - (ahead @ out) * out
        ahead = ahead / max(float(np.linalg.norm(ahead)), np.finfo(float).tiny)
        return np.stack([across, ahead, out])
