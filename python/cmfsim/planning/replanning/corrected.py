"""A planning model whose operator is corrected by exact solutions of plans around the reference."""

from dataclasses import replace

import numpy as np

from cmfsim.planning.replanning.correction import PlanNumbers, fitted_correction
from cmfsim.planning.replanning.expected_error import (
    moving_segments,
    plan_distance,
    plans_near,
    segment_boxes,
    solved_plans,
)
from cmfsim.planning.replanning.model import PlanningModel
from cmfsim.values.checks import as_positive, as_whole
from cmfsim.values.progress import PLANNING, ProgressOrBar, shown_progress

CORRECTING = "solving nearby plans to correct the operator"
# Plans that are solved for a correction.
CORRECTIONS = 16
# With fewer solved plans, interpolation between them is meaningless.
LEAST_PLANS = 8


def corrected_planning(
    planning: PlanningModel,
    plans: int = CORRECTIONS,
    *,
    shift: float = 5.0,
    turn: float = 5.0,
    seed: int = 0,
    progress: ProgressOrBar = None,
) -> PlanningModel:
    """The planning model with its operator corrected by exact solutions, if this lowers the error.

    Plans are drawn as in `expected_error`, but they are different plans. The error of the operator
    is interpolated between them (`PlanCorrection`). The correction is not used if it does not lower
    the error at plans to which it was not fitted.

    Parameters
    ----------
    planning : PlanningModel
    plans : int
        Number of plans solved exactly. Fewer than 8 are not enough to interpolate, and nothing is
        corrected; 0 solves none.
    shift : float, mm
    turn : float, degrees
        The range of the plans: along each axis, and about any axis.
    seed : int
    progress : callable or bool, optional
        Called with the name of each stage as it begins; True shows a bar (tqdm).

    Returns
    -------
    PlanningModel
        The same model, unless its product is not exact, enough plans could be solved, and the
        correction helps.

    Raises
    ------
    CaseError
        (also `ValueError`) A count below 0; a range that is not above 0.

    Examples
    --------
    >>> import cmfsim
    >>> planning = cmfsim.corrected_planning(planning)  # doctest: +SKIP
    >>> planning.correction.left_out.max()  # doctest: +SKIP
    0.33
    """
    shift, turn = as_positive("shift", shift), as_positive("turn", turn)
    as_whole("plans", plans, 0)
    bare = replace(planning, correction=None)
    if planning.is_exact or plans < LEAST_PLANS:
        return bare
    boxes = segment_boxes(bare)
    numbers = PlanNumbers.about(bare.reference, {n: boxes[n] for n in moving_segments(bare)})
    # A stream of its own, so that no plan is one of those by which the error is measured.
    drawn = plans_near(bare, np.random.default_rng((seed, 1)), plans, (shift, turn))
    places, distances, errors = [], [], []
    with shown_progress(progress, {CORRECTING: PLANNING[CORRECTING]}) as shown:
        shown(f"{CORRECTING} (1 of {plans})")
        for number, solved in enumerate(solved_plans(bare, drawn)):
            shown(f"{CORRECTING} ({min(number + 2, plans)} of {plans})")
            if solved.shift is not None:
                places.append(numbers.of(drawn[number]))
                distances.append(plan_distance(bare, drawn[number]))
                errors.append(solved.shift - bare.displacements(drawn[number]))
    if len(places) < LEAST_PLANS:
        return bare
    correction, pays = fitted_correction(
        numbers, np.array(places), np.array(distances), np.array(errors)
    )
    return replace(bare, correction=correction) if pays else bare
