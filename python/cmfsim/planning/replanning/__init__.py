"""New plans for a patient who is built: by one small product, or solved exactly."""

from cmfsim.planning.replanning.expected_error import (
    ExpectedError,
    PlanTrial,
    expected_error,
    plan_distance,
    segment_boxes,
)
from cmfsim.planning.replanning.model import Motions, PlanningModel, planning_model

__all__ = [
    "ExpectedError",
    "Motions",
    "PlanTrial",
    "PlanningModel",
    "expected_error",
    "plan_distance",
    "planning_model",
    "segment_boxes",
]
