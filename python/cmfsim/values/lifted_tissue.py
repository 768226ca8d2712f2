"""Tissue that is lifted off the bone above a cut, where the plan does not press it on the bone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim._core import SurfaceMotion
from cmfsim.values.checks import Floats, Frozen, Indices
from cmfsim.values.scene import SegmentData
from cmfsim.values.surface_data import MovedSurface

Plan = Mapping[str, ArrayLike | MovedSurface]


@dataclass(frozen=True, eq=False)
class LiftedTissue(Frozen):
    """Nodes of the skull near the pieces that were cut off it, where periosteum was lifted.

    Attributes
    ----------
    skull : str
        The segment that the nodes lie on.
    is_joined : bool
        Whether its nodes are joined to it, because it may move itself; otherwise they are fixed.
    pieces : tuple of str
        The segments that were cut off it.
    nodes : (k,) uint32
    piece : (k,) int64
        Place in `pieces` of the one that is nearest to each node.
    places : (k, 3) float64, mm
    normals : (k, 3) float64
        Unit normals out of the skull.
    """

    skull: str
    is_joined: bool
    pieces: tuple[str, ...]
    nodes: Indices
    piece: NDArray[np.int64]
    places: Floats
    normals: Floats

    def without(self, others: Indices) -> LiftedTissue:
        """The same without some nodes, (l,) uint32."""
        kept = ~np.isin(self.nodes, others)
        return replace(
            self,
            nodes=self.nodes[kept],
            piece=self.piece[kept],
            places=self.places[kept],
            normals=self.normals[kept],
        )

    def free(self, plan: Plan) -> Indices:
        """The nodes that the pieces' motions do not press against the skull, (l,) uint32.

        They follow the tissue around them; the others stay on the bone, through which nothing
        moves. At the border between both the motion is along the bone, so that a node that changes
        sides changes little.

        Parameters
        ----------
        plan : mapping of str to (4, 4) float64, mm, (j, 3) float64, mm, or MovedSurface
            As in `Scene.plan`; what it does not name stays.
        """
        moves = np.zeros_like(self.places)
        for number, name in enumerate(self.pieces):
            own = self.piece == number
            if name in plan and own.any():
                moves[own] = _moves(plan[name], self.places[own])
        if self.skull in plan and self.is_joined:
            moves -= _moves(plan[self.skull], self.places)
        away = np.einsum("ka,ka->k", moves, self.normals)
        found: Indices = self.nodes[away >= 0.0]
        return found

    def held(
        self, fixed: Indices, segments: Mapping[str, SegmentData], plan: Plan
    ) -> tuple[Indices, dict[str, SegmentData]]:
        """The fixed nodes and the segments of a scene under a plan, without the nodes it frees.

        Parameters
        ----------
        fixed : (f,) uint32
            Fixed nodes of the scene; whether lifted ones are among them does not matter.
        segments : mapping of str to SegmentData
            Of the scene; the same is true of what is joined to them.
        plan : as for `free`
        """
        made = dict(segments)
        if not self.is_joined:
            return self._without_free(fixed, plan), made
        own, motion = made.get(self.skull), plan.get(self.skull, np.eye(4))
        # Displacements of each joined node belong to these nodes, and to no others.
        if own is not None and (isinstance(motion, MovedSurface) or _is_matrix(motion)):
            made[self.skull] = replace(own, joined=self._without_free(own.joined, plan))
        return fixed, made

    def _without_free(self, others: Indices, plan: Plan) -> Indices:
        all_of = np.union1d(others, self.nodes)
        return np.setdiff1d(all_of, self.free(plan)).astype(np.uint32)


def _moves(motion: ArrayLike | MovedSurface, places: Floats) -> Floats:
    """How a motion moves bone at places, (k, 3) mm."""
    if isinstance(motion, MovedSurface):
        surface = motion.surface.searched
        return SurfaceMotion(surface, motion.moved_vertices).displacement(places)
    values = np.asarray(motion, dtype=np.float64)
    if _is_matrix(values):
        return places @ values[:3, :3].T + values[:3, 3] - places
    return np.broadcast_to(values.mean(axis=0), places.shape)


def _is_matrix(motion: ArrayLike) -> bool:
    return np.asarray(motion).shape == (4, 4)
