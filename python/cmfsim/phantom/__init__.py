"""A synthetic head, known exactly: anatomy alone. `cmfsim.lab.virtual` makes cases of it.

`make_head` returns a `PhantomHead` with skin, skull, mandible, teeth, airway, muscles and landmarks
as level functions, label images, CT-like images and closed surfaces; `HeadParameters` give other
people.
"""

from cmfsim.phantom.model import BONES as BONES
from cmfsim.phantom.model import LABELS as LABELS
from cmfsim.phantom.model import PhantomHead as PhantomHead
from cmfsim.phantom.model import make_head as make_head
from cmfsim.phantom.muscles import Muscle as Muscle
from cmfsim.phantom.parameters import PARAMETER_RANGES as PARAMETER_RANGES
from cmfsim.phantom.parameters import HeadParameters as HeadParameters
