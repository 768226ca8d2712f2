"""An upper jaw made by code: a horseshoe of bone with teeth that stand apart, and its tissue."""

import functools

import numpy as np

import cmfsim
from cmfsim.surfaces.levels import surface_of_level

# The middle of the row of teeth: half an ellipse, open to the back, with straight ends; mm.
WIDTH, LENGTH, STRAIGHT = 24.0, 32.0, 14.0
# Half the thickness of the alveolar bone, and radius of the crowns, mm.
BONE, CROWN = 5.0, 3.2
# Teeth stand so far apart, mm: gaps of 1 mm between them.
PITCH = 7.4
# Heights: edges of the teeth, end of the bone, its cut above, mm. The roots are up.
EDGE, CREST, CUT = -4.0, 5.0, 24.0
SPACING = 1.0


def centre_line(step=0.25):
    """Points along the row, (n, 2) mm, from the right end to the left."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, 2000)
    bow = np.column_stack([WIDTH * np.sin(angle), -LENGTH * np.cos(angle)])
    back = np.linspace(STRAIGHT, 0.0, 200)[:, None]
    line = np.concatenate([np.hstack([0 * back - WIDTH, back]), bow])
    line = np.concatenate([line, np.hstack([0 * back + WIDTH, back])[::-1]])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    at = np.arange(0.0, along[-1], step)
    return np.column_stack([np.interp(at, along, line[:, k]) for k in range(2)]), at


@functools.cache
def jaw():
    """The jaw with its teeth: anatomy, segment, arch and landmarks."""
    axes = [np.arange(-44.0, 45.0), np.arange(-52.0, 37.0), np.arange(-16.0, 39.0)]
    shape = tuple(len(a) for a in axes)
    x, y, z = np.meshgrid(*axes, indexing="ij", sparse=True)
    row, along = centre_line()
    plane = np.column_stack([c.ravel() for c in np.meshgrid(axes[0], axes[1], indexing="ij")])
    away = np.sqrt(((plane[:, None] - row[None, ::4]) ** 2).sum(axis=2)).min(axis=1)
    away = away.reshape(shape[:2])[:, :, None]
    gum = np.minimum(np.minimum(BONE - away, z - CREST), CUT - z)
    middle = 0.5 * along[-1]
    count = int((middle - 4.0) // PITCH)
    teeth = np.full(shape, -9.0)
    for k in range(-count, count):
        at = row[np.argmin(np.abs(along - (middle + PITCH * (k + 0.5))))]
        crown = CROWN - np.hypot(x - at[0], y - at[1])
        teeth = np.maximum(teeth, np.minimum(np.minimum(crown, z - EDGE), CREST + 3.0 - z))
    level = np.clip(np.maximum(gum, teeth), -2.0, 2.0).astype(np.float32)
    origin = tuple(a[0] for a in axes)
    image = cmfsim.ImageData(level, (SPACING,) * 3, origin)
    outer = np.sqrt((x / 42.0) ** 2 + ((y + 6.0) / 44.0) ** 2)
    skin = np.clip(40.0 * (1.0 - outer), -2.0, 2.0)
    skin = np.minimum(np.minimum(skin, z + 13.5), np.minimum(36.0 - z, 31.0 - y))
    dense = image.with_values(np.clip(teeth, -2.0, 2.0).astype(np.float32))
    anatomy = cmfsim.Anatomy(
        image.with_values(skin.astype(np.float32)), {"maxilla": image}, teeth=dense
    )
    segment = cmfsim.BoneSegment("maxilla", image, surface_of_level("m", image))
    return anatomy, segment


def arch():
    """The arch as landmarks would give it: at the crest in front, above it at the molars."""
    out = WIDTH + BONE
    return cmfsim.DentalArch(
        "upper", (0, -LENGTH - BONE, CREST + 1), (out, 2, 11), (-out, 2, 11), (0, 0, 1), 20.0, 28.0
    )


def tissue(edge=6.0):
    """The mesh of the tissue round the jaw."""
    anatomy, segment = jaw()
    level = np.minimum(anatomy.skin.values, -segment.level.values)
    return cmfsim.mesh_from_level(
        anatomy.skin.with_values(level), cmfsim.MeshOptions(edge_length=edge)
    ).mesh
