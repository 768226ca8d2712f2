"""From a case to the patient's model: here alone the stages before a solve are strung together."""

from cmfsim.build.case_model import build_case, build_model
from cmfsim.build.phantom_case import write_phantom_case

__all__ = ["build_case", "build_model", "write_phantom_case"]
