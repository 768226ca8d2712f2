"""New plans for a patient who is built: by one small product, or solved exactly."""

from cmfsim.planning.replanning.corrected import CORRECTIONS as CORRECTIONS
from cmfsim.planning.replanning.corrected import corrected_planning as corrected_planning
from cmfsim.planning.replanning.correction import PlanCorrection as PlanCorrection
from cmfsim.planning.replanning.expected_error import TRIALS as TRIALS
from cmfsim.planning.replanning.expected_error import USUAL as USUAL
from cmfsim.planning.replanning.expected_error import ExpectedError as ExpectedError
from cmfsim.planning.replanning.expected_error import PlanTrial as PlanTrial
from cmfsim.planning.replanning.expected_error import expected_error as expected_error
from cmfsim.planning.replanning.expected_error import plan_distance as plan_distance
from cmfsim.planning.replanning.expected_error import segment_boxes as segment_boxes
from cmfsim.planning.replanning.model import Motions as Motions
from cmfsim.planning.replanning.model import PlanningModel as PlanningModel
from cmfsim.planning.replanning.model import planning_model as planning_model
from cmfsim.planning.replanning.plan_band import PlanBand as PlanBand
from cmfsim.planning.replanning.plan_band import plan_band as plan_band
