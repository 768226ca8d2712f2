"""Muscles that are closed boxes, for templates."""

import numpy as np

import cmfsim

CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
SIDES = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
BOX = np.array([t for a, b, c, d in SIDES for t in ((a, b, c), (a, c, d))])


def box(low, high):
    """A closed box with outward normals."""
    low, high = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    return cmfsim.SurfaceData(low + CORNERS * (high - low), BOX)


def strap(name, low, high, **more):
    """A muscle that is a box, with a fibre line along its long axis."""
    low, high = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    middle = 0.5 * (low + high)
    line = [[*middle[:2], low[2]], middle, [*middle[:2], high[2]]]
    return cmfsim.MuscleSurface(name, name[-1], box(low, high), course=(line,), **more)
