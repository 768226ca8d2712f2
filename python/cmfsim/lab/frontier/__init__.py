"""Error against run time: what each choice of a prediction costs, and what it buys."""

from cmfsim.lab.frontier.choice import EDGES as EDGES
from cmfsim.lab.frontier.choice import FACTORS as FACTORS
from cmfsim.lab.frontier.choice import Choice as Choice
from cmfsim.lab.frontier.choice import case_choice as case_choice
from cmfsim.lab.frontier.choice import reference_choice as reference_choice
from cmfsim.lab.frontier.choice import sweep_choices as sweep_choices
from cmfsim.lab.frontier.files import frontier_page as frontier_page
from cmfsim.lab.frontier.frontier_run import frontier as frontier
from cmfsim.lab.frontier.rows import SKIN as SKIN
from cmfsim.lab.frontier.rows import WHOLE as WHOLE
from cmfsim.lab.frontier.rows import Frontier as Frontier
from cmfsim.lab.frontier.rows import FrontierRow as FrontierRow
from cmfsim.lab.frontier.rows import Spread as Spread
from cmfsim.lab.frontier.rows import skin_errors as skin_errors
