"""From a case to the patient's model: here alone the stages before a solve are strung together."""

from cmfsim.deferred import deferred

# A public name is a line of __init__.pyi.
__getattr__, __dir__, __all__ = deferred(__name__, __file__)
