"""Places and numbers as findings write them."""

import numpy as np
from numpy.typing import ArrayLike

__all__ = ["place_text"]


def place_text(point: ArrayLike) -> str:
    """A point as (L, P, S) with a tenth of a mm."""
    return "(" + ", ".join(f"{x:.1f}" for x in np.asarray(point, dtype=float).tolist()) + ")"
