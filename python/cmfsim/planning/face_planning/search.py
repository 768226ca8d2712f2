"""Least squares with bounds: Levenberg-Marquardt steps in the numbers that no bound holds.

Minimised is |r(x)|² / 2. A step solves (JᵀJ + μ D) δ = −Jᵀr over the free numbers, D the diagonal
of JᵀJ (Marquardt 1963); a number at its bound is free again where the gradient leads back inside.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cmfsim.checks import Floats

__all__ = ["Minimum", "bounded_least_squares"]

# Forward differences, mm and degrees: residuals are smooth on this scale, and central differences
# would cost twice as much.
STEP = 1e-4
# μ at the start, and what it is multiplied by after a step that failed or succeeded.
FIRST_DAMPING, HARDER, SOFTER = 1e-3, 10.0, 0.1
MOST_DAMPING = 1e12
# A step below this, mm or degrees, ends the search.
STILL = 1e-7


@dataclass(frozen=True, eq=False)
class Minimum:
    """Where a search ended.

    Attributes
    ----------
    x : (n,) float64
    residuals : (m,) float64
    jacobian : (m, n) float64
    steps : int
    converged : bool
        Whether the last step was too small to matter, before the steps ran out.
    """

    x: Floats
    residuals: Floats
    jacobian: Floats
    steps: int
    converged: bool


def bounded_least_squares(
    residuals: Callable[[Floats], Floats], start: Floats, low: Floats, high: Floats, *, steps: int
) -> Minimum:
    """The minimum of a sum of squares within bounds, from a start.

    Parameters
    ----------
    residuals : callable
        Of (n,) numbers: (m,) residuals.
    start, low, high : (n,) float64
    steps : int
        At most so many.

    Returns
    -------
    Minimum
    """
    x = np.clip(start, low, high)
    r = residuals(x)
    jacobian = _jacobian(residuals, x, r)
    damping, taken = FIRST_DAMPING, 0
    for taken in range(1, steps + 1):
        gradient = jacobian.T @ r
        free = ~(((x <= low) & (gradient > 0.0)) | ((x >= high) & (gradient < 0.0)))
        if not free.any():
            return Minimum(x, r, jacobian, taken, converged=True)
        normal = (jacobian.T @ jacobian)[np.ix_(free, free)]
        scale = np.maximum(np.diagonal(normal), 1e-12 * max(float(normal.max()), 1e-30))
        while True:
            step = np.zeros_like(x)
            step[free] = -np.linalg.solve(normal + damping * np.diag(scale), gradient[free])
            there = np.clip(x + step, low, high)
            moved = float(np.abs(there - x).max())
            if moved <= STILL or damping > MOST_DAMPING:
                return Minimum(x, r, jacobian, taken, converged=moved <= STILL)
            found = residuals(there)
            if found @ found < r @ r:
                break
            damping *= HARDER
        x, r = there, found
        damping *= SOFTER
        jacobian = _jacobian(residuals, x, r)
    return Minimum(x, r, jacobian, taken, converged=False)


def _jacobian(residuals: Callable[[Floats], Floats], x: Floats, here: Floats) -> Floats:
    columns = []
    for index in range(len(x)):
        step = np.zeros_like(x)
        step[index] = STEP
        columns.append((residuals(x + step) - here) / STEP)
    return np.stack(columns, axis=1)
