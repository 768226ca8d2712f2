"""Smooth random deformations of a head as a few modes: a Gaussian process of low rank."""

from dataclasses import dataclass

import numpy as np

from cmfsim.values.checks import Floats

MIRROR = np.array([-1.0, 1.0, 1.0])
# Eigenvalues below this share of the largest are rounding.
ROUNDING = 1e-7


@dataclass(frozen=True)
class Kernel:
    """A sum of Gaussian covariances of a displacement.

    Attributes
    ----------
    parts : tuple of (float, float), mm
        Length and standard deviation of each.
    asymmetry : float
        Standard deviation of what differs between the sides, as a share of what they have in
        common.
    modes : int
        How many functions, even and odd each, stand for it.
    """

    parts: tuple[tuple[float, float], ...]
    asymmetry: float
    modes: int

    def covariance(self, a: Floats, b: Floats) -> Floats:
        """Of one component of the displacement at points a and b, (n, k) mm²."""
        squares = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2.0 * a @ b.T
        total: Floats = np.zeros_like(squares)
        for length, deviation in self.parts:
            total += deviation**2 * np.exp(-squares / length**2)
        return total


@dataclass(frozen=True, eq=False)
class SmoothModes:
    """Modes of displacement over space (Lüthi et al. 2018), even and odd about x = 0.

    Attributes
    ----------
    kernel : Kernel
    places : (k, 3) float64, mm
        With x ≥ 0: the modes are the leading eigenvectors of the covariance among them.
    even, odd : (k, r) float64
        What covariances with the places are multiplied by.
    """

    kernel: Kernel
    places: Floats
    even: Floats
    odd: Floats

    @classmethod
    def of(cls, kernel: Kernel, places: Floats) -> "SmoothModes":
        """The modes of a kernel by the covariance among places (Nyström)."""
        halves = []
        for covariance in _folded(kernel, places, places):
            values, vectors = np.linalg.eigh(covariance)
            order = np.argsort(-values)[: kernel.modes]
            order = order[values[order] > ROUNDING * values.max()]
            halves.append(vectors[:, order] / np.sqrt(values[order]))
        return cls(kernel, places, halves[0], halves[1])

    def at(self, points: Floats) -> Floats:
        """The displacements at points by unit coefficients, (n, 3, modes) mm."""
        of_even, of_odd = _folded(self.kernel, points, self.places)
        even, odd = of_even @ self.even, of_odd @ self.odd
        blocks = []
        # Even: across odd, back and up even. What differs between the sides is the reverse.
        for across, along, share in ((odd, even, 1.0), (even, odd, self.kernel.asymmetry)):
            for axis, functions in ((0, across), (1, along), (2, along)):
                block = np.zeros((len(points), 3, functions.shape[1]))
                block[:, axis] = share * functions
                blocks.append(block)
        return np.concatenate(blocks, axis=2)


def _folded(kernel: Kernel, a: Floats, b: Floats) -> tuple[Floats, Floats]:
    """The covariances of displacements that are even and odd about x = 0."""
    same, mirrored = kernel.covariance(a, b), kernel.covariance(a, b * MIRROR)
    return same + mirrored, same - mirrored
