"""Many cases, and many trials of one: cohorts by several models, and moved landmarks."""

from cmfsim.deferred import deferred

# A public name is a line of __init__.pyi.
__getattr__, __dir__, __all__ = deferred(__name__, __file__)
