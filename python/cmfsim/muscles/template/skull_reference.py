"""The skull reference of a template: several bones as one surface."""

from collections.abc import Sequence

import numpy as np

from cmfsim.values.surface_data import SurfaceData

__all__ = ["joined_surface"]


def joined_surface(surfaces: Sequence[SurfaceData]) -> SurfaceData:
    """Several surfaces as one, each a piece of its own."""
    starts = np.cumsum([0, *(len(s.vertices) for s in surfaces)])
    triangles = [
        np.asarray(surface.triangles, dtype=np.int64) + start
        for surface, start in zip(surfaces, starts[:-1], strict=True)
    ]
    vertices = [surface.vertices for surface in surfaces]
    return SurfaceData(np.concatenate(vertices), np.concatenate(triangles))
