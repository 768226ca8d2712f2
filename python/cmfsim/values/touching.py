"""One-sided contact of a scene: nodes that may not enter other tissue, or bone before them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from cmfsim.values.checks import Frozen, Indices, as_index_rows, as_indices, as_text, check_instance
from cmfsim.values.surface_data import SurfaceData


@dataclass(frozen=True, eq=False)
class TouchingData(Frozen):
    """Nodes that may not enter other tissue: of one lip, before the surface of the other.

    Contact is one-sided and without friction: nodes may lift off.

    Attributes
    ----------
    nodes : (k,) uint32
        Free or sliding.
    triangles : (t, 3) uint32
        Nodes of the mesh, on its boundary, outward; they deform with the tissue.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.TouchingData(nodes=[7, 9], triangles=[[0, 1, 2]]).nodes.tolist()
    [7, 9]
    """

    nodes: Indices
    triangles: Indices

    def __init__(self, nodes: ArrayLike, triangles: ArrayLike) -> None:
        touching = as_indices("nodes that touch", nodes)
        given = np.asarray(triangles)
        count = 1 + int(given.max(initial=0)) if given.dtype.kind in "iu" else 0
        corners = as_index_rows("triangles that are touched", given, 3, count, "nodes")
        object.__setattr__(self, "nodes", touching)
        object.__setattr__(self, "triangles", corners)


@dataclass(frozen=True, eq=False)
class ObstacleData(Frozen):
    """Nodes that may not enter behind a surface that moves with a segment: lips before teeth.

    Contact is one-sided and without friction: nodes may lift off. Behind the border of an open
    surface there is no contact.

    Attributes
    ----------
    nodes : (k,) uint32
    segment : str
        Segment of the scene, with nodes of its own or without.
    surface : SurfaceData
        At rest, outward.

    Examples
    --------
    >>> import cmfsim
    >>> teeth = cmfsim.SurfaceData([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    >>> cmfsim.ObstacleData(nodes=[7, 9], segment="maxilla", surface=teeth).segment
    'maxilla'
    """

    nodes: Indices
    segment: str
    surface: SurfaceData

    def __init__(self, nodes: ArrayLike, segment: str, surface: SurfaceData) -> None:
        as_text("segment of an obstacle", segment)
        check_instance("surface of an obstacle", surface, SurfaceData)
        object.__setattr__(self, "nodes", as_indices("nodes before an obstacle", nodes))
        object.__setattr__(self, "segment", segment)
        object.__setattr__(self, "surface", surface)
