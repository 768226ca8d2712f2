"""Error against run time: what each choice of a prediction costs, and what it buys."""

from cmfsim.lab.frontier.choice import (
    EDGES,
    FACTORS,
    Choice,
    case_choice,
    reference_choice,
    sweep_choices,
)
from cmfsim.lab.frontier.files import frontier_page
from cmfsim.lab.frontier.frontier_run import frontier
from cmfsim.lab.frontier.rows import Frontier, FrontierRow, Spread, pareto_front
from cmfsim.lab.frontier.skin_points import SKIN, WHOLE, skin_errors

__all__ = [
    "EDGES",
    "FACTORS",
    "SKIN",
    "WHOLE",
    "Choice",
    "Frontier",
    "FrontierRow",
    "Spread",
    "case_choice",
    "frontier",
    "frontier_page",
    "pareto_front",
    "reference_choice",
    "skin_errors",
    "sweep_choices",
]
