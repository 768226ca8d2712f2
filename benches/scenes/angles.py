"""The angle between vectors, accurate to rounding even if they are nearly parallel."""

import numpy as np
from numpy.typing import ArrayLike, NDArray


def angle_between(one: ArrayLike, other: ArrayLike) -> NDArray[np.float64]:
    """The angle between vectors of any length, degrees: 0 to 180.

    The arccosine of a dot product loses half of the digits near 0 and 180°: a cosine that is off by
    one unit of rounding is an angle of 1.2e-6°. Sine and cosine together lose none.

    Parameters
    ----------
    one, other : (…, 3) array_like

    Returns
    -------
    (…) float64, degrees

    Raises
    ------
    ValueError
        A vector of length 0.
    """
    one, other = np.asarray(one, dtype=np.float64), np.asarray(other, dtype=np.float64)
    if not (one.any(axis=-1).all() and other.any(axis=-1).all()):
        raise ValueError("a vector of length 0 has no direction")
    sine = np.linalg.norm(np.cross(one, other), axis=-1)
    cosine = (one * other).sum(axis=-1)
    return np.asarray(np.degrees(np.arctan2(sine, cosine)))


def angle_of_lines(one: ArrayLike, other: ArrayLike) -> NDArray[np.float64]:
    """The angle between lines, of which either direction counts, degrees: 0 to 90."""
    angle = angle_between(one, other)
    return np.minimum(angle, 180.0 - angle)


def angle_of_rotation(rotation: ArrayLike) -> float:
    """The angle of a (3, 3) rotation, degrees: 0 to 180.

    Its antisymmetric part has the sine, its trace the cosine.
    """
    r = np.asarray(rotation, dtype=np.float64)
    axis = [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]
    return float(np.degrees(np.arctan2(np.linalg.norm(axis), np.trace(r) - 1.0)))
