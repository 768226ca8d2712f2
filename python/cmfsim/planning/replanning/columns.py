"""The columns of a plan operator with the centres that they are taken about.

The displacement of the operator's nodes is u(q) = u₀ + Σ_s A_s q_s, with twelve numbers of each
segment: q_s = (R − I row by row, t + (R − I) c_s) for the motion x ↦ R x + t. The core gives A and
c_s; u₀ is its answer to the plan in which nothing moves.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim._core import PlanOperator
from cmfsim.checks import Floats, frozen
from cmfsim.errors import SolverError
from cmfsim.values.motion import rigid_motion

__all__ = ["COLUMNS", "PlanColumns", "plan_columns"]

# Numbers of a segment: nine of R − I, three of the shift of its centre.
COLUMNS = 12
# What the columns may differ by from the operator that they come from, mm for a turn of 7°.
AGREEMENT = 1e-6


@dataclass(frozen=True, eq=False)
class PlanColumns:
    """A linear map from the rigid motions of segments to displacements.

    Attributes
    ----------
    segments : tuple of str
        In the order of the columns.
    centres : (s, 3) float64, mm, LPS
        The point of each segment that its columns are taken about.
    matrix : (k, 3, 12 s) float64
        Of each node and axis: for each segment nine columns of R − I, row by row, mm, and three of
        the shift of its centre.
    offset : (k, 3) float64, mm
        Displacements where no segment moves: rest gaps that contact closes.
    """

    segments: tuple[str, ...]
    centres: Floats
    matrix: Floats
    offset: Floats

    def numbers(self, plan: Mapping[str, ArrayLike]) -> Floats:
        """The numbers q of a plan, (12 s,): R − I of each segment, then the shift of its centre."""
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
    """The columns of an operator, with their centres, checked against what it answers.

    Parameters
    ----------
    operator : PlanOperator

    Returns
    -------
    PlanColumns

    Raises
    ------
    SolverError
        The columns do not give what the operator answers.
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
            f"the columns of the plan operator differ by {worst:.1e} mm from what it answers: "
            f"at most {AGREEMENT:g} mm is rounding; please report this"
        )
