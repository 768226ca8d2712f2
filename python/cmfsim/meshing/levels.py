"""Level images of given surfaces and of the soft tissue that is meshed.

From there on a head from surfaces is like one from a CT. Soft tissue lies outside the bones, in
front of a plane.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim import _core
from cmfsim.errors import MeshInputError
from cmfsim.values.anatomy import Anatomy
from cmfsim.values.checks import Floats, as_number, as_point, as_positive, keep
from cmfsim.values.finding import Finding
from cmfsim.values.image_data import ImageData
from cmfsim.values.surface_data import SurfaceData

# Levels are clipped where they are this many voxels from their surface: two are enough for the
# trilinear zero set, and fewer distances have to be found.
BAND_IN_VOXELS = 2.0
# Voxels round the skin.
MARGIN = 3
# Most voxels of a grid: 500 million take 2 GB a level.
MAX_VOXELS = 5e8


def signed_level(surface: SurfaceData, grid: ImageData) -> ImageData:
    """The level image of a closed surface on the grid of an image: 1 per two voxels of distance.

    Parameters
    ----------
    surface : SurfaceData
        Closed; points whose winding number exceeds one half are inside, so overlapping parts and
        small holes do no harm.
    grid : ImageData
        Its values are not used.

    Returns
    -------
    ImageData
        float32, from −1 to 1, positive inside.

    Raises
    ------
    MeshError
        (also `ValueError`) Degenerate triangles.

    Examples
    --------
    >>> import cmfsim, numpy as np
    >>> mesh = cmfsim.mesh_from_labels(np.ones((9, 9, 9)) > 0, spacing=1.0)
    >>> cube = mesh.surface()
    >>> grid = cmfsim.ImageData(np.zeros((9, 9, 9)), spacing=(1, 1, 1))
    >>> level = cmfsim.signed_level(cmfsim.SurfaceData(cube.vertices, cube.triangles), grid)
    >>> float(level.values[4, 4, 4])
    1.0
    """
    spacing = grid.spacing
    band = BAND_IN_VOXELS * float(spacing.max())
    nx, ny, nz = grid.values.shape
    sx, sy, sz = (float(s) for s in spacing)
    ox, oy, oz = (float(o) for o in grid.lowest)
    box = (nx, ny, nz), (sx, sy, sz), (ox, oy, oz)
    values = _core.signed_distance_image(surface.searched, *box, band=band)
    return grid.with_values(values / np.float32(band))


def anatomy_from_surfaces(
    skin: SurfaceData, bones: Mapping[str, SurfaceData], *, spacing: float = 1.0
) -> Anatomy:
    """A head as level images from its closed surfaces.

    Parameters
    ----------
    skin : SurfaceData
        Closed, outward.
    bones : mapping of str to SurfaceData
        Closed, outward; they may overlap one another and the skin.
    spacing : float, mm
        Of the grid; about a third of the edge length of the later mesh.

    Returns
    -------
    Anatomy
        Its `surfaces` are those given, "skin" and the bones by name.

    Raises
    ------
    MeshError
        (also `ValueError`) Degenerate triangles, no bone, a head that is too large for the spacing,
        as when units are wrong.

    Examples
    --------
    >>> import cmfsim
    >>> skin = cmfsim.read_surface("skin.ply")
    >>> bones = {name: cmfsim.read_surface(f"{name}.ply") for name in ("cranium", "mandible")}
    >>> anatomy = cmfsim.anatomy_from_surfaces(skin, bones, spacing=3.0)
    >>> sorted(anatomy.bones)
    ['cranium', 'mandible']
    """
    as_positive("spacing", spacing)
    if not bones:
        raise MeshInputError("no bone is given, so the tissue would not be attached to anything")
    vertices = skin.vertices
    lowest = vertices.min(axis=0) - MARGIN * spacing
    shape = np.ceil((vertices.max(axis=0) - lowest) / spacing) + 1 + MARGIN
    if shape.prod() > MAX_VOXELS:
        size = " × ".join(f"{extent:.0f}" for extent in np.ptp(vertices, axis=0))
        raise MeshInputError(
            f"skin measures {size} mm: at voxels of {spacing:g} mm, that is more than "
            f"{MAX_VOXELS:.0e}; check that the surfaces are in mm"
        )
    nx, ny, nz = (int(n) for n in shape)
    # A grid without memory: only its shape is asked for.
    empty = np.broadcast_to(np.float32(0.0), (nx, ny, nz))
    grid = ImageData(empty, (spacing, spacing, spacing), lowest)
    levels = {name: signed_level(bone, grid) for name, bone in bones.items()}
    for name, level in levels.items():
        if not (level.values > 0.0).any():
            raise MeshInputError(
                f"bone {name!r} encloses no voxel of {spacing:g} mm inside the box of the skin: "
                "check that it is closed, that its normals point outwards, and that it has the "
                "frame and unit of the skin"
            )
    skin_level = signed_level(skin, grid)
    if not (skin_level.values > 0.0).any():
        raise MeshInputError(
            "the skin encloses no volume: it is not closed, or its triangles face inwards"
        )
    findings = [_outside(name, level, skin_level) for name, level in levels.items()]
    return Anatomy(
        skin=skin_level,
        bones=levels,
        findings=tuple(f for f in findings if f is not None),
        surfaces={"skin": skin, **bones},
    )


def _outside(name: str, bone: ImageData, skin: ImageData) -> Finding | None:
    """What of a bone lies outside the skin, by more than its surface's own inaccuracy."""
    beyond = (bone.values > 0.0) & (skin.values < -0.5)
    count = int(np.count_nonzero(beyond))
    if count == 0:
        return None
    volume = count * float(np.prod(bone.spacing))
    place = bone.lowest + np.argwhere(beyond).mean(axis=0) * bone.spacing
    return Finding(
        "bone-outside-skin",
        f"{volume:.0f} mm³ of bone {name!r} lie outside the skin",
        where=f"about ({place[0]:.0f}, {place[1]:.0f}, {place[2]:.0f}) mm",
    )


Levels = NDArray[np.float32]
Mask = NDArray[np.bool_]

# Layers of a grid that are worked on at a time.
SLAB = 16
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
        keep(self, point=place, normal=direction / length, lower=lower, upper=upper)
        keep(self, foramen_radius=foramen_radius)


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
