"""The face after cranio-maxillofacial surgery, by the mass-tensor model.

Lengths are mm, forces N, moduli MPa; internal forces are K u. Importing this package and solving
with it needs numpy alone. Research software: it is not a medical device.
"""

from cmfsim.deferred import deferred

# A public name is a line of __init__.pyi.
__getattr__, __dir__, __all__ = deferred(__name__, __file__)
