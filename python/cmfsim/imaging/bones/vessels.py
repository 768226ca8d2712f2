"""Vessels with contrast agent, which are as dense as thin bone and would join the jaws."""

import numpy as np
from numpy.typing import NDArray

from cmfsim.imaging.intensities.intensity import SOFT
from cmfsim.imaging.morphology import Mask, Volume, chosen, depth, label, opened, shrunk
from cmfsim.values.finding import Finding

# Compact bone is denser than the first, HU; vessels have 250 to 450 all through. Where all bone is
# less dense, compact is what exceeds the second times the median a voxel below its surface.
COMPACT, PART_OF_MEDIAN = 500.0, 0.7
# What is nowhere compact is a vessel if it is longer than the first, mm, and than the second times
# the square root of its cross-section, both one voxel below its surface. The longest such piece of
# bone in nine scans without contrast agent has 70 mm and 5.8, the large vessels of the neck have 90
# to 110 mm and 13 to 15.
LEAST_LENGTH, SLENDER = 60.0, 8.0
# Their branches are as dense, and lie within this of them, mm.
BRANCHES = 15.0
# What a ball of this radius sweeps is no rim of denser bone, mm.
BRANCH = 1.2
# The surface of a vessel is within this of what lies a voxel below it, voxels.
SURFACE = 2.5
# Fewer voxels have no length.
FEWEST = 30


def without_vessels(
    hu: Volume, solid: Mask, spacing: NDArray[np.float64]
) -> tuple[Volume, Mask, Mask | None, list[Finding]]:
    """HU with vessels as soft tissue, bone without them, the vessels and a finding on them.

    A vessel is a long slender piece of bone that is nowhere compact, with what is as dense near it.
    """
    thick = shrunk(solid)
    if not thick.any():
        return hu, solid, None, []
    sparse = solid & (hu < min(COMPACT, PART_OF_MEDIAN * float(np.median(hu[thick]))))
    vessels = _long_pieces(shrunk(sparse), spacing)
    if not vessels.any():
        return hu, solid, None, []
    apart = depth(vessels, spacing, BRANCHES)
    densest = float(np.quantile(hu[vessels], 0.95))
    branches = opened(sparse & (hu <= densest), BRANCH, spacing) & (apart > -BRANCHES)
    found = branches | (sparse & (apart > -SURFACE * float(spacing.max())))
    # The blur round a vessel is no bone either: the step to soft tissue would close it again.
    blurred = found | (~solid & (depth(found, spacing, BRANCH) > -BRANCH))
    volume = np.count_nonzero(found) * float(np.prod(spacing)) / 1000.0
    what = (
        f"{volume:.0f} cm³ of vessels with contrast agent, {float(np.median(hu[vessels])):.0f} HU, "
        "were taken out of the bone"
    )
    cleared = np.where(blurred, np.minimum(hu, np.float32(SOFT)), hu)
    finding = Finding("bone-vessels", what, where="bone")
    return np.asfortranarray(cleared), solid & ~found, found, [finding]


def _long_pieces(mask: Mask, spacing: NDArray[np.float64]) -> Mask:
    """Pieces of a mask that are long and slender."""
    labels, sizes = label(mask, corners=True)
    where = np.argwhere(mask)
    pieces = labels[tuple(where.T)]
    slender = np.zeros(len(sizes), dtype=bool)
    for piece in np.flatnonzero(sizes[1:] >= FEWEST) + 1:
        places = where[pieces == piece] * spacing
        _, axes = np.linalg.eigh(np.cov(places.T))
        length = float(np.ptp(places @ axes[:, -1]))
        section = float(sizes[piece] * np.prod(spacing)) / max(length, 1e-9)
        slender[piece] = length > max(LEAST_LENGTH, SLENDER * np.sqrt(section))
    return chosen(slender, labels)
