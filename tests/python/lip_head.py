"""The front of a face made by formulas: a muzzle with two closed lips over two rows of teeth."""

import numpy as np

import cmfsim

# Half width of the mouth, and slope of its line: the left corner lies higher; mm.
MOUTH, SLANT = 22.0, 0.06
# Depth of the crease between the lips, mm, and how far the face curves back at the sides.
CREASE, CURVE = 3.0, 90.0
# Front of the face and of the teeth, and height of the line's middle, mm.
FACE, TEETH, HEIGHT = -60.0, -52.0, 2.0
# Overlap of the rows of teeth: both end here, mm.
BITE = 1.0
SPACING = 1.0
ARCHES = {
    "upper": cmfsim.DentalArch(
        "upper", (0, -52, 12), (24, -22, 12), (-24, -22, 12), (0, 0, 1), 22.0, 22.0
    ),
    "lower": cmfsim.DentalArch(
        "lower", (0, -52, -10), (24, -22, -10), (-24, -22, -10), (0, 0, -1), 22.0, 22.0
    ),
}


def line(x):
    """The height of the line where the lips meet."""
    return HEIGHT + SLANT * x


def head(*, crease=CREASE, sign=1.0):
    """Anatomy of the face; `sign` −1 mirrors it, and a crease of 0 leaves it smooth."""
    axes = [np.arange(-45.0, 46.0, SPACING), np.arange(-75.0, 11.0, SPACING)]
    axes.append(np.arange(-35.0, 36.0, SPACING))
    x, y, z = np.meshgrid(*axes, indexing="ij")
    side = sign * x
    from_line = z - line(side)
    fade = np.clip(1.0 - (side / (MOUTH + 4.0)) ** 4, 0.0, None)
    dent = crease * fade * np.exp(-((from_line / 2.5) ** 2))
    front = FACE + side**2 / CURVE + dent
    skin = np.minimum.reduce([y - front, 43.0 - np.abs(x), 33.0 - np.abs(z), 8.0 - y])
    row = np.minimum(y - (TEETH + side**2 / 40.0), 27.0 - np.abs(x))
    row = np.minimum(row, 4.0 - y)
    upper = np.minimum(row, np.minimum(z - BITE - 1.0, 30.0 - z))
    lower = np.minimum(row, np.minimum(BITE - 1.0 - z, z + 30.0))

    def image(level):
        values = np.broadcast_to(np.clip(level, -2.0, 2.0), [len(a) for a in axes])
        return cmfsim.ImageData(
            values.astype(np.float32), (SPACING,) * 3, tuple(a[0] for a in axes)
        )

    return cmfsim.Anatomy(image(skin), {"cranium": image(upper), "mandible": image(lower)})


def landmarks(sign=1.0):
    """Skin landmarks of the lips."""

    def on(x, rise=0.0):
        return np.array([sign * x, FACE + x**2 / CURVE, line(x) + rise])

    corners = {"cheilion_L": on(MOUTH), "cheilion_R": on(-MOUTH)}
    if sign < 0.0:
        corners = {"cheilion_R": corners["cheilion_L"], "cheilion_L": corners["cheilion_R"]}
    return {**corners, "labiale_superius": on(0.0, 7.0), "labiale_inferius": on(0.0, -7.0)}


def tissue(edge=4.0, **options):
    """Tissue of the face as tets."""
    anatomy = head(**options)
    level = np.array(anatomy.skin.values)
    for bone in anatomy.bones.values():
        level = np.minimum(level, -bone.values)
    made = cmfsim.mesh_from_level(
        anatomy.skin.with_values(level), cmfsim.MeshOptions(edge_length=edge, refinements=0)
    )
    return anatomy, made.mesh
