"""Tissue that is lifted off the bone above a cut, where the plan does not press it on the bone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from cmfsim._core import Surface, SurfaceMotion
from cmfsim.values.checks import Floats, Indices
from cmfsim.values.frozen import Frozen
from cmfsim.values.surface_data import MovedSurface

__all__ = ["LiftedTissue"]


@dataclass(frozen=True, eq=False)
class LiftedTissue(Frozen):
    """Nodes of the bone that stays, near a piece that is moved, where periosteum was lifted.

    Attributes
    ----------
    segment : str
        The piece that is moved.
    nodes : (k,) uint32
    places : (k, 3) float64, mm
    normals : (k, 3) float64
        Unit normals out of the bone that stays.
    """

    segment: str
    nodes: Indices
    places: Floats
    normals: Floats

    def free(self, motion: ArrayLike | MovedSurface) -> Indices:
        """The nodes that the piece's motion does not press against the bone, (l,) uint32.

        They follow the tissue around them; the others stay on the bone, through which nothing
        moves. At the border between both the motion is along the bone, so that a node that changes
        sides changes little.

        Parameters
        ----------
        motion : (4, 4) float64, mm, (j, 3) float64, mm, or MovedSurface
            As in `Scene.plan`.
        """
        if isinstance(motion, MovedSurface):
            surface = Surface(motion.surface.vertices, motion.surface.triangles)
            moves = SurfaceMotion(surface, motion.moved_vertices).displacement(self.places)
        else:
            values = np.asarray(motion, dtype=np.float64)
            if values.shape == (4, 4):
                moves = self.places @ values[:3, :3].T + values[:3, 3] - self.places
            else:
                moves = np.broadcast_to(values.mean(axis=0), self.places.shape)
        away = np.einsum("ka,ka->k", moves, self.normals)
        found: Indices = self.nodes[away >= 0.0]
        return found

    def fixed(self, others: Indices, motion: ArrayLike | MovedSurface) -> Indices:
        """The fixed nodes of a scene: those that are not lifted, and what a motion presses on bone.

        Parameters
        ----------
        others : (f,) uint32
            Fixed nodes of the scene; whether lifted ones are among them does not matter.
        motion : as for `free`
        """
        all_of = np.union1d(others, self.nodes)
        return np.setdiff1d(all_of, self.free(motion)).astype(np.uint32)
