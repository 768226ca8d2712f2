"""Options of the segmentation of a head."""

from dataclasses import dataclass

import numpy as np

from cmfsim.errors import ImageInputError
from cmfsim.values.checks import as_number, as_positive

# Bone is denser than this: thin bone that shares its voxels reaches little more, HU.
BONE = 250.0
# Enamel reaches 2200 HU; fillings, crowns and plates lie above this.
METAL = 2500.0


@dataclass(frozen=True)
class SegmentOptions:
    """Thresholds and lengths of the segmentation; the defaults suit an adult's CT in HU.

    Attributes
    ----------
    skin_threshold : float, HU
        Between air (−1000) and fat (−100); −300 is about half-way to muscle.
    bone_threshold : float or None, HU
        Between soft tissue (up to 100) and compact bone (700 and more): bone's surface lies at this
        value. None: bone is everything above 250, and its surface is at half the height of the step
        from soft tissue to the bone behind it, if that is higher.
    metal_threshold : float or None, HU
        Above enamel (up to 2200): fillings, crowns, plates. None: 2500, or just below the value at
        which the image saturates where that is lower.
    working_spacing : float, mm
        Finer voxels are averaged until they would be larger than this; coarser ones are kept.
    most_voxels : int
        If the working grid would have more voxels, it is made coarser, with a finding.
    closing : float, mm
        Holes of bone up to twice this wide are bridged where a hollow lies behind.
    least_skin : float, mm
        Bone nearer to the skin's surface than this counts as soft tissue.
    island : float, mm³
        Pieces of bone below this volume are dropped.
    part_jaws : bool
        Whether to separate the mandible; otherwise the bone is one "skull".
    rescale : tuple of float or None
        Slope and intercept from the image's values to HU. None: the values are HU, or in a scale
        that the histogram reveals, with a finding.

    Raises
    ------
    ImageError
        (also `ValueError`) Thresholds out of order, a length not above 0.
    """

    skin_threshold: float = -300.0
    bone_threshold: float | None = None
    metal_threshold: float | None = None
    working_spacing: float = 1.0
    most_voxels: int = 40_000_000
    closing: float = 2.5
    least_skin: float = 1.0
    island: float = 1500.0
    part_jaws: bool = True
    rescale: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        metal = METAL if self.metal_threshold is None else self.metal_threshold
        as_number("skin_threshold", self.skin_threshold)
        if self.bone_threshold is not None:
            as_number("bone_threshold", self.bone_threshold)
        if self.metal_threshold is None and self.least_bone >= METAL:
            metal = np.inf
        if self.metal_threshold is not None:
            as_number("metal_threshold", self.metal_threshold)
        for name in ("working_spacing", "most_voxels", "closing", "least_skin", "island"):
            as_positive(name, getattr(self, name))
        if not -1000.0 < self.skin_threshold < self.least_bone < metal:
            raise ImageInputError(
                f"thresholds are skin {self.skin_threshold:g}, bone {self.least_bone:g}, metal "
                f"{metal:g} HU: they must increase in this order and be above −1000"
            )
        if self.rescale is not None:
            slope, intercept = self.rescale
            as_positive("slope of rescale", slope)
            as_number("intercept of rescale", intercept)

    @property
    def least_bone(self) -> float:
        """Threshold above which voxels are bone, HU."""
        return BONE if self.bone_threshold is None else self.bone_threshold
