"""Node kinds: what each node of a mesh does (paper 2.5)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError
from cmfsim.values.checks import Frozen, check_one_of, frozen, keep

# Kinds of node (paper 2.5), by the number that files hold.
NODE_KINDS = ("free", "fixed", "joined", "sliding")


@dataclass(frozen=True, eq=False)
class NodeKinds(Frozen):
    """The kind of each node of a mesh (paper 2.5, Figure 4).

    Attributes
    ----------
    kind : (n,) uint8
        0 free, 1 fixed, 2 joined, 3 sliding: the order of `NODE_KINDS` in scene files.
    segment : (n,) int16
        Index into `segments` of the nodes that lie on a segment: joined, sliding, and those that
        are fixed on bone; −1 elsewhere.
    segments : tuple of str
    """

    kind: NDArray[np.uint8]
    segment: NDArray[np.int16]
    segments: tuple[str, ...]

    def __post_init__(self) -> None:
        kind = np.asarray(self.kind, dtype=np.uint8)
        segment = np.asarray(self.segment, dtype=np.int16)
        if kind.ndim != 1 or segment.shape != kind.shape:
            raise CaseInputError(f"kind has shape {kind.shape}, segment {segment.shape}: (n,) both")
        bad = np.flatnonzero((kind > 3) | ((kind >= 2) & (segment < 0)))
        if len(bad) or (segment >= len(self.segments)).any():
            raise CaseInputError("kind is 0 to 3, and joined and sliding nodes need a segment")
        keep(self, kind=frozen(kind), segment=frozen(segment))

    def of_nodes(self, nodes: NDArray[np.integer]) -> "NodeKinds":
        """The kinds of some nodes, in their order: of the mesh that has only these."""
        return NodeKinds(self.kind[nodes], self.segment[nodes], self.segments)

    def nodes(self, kind: str, segment: str | None = None) -> NDArray[np.uint32]:
        """The indices of the nodes of a kind ("free", "fixed", "joined", "sliding")."""
        check_one_of("kind", kind, NODE_KINDS)
        chosen = self.kind == NODE_KINDS.index(kind)
        if segment is not None:
            check_one_of("segment", segment, self.segments)
            chosen &= self.segment == self.segments.index(segment)
        return np.flatnonzero(chosen).astype(np.uint32)
