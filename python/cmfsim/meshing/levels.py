"""Level images of given surfaces: from there on a head from surfaces is like one from a CT."""

from collections.abc import Mapping

import numpy as np

from cmfsim import _core
from cmfsim._core import Surface
from cmfsim.errors import MeshInputError
from cmfsim.values.anatomy import Anatomy
from cmfsim.values.checks import as_positive
from cmfsim.values.finding import Finding
from cmfsim.values.image_data import ImageData
from cmfsim.values.surface_data import SurfaceData

# Levels are clipped where they are this many voxels from the surface: two are enough for the
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
    core = Surface(surface.vertices, surface.triangles)
    values = _core.signed_distance_image(core, (nx, ny, nz), (sx, sy, sz), (ox, oy, oz), band=band)
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
