"""Least squares with bounds: Levenberg-Marquardt steps in the numbers that are not at a bound.

It minimises |r(x)|² / 2. A step solves (JᵀJ + μ D) δ = −Jᵀr for the free numbers, where D is the
diagonal of JᵀJ (Marquardt 1963). A number at a bound is released when the gradient points inside.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cmfsim.values.checks import Floats

# Forward differences, mm and degrees: residuals are smooth on this scale, and central differences
# would cost twice as much.
STEP = 1e-4
# Initial μ, and its factors after a step that failed and after one that succeeded.
FIRST_DAMPING, HARDER, SOFTER = 1e-3, 10.0, 0.1
MOST_DAMPING = 1e12
# A step below this, mm or degrees, ends the search.
STILL = 1e-7
# So does one that would lower the sum of squares by less than this share, along a valley that
# residuals do not determine.
FLAT = 1e-10


@dataclass(frozen=True, eq=False)
class Minimum:
    """The result of a search.

    Attributes
    ----------
    x : (n,) float64
    residuals : (m,) float64
    jacobian : (m, n) float64
    steps : int
    converged : bool
        Whether the next step is too small to matter, before the steps ran out.
    """

    x: Floats
    residuals: Floats
    jacobian: Floats
    steps: int
    converged: bool


def bounded_least_squares(
    residuals: Callable[[Floats], Floats], start: Floats, low: Floats, high: Floats, *, steps: int
) -> Minimum:
    """The minimum of a sum of squares within bounds, found from a starting point.

    Parameters
    ----------
    residuals : callable
        Maps (n,) numbers to (m,) residuals.
    start, low, high : (n,) float64
    steps : int
        Maximum number of steps.

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
            change = jacobian @ step
            still = float(np.abs(there - x).max()) <= STILL
            still |= float(-2.0 * (r @ change) - change @ change) <= FLAT * float(r @ r)
            if still or damping > MOST_DAMPING:
                return Minimum(x, r, jacobian, taken, converged=still)
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
