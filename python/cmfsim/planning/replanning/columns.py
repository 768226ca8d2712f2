"""The columns of a plan operator, and the centres to which they refer.

The displacement of the operator's nodes is u(q) = u₀ + Σ_s A_s q_s, with twelve numbers for each
segment: q_s = (R − I row by row, t + (R − I) c_s) for the motion x ↦ R x + t. The core provides A
and c_s; u₀ is the displacement under the plan that moves nothing.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim._core import PlanOperator
from cmfsim.errors import SolverError
from cmfsim.values.checks import Floats, frozen
from cmfsim.values.motion import rigid_motion

# Numbers of a segment: nine of R − I, three for the displacement of its centre.
COLUMNS = 12
# Largest difference between the columns and their operator, mm, for a rotation by 7°.
AGREEMENT = 1e-6


@dataclass(frozen=True, eq=False)
class PlanColumns:
    """A linear map from the rigid motions of segments to displacements.

    segments: In the order of the columns.
    centres: (s, 3), mm, LPS. The point of each segment to which its columns refer.
    matrix: (k, 3, 12 s), for each node and axis: nine columns per segment for R − I, row by row,
        mm, and three for the displacement of its centre.
    offset: (k, 3), mm. Displacements if no segment moves: contact closes gaps that exist at rest.
    """

    segments: tuple[str, ...]
    centres: Floats
    matrix: Floats
    offset: Floats

    def numbers(self, plan: Mapping[str, ArrayLike]) -> Floats:
        """The numbers q of a plan, (12 s,): R − I of each segment, then its centre's motion."""
        found = []
        for name, centre in zip(self.segments, self.centres, strict=True):
            matrix = np.asarray(plan[name], dtype=np.float64)
            turn = matrix[:3, :3] - np.eye(3)
            found += [turn.ravel(), matrix[:3, 3] + turn @ centre]
        return np.concatenate(found)

    def displacements(self, plan: Mapping[str, ArrayLike]) -> Floats:
        """The displacements under a plan, (k, 3) mm."""
        return self.offset + self.matrix @ self.numbers(plan)


def plan_columns(operator: PlanOperator) -> PlanColumns:
    """The columns of an operator with their centres, checked against its displacements.

    Raises `SolverError`: The columns do not reproduce the displacements of the operator.
    """
    names = tuple(operator.segments)
    rest = {name: np.eye(4) for name in names}
    offset = operator(rest)
    matrix = operator.matrix.reshape(len(offset), 3, -1)
    centres = operator.centres
    columns = PlanColumns(names, frozen(centres), frozen(matrix), frozen(offset))
    _check(columns, operator)
    return columns


def _check(columns: PlanColumns, operator: PlanOperator) -> None:
    plan: dict[str, NDArray[np.float64]] = {
        name: rigid_motion((2.0, -3.0, 1.0), 7.0, (1.0, number, -2.0), centre)
        for number, (name, centre) in enumerate(zip(columns.segments, columns.centres, strict=True))
    }
    worst = float(np.abs(columns.displacements(plan) - operator(plan)).max(initial=0.0))
    if not worst <= AGREEMENT:
        raise SolverError(
            f"the columns of the plan operator differ from its displacements by {worst:.1e} mm; "
            f"rounding explains at most {AGREEMENT:g} mm: please report this"
        )
