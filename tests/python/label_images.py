"""Label images of a head of eggs, and the files that programs keep them in."""

import gzip

import numpy as np

import cmfsim

ORIGIN, SPACING = np.array([-70.0, -80.0, -60.0]), np.array([4.0, 4.0, 4.0])
SHAPE = (35, 40, 30)


def masks():
    """Skin, both jaws and their teeth as masks, by the names of DentalSegmentator; LPS."""
    points = ORIGIN + np.stack(np.meshgrid(*map(np.arange, SHAPE), indexing="ij"), -1) * SPACING

    def egg(centre, radii):
        return (((points - np.array(centre)) / np.array(radii)) ** 2).sum(-1) < 1

    return {
        "Skin": egg((0, 0, 0), (64, 74, 56)),
        "Maxilla & Upper Skull": egg((0, 10, 20), (40, 45, 22)),
        "Mandible": egg((0, -30, -25), (25, 20, 12)),
        "Upper Teeth": egg((0, -45, 0), (16, 10, 6)),
        "Lower Teeth": egg((0, -45, -13), (16, 10, 6)),
    }


def labels(given=None):
    """One label a voxel, 1 for the first mask: later ones replace those before."""
    image = np.zeros(SHAPE, np.uint8)
    for number, mask in enumerate((given or masks()).values(), start=1):
        image[mask] = number
    return image


def write_image(path, values):
    cmfsim.write_image(cmfsim.ImageData(values, SPACING, ORIGIN), path)


def write_seg(path, given, *, last=False):
    """A `.seg.nrrd` with a layer for each segment; `last` puts their axis after those of space."""
    layers = np.stack([mask.astype(np.uint8) for mask in given.values()])
    directions, kinds = "(4,0,0) (0,4,0) (0,0,4)", "domain domain domain"
    if last:
        layers, directions, kinds = (
            np.moveaxis(layers, 0, -1),
            f"{directions} none",
            f"{kinds} list",
        )
    else:
        directions, kinds = f"none {directions}", f"list {kinds}"
    lines = [
        "NRRD0004\ntype: unsigned char\ndimension: 4\nspace: left-posterior-superior",
        f"sizes: {' '.join(map(str, layers.shape))}\nspace directions: {directions}",
        f"kinds: {kinds}\nendian: little\nencoding: gzip\nspace origin: (-70,-80,-60)",
    ]
    for k, name in enumerate(given):
        lines += [f"Segment{k}_Name:={name}", f"Segment{k}_LabelValue:=1", f"Segment{k}_Layer:={k}"]
    data = gzip.compress(layers.tobytes(order="F"), mtime=0)
    path.write_bytes(("\n".join(lines) + "\n\n").encode() + data)


def volume(surface):
    """The volume in a closed surface, mm³."""
    corners = np.asarray(surface.vertices)[np.asarray(surface.triangles)]
    return float(np.linalg.det(corners).sum() / 6.0)
