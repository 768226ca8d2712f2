"""One-sided contact: nodes that may not enter other tissue, or bone before them; and each lip."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.values import checks
from cmfsim.values.surface_data import SurfaceData

LIPS = ("upper", "lower")


@dataclass(frozen=True, eq=False)
class LipRegion(checks.Frozen):
    """One lip on the boundary of a mesh that was separated between the lips.

    Attributes
    ----------
    triangles : (t, 3) uint32
        Skin and vermilion of the lip, the face towards the other lip, and the face towards the
        teeth: mesh nodes, outward, one connected patch from one corner of the mouth to the other.
    nodes : (n,) uint32
        Free nodes of the triangles that do not belong to the other lip, ascending.
    released : mapping of str to (k,) uint32
        Those of the nodes that lie on a segment and would slide on it, by segment: they may lift
        off.
    """

    triangles: NDArray[np.uint32]
    nodes: NDArray[np.uint32]
    released: Mapping[str, NDArray[np.uint32]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        triangles, nodes = (np.asarray(part, np.uint32) for part in (self.triangles, self.nodes))
        made = {"triangles": checks.frozen(triangles), "nodes": checks.frozen(nodes)}
        checks.keep(self, **made, released=self.released)


@dataclass(frozen=True, eq=False)
class TouchingData(checks.Frozen):
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

    nodes: checks.Indices
    triangles: checks.Indices

    def __init__(self, nodes: ArrayLike, triangles: ArrayLike) -> None:
        touching = checks.as_indices("nodes that touch", nodes)
        given = np.asarray(triangles)
        count = 1 + int(given.max(initial=0)) if given.dtype.kind in "iu" else 0
        corners = checks.as_index_rows("triangles that are touched", given, 3, count, "nodes")
        checks.keep(self, nodes=touching, triangles=corners)


@dataclass(frozen=True, eq=False)
class ObstacleData(checks.Frozen):
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

    nodes: checks.Indices
    segment: str
    surface: SurfaceData

    def __init__(self, nodes: ArrayLike, segment: str, surface: SurfaceData) -> None:
        checks.as_text("segment of an obstacle", segment)
        checks.check_instance("surface of an obstacle", surface, SurfaceData)
        held = checks.as_indices("nodes before an obstacle", nodes)
        checks.keep(self, nodes=held, segment=segment, surface=surface)
