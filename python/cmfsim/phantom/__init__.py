"""A synthetic head, known exactly: anatomy alone. `cmfsim.lab.virtual` makes cases of it.

`make_head` returns a `PhantomHead` with skin, skull, mandible, teeth, airway, muscles and landmarks
as level functions, label images, CT-like images and closed surfaces; `HeadParameters` give other
people.
"""

from cmfsim.phantom.model import BONES, LABELS, PhantomHead, make_head
from cmfsim.phantom.muscles import Muscle
from cmfsim.phantom.parameters import PARAMETER_RANGES, HeadParameters

__all__ = [
    "BONES",
    "LABELS",
    "PARAMETER_RANGES",
    "HeadParameters",
    "Muscle",
    "PhantomHead",
    "make_head",
]
