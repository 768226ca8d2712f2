"""A smooth displacement of space: quadratic B-splines on a lattice, with strain and bending."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError, third_party
from cmfsim.values.checks import Floats

# Number of coefficients of the quadratic B-spline that influence a point, along each axis.
REACH = 3


def sparse(name: str = "scipy.sparse") -> Any:
    """The package scipy.sparse, or a package inside it."""
    return third_party(name, "muscles are fitted", "imaging", CaseInputError)


@dataclass(frozen=True, eq=False)
class Lattice:
    """The positions of the coefficients of a displacement: only those that influence a muscle.

    origin: (3,), mm.
    spacing: mm.
    shape: (3,) int.
    number: (nx, ny, nz) int. The index of each coefficient; −1 where there is none.
    """

    origin: Floats
    spacing: float
    shape: NDArray[np.intp]
    number: NDArray[np.intp]

    @classmethod
    def round(cls, points: Floats, spacing: float) -> "Lattice":
        """The lattice that determines the displacement at the given points.

        points: (n, 3), mm.
        spacing: mm.
        """
        low, high = points.min(axis=0), points.max(axis=0)
        cells = np.ceil((high - low) / spacing).astype(np.intp) + 1
        # Centred: mirrored points get a mirrored lattice.
        origin = 0.5 * (low + high) - 0.5 * cells * spacing
        shape = cells + REACH - 1
        reached = np.zeros(shape, dtype=bool)
        held = np.zeros(shape, dtype=bool)
        held[tuple(np.floor((points - origin) / spacing).astype(np.intp).T)] = True
        first = np.argwhere(held)
        for i, j, k in np.ndindex(REACH, REACH, REACH):
            reached[first[:, 0] + i, first[:, 1] + j, first[:, 2] + k] = True
        number = np.full(shape, -1, dtype=np.intp)
        number[reached] = np.arange(np.count_nonzero(reached))
        return cls(origin, spacing, shape, number)

    @cached_property
    def size(self) -> int:
        """The number of coefficients, each a vector."""
        return int(self.number.max()) + 1

    def basis(self, points: Floats, derivative: int | None = None) -> Any:
        """The matrix from coefficients to the displacement at points, or to its derivative.

        points: (n, 3), mm.
        derivative: The axis along which to differentiate; by default, the displacement itself.
        Returns: (n, size) scipy.sparse.csr_matrix.
        """
        at = (points - self.origin) / self.spacing
        first = np.floor(at).astype(np.intp)
        weights = [
            _slopes(at[:, a] - first[:, a]) / self.spacing
            if a == derivative
            else _values(at[:, a] - first[:, a])
            for a in range(3)
        ]
        offset = np.arange(REACH)
        columns = self.number[
            first[:, 0, None, None, None] + offset[:, None, None],
            first[:, 1, None, None, None] + offset[:, None],
            first[:, 2, None, None, None] + offset,
        ].reshape(len(points), -1)
        data = np.einsum("na,nb,nc->nabc", *weights).reshape(len(points), -1)
        rows = np.arange(0, data.size + 1, REACH**3)
        shape = (len(points), self.size)
        return sparse().csr_matrix((data.ravel(), columns.ravel(), rows), shape=shape)

    def differences(self) -> tuple[Any, Any]:
        """First and second differences of neighbouring coefficients, in mm per mm and per mm².

        Returns: second : (…, size) scipy.sparse.csr_matrix. Rows are weighted by a cell's volume,
            so the sum of squares is an integral over space.
        """
        root = self.spacing**1.5
        first = [self._stencil([((0, 0, 0), -1.0), (e, 1.0)]) for e in _UNITS]
        second = [
            self._stencil([((0, 0, 0), 1.0), (e, -2.0), (tuple(2 * x for x in e), 1.0)])
            for e in _UNITS
        ]
        for a in range(3):
            for b in range(a):
                both = tuple(x + y for x, y in zip(_UNITS[a], _UNITS[b], strict=True))
                corners = [((0, 0, 0), 1.0), (_UNITS[a], -1.0), (_UNITS[b], -1.0), (both, 1.0)]
                # The mixed derivative occurs twice in the sum over all pairs.
                second.append(self._stencil([(o, np.sqrt(2.0) * w) for o, w in corners]))
        stack = sparse().vstack
        return (
            stack(first, format="csr") * (root / self.spacing),
            stack(second, format="csr") * (root / self.spacing**2),
        )

    def _stencil(self, parts: list[tuple[tuple[int, ...], float]]) -> Any:
        """A difference at each position where the lattice has all of its coefficients."""
        reach = np.max([offset for offset, _ in parts], axis=0)
        last = self.shape - reach
        views = []
        for offset, _ in parts:
            i, j, k = (slice(o, o + n) for o, n in zip(offset, last, strict=True))
            views.append(self.number[i, j, k])
        held = np.all([view >= 0 for view in views], axis=0)
        columns = np.stack([view[held] for view in views], axis=1)
        data = np.broadcast_to([w for _, w in parts], columns.shape)
        rows = np.arange(0, columns.size + 1, len(parts))
        shape = (len(columns), self.size)
        return sparse().csr_matrix((data.ravel(), columns.ravel(), rows), shape=shape)


_UNITS = ((1, 0, 0), (0, 1, 0), (0, 0, 1))


def _values(part: Floats) -> Floats:
    """The three quadratic B-splines at a fraction of a cell."""
    return np.stack([0.5 * (1 - part) ** 2, 0.5 + part * (1 - part), 0.5 * part**2], axis=1)


def _slopes(part: Floats) -> Floats:
    """Their derivatives with respect to that fraction."""
    return np.stack([part - 1.0, 1.0 - 2.0 * part, part], axis=1)
