"""New plans for a patient who is built: by one small product, or solved exactly."""

from cmfsim.planning.replanning.corrected import CORRECTIONS, corrected_planning
from cmfsim.planning.replanning.correction import PlanCorrection
from cmfsim.planning.replanning.expected_error import (
    TRIALS,
    USUAL,
    ExpectedError,
    PlanTrial,
    expected_error,
    plan_distance,
    segment_boxes,
)
from cmfsim.planning.replanning.model import Motions, PlanningModel, planning_model
from cmfsim.planning.replanning.plan_band import PlanBand, plan_band

__all__ = [
    "CORRECTIONS",
    "TRIALS",
    "USUAL",
    "ExpectedError",
    "Motions",
    "PlanBand",
    "PlanCorrection",
    "PlanTrial",
    "PlanningModel",
    "corrected_planning",
    "expected_error",
    "plan_band",
    "plan_distance",
    "planning_model",
    "segment_boxes",
]
