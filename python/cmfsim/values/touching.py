"""One-sided contact of a scene: nodes that may not enter other tissue, or bone before them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from cmfsim.checks import as_index_rows, as_indices, as_text, check_instance
from cmfsim.values.frozen import Frozen
from cmfsim.values.surface_data import SurfaceData

__all__ = ["ObstacleData", "TouchingData"]


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

    nodes: ArrayLike
    triangles: ArrayLike

    def __post_init__(self) -> None:
        nodes = as_indices("nodes that touch", self.nodes)
        corners = np.asarray(self.triangles)
        count = 1 + int(corners.max(initial=0)) if corners.dtype.kind in "iu" else 0
        triangles = as_index_rows("triangles that are touched", corners, 3, count, "nodes")
        object.__setattr__(self, "nodes", nodes)
        object.__setattr__(self, "triangles", triangles)


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

    nodes: ArrayLike
    segment: str
    surface: SurfaceData

    def __post_init__(self) -> None:
        as_text("segment of an obstacle", self.segment)
        check_instance("surface of an obstacle", self.surface, SurfaceData)
        object.__setattr__(self, "nodes", as_indices("nodes before an obstacle", self.nodes))
