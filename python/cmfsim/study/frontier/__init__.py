"""Error against run time: what each choice of a prediction costs, and what it buys."""

from cmfsim.study.frontier.choice import Choice, case_choice
from cmfsim.study.frontier.frontier_run import frontier
from cmfsim.study.frontier.pareto import pareto_front
from cmfsim.study.frontier.rows import Frontier, FrontierRow, Spread
from cmfsim.study.frontier.skin_points import SKIN, WHOLE, skin_errors
from cmfsim.study.frontier.sweep import EDGES, FACTORS, reference_choice, sweep_choices
from cmfsim.study.frontier.table import frontier_page

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
