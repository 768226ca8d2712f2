"""The part of a head that is meshed as soft tissue: outside the bones, in front of a plane."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim import _core
from cmfsim.errors import MeshInputError
from cmfsim.values.anatomy import Anatomy
from cmfsim.values.checks import Floats, as_number, as_point, as_positive
from cmfsim.values.finding import Finding
from cmfsim.values.image_data import ImageData

Levels = NDArray[np.float32]
Mask = NDArray[np.bool_]

# Layers of a grid that are worked on at a time.
SLAB = 16
# A level is clipped two voxels from its surface, like those of given surfaces.
BAND_IN_VOXELS = 2.0
# Radius of the openings through which the cranial cavity meets the face, mm: fissures of the orbit
# are up to 10 mm wide in reduced surfaces; the piriform aperture, 24 mm, must stay open.
FORAMEN_RADIUS = 6.0
# Hollows smaller than this are gaps between surfaces, not worth a word, mm³.
NOTEWORTHY_HOLLOW = 500.0


@dataclass(frozen=True, eq=False)
class TissueRegion:
    """The part of the head that is meshed.

    Attributes
    ----------
    point, normal : (3,) float64, mm
        A point of the posterior plane, and its normal, out of the region.
    lower, upper : float or None, mm
        Heights (S axis) that bound the region.
    foramen_radius : float, mm
        Hollows behind openings up to this radius are not tissue.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.TissueRegion(point=(0, -120, 0)).normal.tolist()
    [0.0, 1.0, 0.0]
    """

    point: Floats
    normal: Floats
    lower: float | None
    upper: float | None
    foramen_radius: float

    def __init__(
        self,
        point: ArrayLike,
        normal: ArrayLike = (0.0, 1.0, 0.0),
        lower: float | None = None,
        upper: float | None = None,
        foramen_radius: float = FORAMEN_RADIUS,
    ) -> None:
        place, direction = as_point("point", point), as_point("normal", normal)
        length = float(np.linalg.norm(direction))
        if length == 0.0:
            raise MeshInputError("normal of the posterior plane is (0, 0, 0): give its direction")
        for name, height in (("lower", lower), ("upper", upper)):
            if height is not None:
                as_number(name, height)
        as_positive("foramen_radius", foramen_radius)
        object.__setattr__(self, "point", place)
        object.__setattr__(self, "normal", direction / length)
        object.__setattr__(self, "lower", lower)
        object.__setattr__(self, "upper", upper)
        object.__setattr__(self, "foramen_radius", foramen_radius)


def tissue_level(anatomy: Anatomy, region: TissueRegion) -> tuple[ImageData, tuple[Finding, ...]]:
    """The level image of the soft tissue in front of the posterior plane, and findings.

    Returns
    -------
    level : ImageData
        float32, positive in the tissue: inside the skin, outside every bone and hollow, in the
        region. What lies behind bone, as in the cranial cavity, is not tissue.
    findings : tuple of Finding

    Raises
    ------
    MeshError
        (also `ValueError`) No part of the head is in the region.

    Examples
    --------
    >>> import cmfsim
    >>> region = cmfsim.TissueRegion(point=(0, -10, 0))
    >>> level, findings = cmfsim.tissue_level(anatomy, region)
    """
    grid = anatomy.skin
    level: Levels = np.array(grid.values, dtype=np.float32)
    bone: Levels = np.full(level.shape, -1.0, dtype=np.float32)
    for other in anatomy.bones.values():
        np.maximum(bone, other.values, out=bone)
    np.minimum(level, -bone, out=level)
    if anatomy.air is not None:
        np.minimum(level, -anatomy.air.values, out=level)
    _within_region(level, grid, region)
    if not (level > 0.0).any():
        raise MeshInputError(
            "no soft tissue lies in front of the posterior plane: check its point and normal, "
            "and that skin and bones are from one patient"
        )
    findings = tuple(_without_hollows(level, bone, grid, region))
    return grid.with_values(level), findings


def near_skin(anatomy: Anatomy, depth: float) -> Mask:
    """Where the skin is nearer than `depth` mm: (nx, ny, nz) bool on the anatomy's grid."""
    sx, sy, sz = (float(s) for s in anatomy.skin.spacing)
    outside = anatomy.skin.values <= 0.0
    return _core.distance_image(outside, (sx, sy, sz), within=depth) < depth


def _within_region(level: Levels, grid: ImageData, region: TissueRegion) -> None:
    """Bounds a level by the planes of a region: the distance into it, in the scale of a level."""
    band = BAND_IN_VOXELS * float(grid.spacing.max())
    x, y, z = grid.axes()
    dx, dy, dz = (
        (axis - place) * part
        for axis, place, part in zip((x, y, z), region.point, region.normal, strict=True)
    )
    # In slabs: distances in double precision of the whole grid would be its largest array.
    for begin in range(0, len(level), SLAB):
        part = slice(begin, begin + SLAB)
        behind = dx[part] + dy + dz
        inwards = np.clip(-behind / band, -1.0, 1.0).astype(np.float32)
        np.minimum(level[part], inwards, out=level[part])
    if region.lower is not None:
        above = np.clip((z - region.lower) / band, -1.0, 1.0).astype(np.float32)
        np.minimum(level, above, out=level)
    if region.upper is not None:
        below = np.clip((region.upper - z) / band, -1.0, 1.0).astype(np.float32)
        np.minimum(level, below, out=level)


def _without_hollows(
    level: Levels, bone: Levels, grid: ImageData, region: TissueRegion
) -> Iterator[Finding]:
    """Takes from `level` what only openings narrower than a foramen join to the outer tissue."""
    sx, sy, sz = (float(s) for s in grid.spacing)
    spacing = (sx, sy, sz)
    tissue: Mask = level > 0.0
    # Where a ball of the foramen's radius fits between bones, and what such balls reach.
    radius = region.foramen_radius
    roomy = _core.distance_image(bone > 0.0, spacing, within=radius) > radius
    closed: Mask = _core.distance_image(roomy, spacing, within=radius) > radius
    # Outer tissue touches the skin where no bone stands between; thin tissue over bone is not
    # roomy, so that the way along the skin stays open whatever its thickness.
    shallow = grid.values < 1.0
    open_tissue = tissue & (~closed | shallow)
    labels, sizes = _core.label_image(open_tissue)
    if len(sizes) == 1:
        return
    touches = np.zeros(len(sizes), dtype=bool)
    touches[labels[open_tissue & shallow]] = True
    touches[0] = False
    hollow: Mask = open_tissue & ~touches[labels]
    if not hollow.any():
        return
    # The openings themselves go to the nearer side.
    to_hollow = _core.distance_image(hollow, spacing)
    to_outer = _core.distance_image(open_tissue & ~hollow, spacing)
    hollow |= tissue & ~open_tissue & (to_hollow < to_outer)
    np.minimum(level, np.float32(-1.0), out=level, where=hollow)
    volume = float(np.count_nonzero(hollow)) * sx * sy * sz
    if volume < NOTEWORTHY_HOLLOW:
        return
    place = grid.lowest + np.argwhere(hollow).mean(axis=0) * grid.spacing
    yield Finding(
        "hollow-left-out",
        f"{volume / 1000.0:.1f} cm³ behind bone were removed from the tissue",
        where=f"about ({place[0]:.0f}, {place[1]:.0f}, {place[2]:.0f}) mm",
    )
