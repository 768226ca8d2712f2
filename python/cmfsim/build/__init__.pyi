from cmfsim.build.case_model import build_case, build_model
from cmfsim.build.inputs import case_key, check_output, input_hashes, plan_key
from cmfsim.build.muscles import with_muscles
from cmfsim.build.phantom_case import write_phantom_case
from cmfsim.build.postoperative import Postoperative, read_postoperative

__all__ = [
    "Postoperative",
    "build_case",
    "build_model",
    "case_key",
    "check_output",
    "input_hashes",
    "plan_key",
    "read_postoperative",
    "with_muscles",
    "write_phantom_case",
]
