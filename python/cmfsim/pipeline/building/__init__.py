"""From a case to the patient's model: here alone the stages before a solve are strung together."""

from cmfsim.deferred import deferred

__getattr__, __dir__, __all__ = deferred(
    __name__,
    {
        "case_model": (
            "build_case",
            "build_model",
        ),
        "inputs": (
            "case_key",
            "check_output",
            "input_hashes",
            "plan_key",
        ),
        "muscles": ("with_muscles",),
        "postoperative": (
            "Postoperative",
            "read_postoperative",
        ),
    },
)
