"""The deviation of the plan operator from exact solutions, away from its reference plan."""

import os
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cmfsim.errors import ContactError, SolverError
from cmfsim.planning.replanning.model import Motions, PlanningModel
from cmfsim.values.checks import Floats, Plain, as_positive, as_whole, in_files, plain
from cmfsim.values.motion import carried, rigid_motion
from cmfsim.values.progress import PLANNING, ProgressOrBar, shown_progress

# Plans that are solved to measure the error.
TRIALS = 6
TRYING = "solving a nearby plan exactly"
# Plans are tried at these shares of the range, one after the other.
SHARES = (1.0, 0.5)
# Solutions at once: each takes memory for its own vectors.
MOST_AT_ONCE = 4
# The usual error is the one that this percentage of the plans stays within.
USUAL = 90.0


@dataclass(frozen=True, eq=False)
class PlanTrial(Plain):
    """One plan, computed by the product and solved exactly.

    Attributes
    ----------
    plan : mapping of str to (4, 4) float64, mm
    distance : float, mm
        From the reference plan, as `plan_distance`.
    mean, p95, largest : float or None, mm
        Distance between the two results over the vertices of the skin; None if `failed`.
    failed : str
        Why the plan could not be solved; empty if it could.
    seconds : float
        Of the exact solution.
    """

    plan: Mapping[str, Floats] = field(metadata=in_files(None))
    distance: float = field(metadata=in_files("distance_mm"))
    mean: float | None = field(metadata=in_files("mean_mm"))
    p95: float | None = field(metadata=in_files("p95_mm"))
    largest: float | None = field(metadata=in_files("largest_mm"))
    failed: str
    seconds: float


@dataclass(frozen=True, eq=False)
class ExpectedError:
    """The error of the product near the reference, from exact solutions; an estimate, not a bound.

    Attributes
    ----------
    trials : tuple of PlanTrial
    shift, turn : float, mm and degrees
        The range: along each axis, and about any axis.
    is_exact : bool
        Whether nothing slides and no plan lifts other tissue: the product is then exact.
    left_out : (n, 3) float64, mm
        Distance, mean and largest error of the plans that correct the operator, each with the
        correction fitted to all others; none where nothing is corrected.
    """

    trials: tuple[PlanTrial, ...]
    shift: float
    turn: float
    is_exact: bool
    left_out: Floats

    @property
    def reach(self) -> float:
        """The largest distance from the reference at which a plan was solved, mm."""
        return float(self._measured()[:, 0].max(initial=0.0))

    def at(self, distance: float) -> tuple[float, float] | None:
        """Mean and largest error to expect at a distance from the reference, mm.

        The largest measured ratio of error to distance, times the distance, over all trials and
        all plans that were left out of the correction. The error grows faster than the distance,
        so this overestimates near the reference. None beyond `reach`, where no plan was tried.
        """
        if distance > self.reach and not self.is_exact:
            return None
        mean, largest = self._ratios().max(axis=0, initial=0.0)
        return distance * float(mean), distance * float(largest)

    def usual(self, distance: float) -> float | None:
        """The error that nine of ten plans stay below at a distance, mm, as in `at`."""
        if distance > self.reach and not self.is_exact:
            return None
        ratios = self._ratios()[:, 1]
        return distance * float(np.percentile(ratios, USUAL)) if len(ratios) else 0.0

    def _measured(self) -> Floats:
        """Distance, mean and largest error of each plan that was solved, (n, 3) mm."""
        rows = [(t.distance, t.mean, t.largest) for t in self.trials if not t.failed]
        return np.concatenate([np.array(rows, dtype=np.float64).reshape(-1, 3), self.left_out])

    def _ratios(self) -> Floats:
        """Mean and largest error over the distance, (n, 2); none where the product is exact."""
        found = np.zeros((0, 3)) if self.is_exact else self._measured()
        return found[:, 1:] / found[:, :1]

    def as_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return {
            "shift_mm": self.shift,
            "turn_degrees": self.turn,
            "is_exact": self.is_exact,
            "reach_mm": self.reach,
            "trials": plain(self.trials),
            "left_out": [
                {"distance_mm": distance, "mean_mm": mean, "largest_mm": largest}
                for distance, mean, largest in self.left_out.tolist()
            ],
        }


def plan_distance(planning: PlanningModel, plan: Motions) -> float:
    """How far a plan is from the reference: the most that a corner of a segment's box moves, mm."""
    whole = planning.whole(plan)
    apart = {name: motion - planning.reference[name] for name, motion in whole.items()}
    return max(
        float(np.linalg.norm(carried(apart[name], corners), axis=1).max())
        for name, corners in segment_boxes(planning).items()
    )


def segment_boxes(planning: PlanningModel) -> dict[str, Floats]:
    """The eight corners of the box around the surface of each segment, (8, 3) mm, before."""
    found = {}
    for segment in planning.patient.segments:
        if segment.name in planning.segments:
            vertices = segment.surface.vertices
            low, high = vertices.min(axis=0), vertices.max(axis=0)
            ends = np.array([[(n >> axis) & 1 for axis in range(3)] for n in range(8)])
            found[segment.name] = np.where(ends, high, low)
    return found


def expected_error(
    planning: PlanningModel,
    *,
    trials: int = TRIALS,
    shift: float = 5.0,
    turn: float = 5.0,
    seed: int = 0,
    progress: ProgressOrBar = None,
) -> ExpectedError:
    """The deviation of the product from exact solutions at plans around the reference.

    Every segment that the reference moves (all, if it moves none) is shifted by up to `shift` along
    each axis and turned by up to `turn` about a random axis through the middle of its surface, each
    segment independently; every second plan by half of that. A product that is exact is
    checked at one plan.

    Parameters
    ----------
    planning : PlanningModel
    trials : int
        Plans that are solved exactly.
    shift : float, mm
    turn : float, degrees
    seed : int
    progress : callable or bool, optional
        Called with the name of each stage as it begins; True shows a bar (tqdm).

    Raises
    ------
    CaseError
        (also `ValueError`) Fewer than one trial; a range that is not above 0.

    Examples
    --------
    >>> import cmfsim
    >>> found = cmfsim.expected_error(planning)  # doctest: +SKIP
    >>> found.at(3.0), found.usual(3.0)  # doctest: +SKIP
    ((0.012, 0.39), 0.11)
    """
    shift, turn = as_positive("shift", shift), as_positive("turn", turn)
    as_whole("trials", trials, 1)
    rng = np.random.default_rng(seed)
    plans = plans_near(planning, rng, 1 if planning.is_exact else trials, (shift, turn))
    found = []
    with shown_progress(progress, {TRYING: PLANNING[TRYING]}) as shown:
        shown(f"{TRYING} (1 of {len(plans)})")
        for number, solved in enumerate(solved_plans(planning, plans)):
            shown(f"{TRYING} ({min(number + 2, len(plans))} of {len(plans)})")
            found.append(_trial(planning, plans[number], solved))
    correction = planning.correction
    left_out = np.zeros((0, 3))
    if correction is not None:
        left_out = np.stack(
            [correction.distances, correction.left_out_mean, correction.left_out], axis=1
        )
    return ExpectedError(tuple(found), shift, turn, planning.is_exact, left_out)


def moving_segments(planning: PlanningModel) -> tuple[str, ...]:
    """The segments that the reference moves; all of them, if it moves none."""
    moving = [n for n, m in planning.reference.items() if not np.array_equal(m, np.eye(4))]
    return tuple(moving) or planning.segments


def plans_near(
    planning: PlanningModel, rng: np.random.Generator, count: int, reach: tuple[float, float]
) -> list[dict[str, Floats]]:
    """Random plans around the reference: up to `reach` mm along each axis and degrees."""
    boxes, plans = segment_boxes(planning), []
    for number in range(count):
        shift, turn = SHARES[number % len(SHARES)] * np.array(reach)
        plan = dict(planning.reference)
        for name in moving_segments(planning):
            centre = boxes[name].mean(axis=0)
            more = rigid_motion(
                rng.uniform(-shift, shift, 3), turn * rng.uniform(), rng.normal(size=3), centre
            )
            plan[name] = plan[name] @ more
        plans.append(plan)
    return plans


@dataclass(frozen=True, eq=False)
class SolvedPlan:
    """A plan as `predict` solves it: the skin's displacements (k, 3), mm, or why it `failed`."""

    shift: Floats | None
    failed: str
    seconds: float


def solved_plans(planning: PlanningModel, plans: Sequence[Motions]) -> Iterator[SolvedPlan]:
    """The solution of each plan, in order.

    Several at once: what is serial in a solution leaves the other processors idle.
    """

    def solved(plan: Motions) -> SolvedPlan:
        begun = time.perf_counter()
        try:
            shift, converged = planning.solve_skin(plan)
        except (ContactError, SolverError) as error:
            return SolvedPlan(None, str(error), time.perf_counter() - begun)
        seconds = time.perf_counter() - begun
        if converged:
            return SolvedPlan(shift, "", seconds)
        # What stopped above its tolerance is no answer to measure by, or to interpolate.
        return SolvedPlan(None, "contact stopped above its tolerance", seconds)

    pool = ThreadPoolExecutor(min(MOST_AT_ONCE, os.cpu_count() or 1))
    try:
        yield from pool.map(solved, plans)
    finally:
        # After Ctrl-C nothing more is begun.
        pool.shutdown(cancel_futures=True)


def _trial(planning: PlanningModel, plan: dict[str, Floats], solved: SolvedPlan) -> PlanTrial:
    distance = plan_distance(planning, plan)
    figures: tuple[float | None, float | None, float | None] = (None, None, None)
    if solved.shift is not None:
        away = np.linalg.norm(planning.displacements(plan) - solved.shift, axis=1)
        figures = (float(away.mean()), float(np.percentile(away, 95)), float(away.max()))
    return PlanTrial(plan, distance, *figures, solved.failed, solved.seconds)
