"""One lip on the boundary of a mesh."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from cmfsim.values.checks import Frozen, frozen

LIPS = ("upper", "lower")


@dataclass(frozen=True, eq=False)
class LipRegion(Frozen):
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
        for name in ("triangles", "nodes"):
            object.__setattr__(self, name, frozen(np.asarray(getattr(self, name), np.uint32)))
        object.__setattr__(self, "released", MappingProxyType(dict(self.released)))
