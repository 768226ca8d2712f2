"""Rough places of chin and tooth rows by shape alone, for heads without landmarks."""

import numpy as np
from numpy.typing import NDArray

from cmfsim.imaging.bone import Bone
from cmfsim.imaging.morphology import Mask, ndimage
from cmfsim.imaging.working_grid import Working
from cmfsim.values.checks import Floats

__all__ = ["guessed_landmarks"]

# Half the width of the strip in which the profile is looked for, mm.
MIDLINE = 8.0
# Tooth rows lie within this to either side and behind the front of the bone, mm.
ARCH_WIDTH = 35.0
ARCH_DEPTH = 40.0
# Below the chin the foremost bone of the midline is the spine, at least this far behind, mm.
BEHIND_CHIN = 40.0
# From the chin's lowest point to the incisors' edges, and to the palate, mm.
TO_EDGE = (18.0, 60.0)
TO_PALATE = (30.0, 90.0)
# The profile of bone over the height is smoothed over this, mm.
PROFILE_SIGMA = 1.5
# The palate has at least this many times the bone of the tooth rows' gap in a layer.
CONTRAST = 1.25
# From the incisors' edges to their necks, and back to the ramus and to its side, mm.
CROWN_HEIGHT = 10.0
TO_RAMUS = 50.0
RAMUS_SIDE = 44.0


def guessed_landmarks(work: Working, bone: Bone) -> dict[str, Floats] | None:
    """Chin, both sides of the incisors' edges and the ends of the tooth rows; None if not found.

    The tooth rows show as the layer with least bone between chin and palate.
    """
    x, y, z = (
        o + s * np.arange(n)
        for o, s, n in zip(work.origin, work.spacing, bone.solid.shape, strict=True)
    )
    room = bone.cavity if bone.cavity is not None else bone.mask
    middle = float(np.average(x, weights=room.sum(axis=(1, 2))))
    height = float(np.average(z, weights=room.sum(axis=(0, 1))))
    if bone.cavity is None:
        height = float(z[-1])
    front = _profile(bone.solid[np.abs(x - middle) < MIDLINE], y)
    below = (z < height) & np.isfinite(front)
    if not below.any():
        return None
    typical = float(np.median(front[below & (z > height - 80.0)]))
    behind = np.flatnonzero((z < height - 40.0) & ~(front < typical + BEHIND_CHIN))
    lowest = int(behind[-1]) + 1 if len(behind) else 0
    chin = float(z[lowest])
    face = float(np.nanmin(front[(z >= chin) & (z <= chin + TO_PALATE[1])]))
    arch = (np.abs(x - middle) < ARCH_WIDTH)[:, None] & (y < face + ARCH_DEPTH)[None, :]
    edge = _edge(bone.solid, arch, z, chin, work.spacing)
    if edge is None:
        return None
    # The plane is taken level: the rows' own tilt is within what the flood makes good.
    found = {
        "supradentale": np.array([middle, face + 2.0, edge + CROWN_HEIGHT]),
        "infradentale": np.array([middle, face + 4.0, edge - CROWN_HEIGHT]),
        "occlusal_line_L": np.array([middle + RAMUS_SIDE, face + TO_RAMUS, edge]),
        "occlusal_line_R": np.array([middle - RAMUS_SIDE, face + TO_RAMUS, edge]),
    }
    if lowest > 0:
        found["menton"] = np.array([middle, float(front[lowest]) + 4.0, chin + 3.0])
    return found


def _profile(strip: Mask, y: Floats) -> Floats:
    """The foremost y of bone in each layer, mm; NaN where there is none."""
    any_bone = strip.any(axis=0)
    first: Floats = y[np.argmax(any_bone, axis=0)].astype(np.float64)
    first[~any_bone.any(axis=0)] = np.nan
    return first


def _counts(solid: Mask, area: NDArray[np.bool_], spacing: Floats) -> Floats:
    counts = np.count_nonzero(solid & area[:, :, None], axis=(0, 1)).astype(np.float64)
    smooth: Floats = ndimage().gaussian_filter1d(counts, PROFILE_SIGMA / spacing[2])
    return smooth


def _edge(
    solid: Mask, arch: NDArray[np.bool_], z: Floats, chin: float, spacing: Floats
) -> float | None:
    """The height of the layer with least bone between chin and palate, mm."""
    counts = _counts(solid, arch, spacing)
    palates = np.flatnonzero((z > chin + TO_PALATE[0]) & (z < chin + TO_PALATE[1]))
    if not len(palates):
        return None
    palate = int(palates[np.argmax(counts[palates])])
    between = np.flatnonzero((z > chin + TO_EDGE[0]) & (z < chin + TO_EDGE[1]))
    between = between[between < palate]
    if not len(between):
        return None
    least = counts[between].min()
    if counts[palate] < CONTRAST * least:
        return None
    return float(z[between[counts[between] <= 1.02 * least + 1e-9]].mean())
