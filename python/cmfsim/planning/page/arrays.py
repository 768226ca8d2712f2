"""What a page is written from: plain values, and arrays in single and half precision."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.surfaces.depth import distances
from cmfsim.surfaces.levels import simplified_surface
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding
from cmfsim.values.surface_data import SurfaceData

Arrays = dict[str, NDArray[Any]]

# How much of the height of the face a picture shows, and the least, mm.
SPAN_SHARE, LEAST_SPAN = 1.15, 60.0


@dataclass(frozen=True, eq=False)
class PageContent:
    """The data from which a page is written.

    Attributes
    ----------
    values : mapping
        Plain values, ready for JSON.
    arrays : mapping of str to array
        float32, float16 and uint32.
    findings : tuple of Finding
        Findings on what was simplified or omitted.
    """

    values: Mapping[str, Any]
    arrays: Mapping[str, NDArray[Any]]
    findings: tuple[Finding, ...] = field(default=())


def singles(rows: Any) -> NDArray[np.float32]:
    """Numbers in single precision."""
    return np.asarray(rows, dtype=np.float32)


def indices(rows: Any) -> NDArray[np.uint32]:
    """Numbers of vertices."""
    return np.asarray(rows, dtype=np.uint32)


def add_surface(
    arrays: Arrays, key: str, name: str, surface: SurfaceData, most: int
) -> tuple[SurfaceData, float]:
    """The surface in as many triangles as are drawn, added to arrays, and how far it is off, mm."""
    fewer = simplified_surface(name, surface, most)
    arrays[key] = singles(fewer.vertices)
    arrays[f"{key}_triangles"] = indices(fewer.triangles)
    off = 0.0 if fewer is surface else float(distances(fewer.vertices, surface.searched).max())
    return fewer, off


def framing(vertices: Floats, share: float = SPAN_SHARE) -> dict[str, Any]:
    """Where a picture of some vertices looks, and how much it shows, mm."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    span = max(LEAST_SPAN, share * float((high - low).max()))
    return {"target": (0.5 * (low + high)).tolist(), "span": span}
