"""The choices that no other choice beats in both of two costs."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.errors import CaseInputError
from cmfsim.values.checks import as_floats


def pareto_front(first: ArrayLike, second: ArrayLike) -> NDArray[np.bool_]:
    """Which rows no other row beats: as low in both costs, and lower in one. (k,) bool.

    Rows that are equal in both do not beat each other.

    Parameters
    ----------
    first, second : (k,) float64
        Costs: the lower the better.

    Raises
    ------
    CaseError
        (also `ValueError`) Unlike lengths, NaN.

    Examples
    --------
    >>> from cmfsim.lab.frontier import pareto_front
    >>> pareto_front([1.0, 2.0, 3.0, 2.5], [9.0, 4.0, 4.0, 1.0]).tolist()
    [True, True, False, True]
    """
    x, y = as_floats("first cost", first), as_floats("second cost", second)
    if x.ndim != 1 or x.shape != y.shape:
        raise CaseInputError(f"costs have shapes {x.shape} and {y.shape}: two of (k,) are needed")
    # By the first cost, then by the second: what comes before a row costs no more in the first.
    order = np.lexsort((y, x))
    on_front = np.zeros(len(x), dtype=bool)
    best, best_at = np.inf, np.nan
    for row in order:
        if y[row] < best or (y[row] == best and x[row] == best_at):
            on_front[row] = True
            best, best_at = y[row], x[row]
    return on_front
