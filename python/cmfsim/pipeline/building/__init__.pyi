from cmfsim.pipeline.building.case_model import build_case, build_model
from cmfsim.pipeline.building.inputs import case_key, check_output, input_hashes, plan_key
from cmfsim.pipeline.building.muscles import with_muscles
from cmfsim.pipeline.building.postoperative import Postoperative, read_postoperative

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
]
