"""Places, directions and shifts as findings write them."""

import numpy as np

from cmfsim.values.checks import Floats

# A direction is named by its largest component, and by another that is at least this share of it.
NAMED_SHARE = 0.6
# Components of a shift that are named: at least this share of the largest.
SHIFT_SHARE = 0.3
# Towards the negative and the positive end of each axis, L, P, S.
DIRECTIONS = (("to the right of", "to the left of"), ("in front of", "behind"), ("below", "above"))
SHIFTS = (
    ("too far to the right", "too far to the left"),
    ("too far forwards", "too far back"),
    ("too low", "too high"),
)


def place_text(point: Floats) -> str:
    """A point as (L, P, S) with a tenth of a mm."""
    return "(" + ", ".join(f"{x:.1f}" for x in point) + ")"


def direction_text(offset: Floats) -> str:
    """Where a thing lies that is off by an LPS vector, in words: "above", "behind and below"."""
    sizes = np.abs(offset)
    order = np.argsort(-sizes, kind="stable")[:2]
    named = [a for a in order if sizes[a] > 0.0 and sizes[a] >= NAMED_SHARE * sizes[order[0]]]
    return " and ".join(DIRECTIONS[a][int(offset[a] > 0.0)] for a in named) or "on"


def shift_text(offset: Floats) -> str:
    """An LPS vector in words: "5.0 mm too high and 2.0 mm too far back"."""
    sizes = np.abs(offset)
    named = [a for a in np.argsort(-sizes, kind="stable") if sizes[a] >= SHIFT_SHARE * sizes.max()]
    return " and ".join(f"{sizes[a]:.1f} mm {SHIFTS[a][int(offset[a] > 0.0)]}" for a in named)
