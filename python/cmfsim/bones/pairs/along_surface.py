"""Averages of values along a surface."""

import math
from functools import cached_property
from typing import Any

import numpy as np

from cmfsim.bones.pairs.shape_fit import vertex_areas
from cmfsim.errors import BoundaryInputError, third_party
from cmfsim.surfaces.topology import edges_of
from cmfsim.values.checks import Floats
from cmfsim.values.surface_data import SurfaceData

# The least area of a vertex, mm²: one of triangles without area weighs next to nothing.
LEAST_AREA = 1e-9
# Error of averages from polynomials that are left out, as a share of the largest value.
LEFT_OUT = 1e-9


class AlongSurface:
    """A surface along which values are averaged.

    areas: (n,), mm², of the vertices, above 0.
    ends: (m, 2) int64. The two vertices of each edge.
    """

    def __init__(self, surface: SurfaceData) -> None:
        self.here = surface.vertices
        self.ends = edges_of(surface.triangles.astype(np.int64)).ends
        self.areas = np.maximum(vertex_areas(surface), LEAST_AREA)

    @cached_property
    def _walk(self) -> tuple[Any, float]:
        """The matrix of one step along edges, weighted by area, and how far it goes, mm²."""
        sparse = third_party(
            "scipy.sparse", "motions by vertices are compared", "imaging", BoundaryInputError
        )
        n, (a, b) = len(self.here), self.ends.T
        rows, columns = np.concatenate([a, b, np.arange(n)]), np.concatenate([b, a, np.arange(n)])
        weights = self.areas[columns]
        matrix = sparse.csr_array((weights, (rows, columns)), shape=(n, n))
        total = np.bincount(rows, weights, n)
        matrix = sparse.diags_array(1.0 / total) @ matrix
        far = ((self.here[a] - self.here[b]) ** 2).sum(axis=1)
        spread = np.bincount(
            np.concatenate([a, b]), np.concatenate([far * self.areas[b], far * self.areas[a]]), n
        )
        # Two dimensions: the variance along one axis is half of the mean square.
        return matrix, max(0.5 * float(np.median(spread / total)), 1e-6)

    def averaged(self, values: Floats, length: float) -> Floats:
        """Values averaged over a length along the surface (standard deviation), mm."""
        matrix, step = self._walk
        return _walked(matrix, max(round(length**2 / step), 1), values)

    def averaged_within(self, values: Floats, weight: Floats, length: float) -> Floats:
        """Values averaged over a length, weighted by positive weights."""
        total = self.averaged(weight, length)
        shape = (len(weight), *(1,) * (values.ndim - 1))
        averaged: Floats = self.averaged(values * weight.reshape(shape), length) / total.reshape(
            shape
        )
        return averaged


def _walked(matrix: Any, steps: int, values: Floats) -> Floats:
    """Values after so many steps of a walk.

    A power of a matrix with eigenvalues from -1 to 1, as those of a reversible walk, is a sum of
    Chebyshev polynomials weighted by binomial coefficients, of which the first suffice (Sachdeva &
    Vishnoi 2014, theorem 3.3): 105 products do for 256 steps.
    """
    degree = math.ceil(math.sqrt(2.0 * steps * math.log(2.0 / LEFT_OUT)))
    if degree >= steps:
        for _ in range(steps):
            values = matrix @ values
        return values
    before, now = values, matrix @ values
    sums = np.zeros_like(values)
    for k in range(degree + 1):
        if (steps - k) % 2 == 0:
            sums += (2.0 if k else 1.0) * (math.comb(steps, (steps - k) // 2) / 2**steps) * before
        before, now = now, 2.0 * (matrix @ now) - before
    return sums
