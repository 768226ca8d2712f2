"""Error against run time: what each choice of a prediction costs, and what it buys."""

from cmfsim.bench.choice import Choice, case_choice
from cmfsim.bench.frontier_run import frontier
from cmfsim.bench.pareto import pareto_front
from cmfsim.bench.rows import Frontier, FrontierRow, Spread
from cmfsim.bench.skin_points import SKIN, WHOLE, skin_errors
from cmfsim.bench.sweep import EDGES, FACTORS, reference_choice, sweep_choices
from cmfsim.bench.table import frontier_page

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
