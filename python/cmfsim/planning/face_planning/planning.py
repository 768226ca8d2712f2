"""The plan whose face is closest to a target: Gauss-Newton steps with the plan operator.

The unknowns are six numbers for each segment, as surgeons state them: forwards, up and left at its
reference point, pitch, yaw and roll. Targets, and a prior that favours small movements, contribute
residuals in standard deviations; the inverse of their normal matrix is the covariance of the
numbers. The plan that is found is solved exactly, once.

Steps are Levenberg-Marquardt in the numbers that are not at a bound: (JᵀJ + μ D) δ = −Jᵀr, where D
is the diagonal of JᵀJ (Marquardt 1963). A number at a bound is released when the gradient points
inside.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError
from cmfsim.planning.face_planning.targets import CarriedPoints, Target, Wish, wish_of
from cmfsim.planning.replanning.expected_error import moving_segments
from cmfsim.planning.replanning.model import PlanningModel
from cmfsim.values.checks import Floats, as_positive
from cmfsim.values.clinical_motion import ClinicalMotion, clinical_motion, planned_motion
from cmfsim.values.prediction import Prediction

# Forward differences, mm and degrees: residuals are smooth on this scale, and central differences
# would cost twice as much.
STEP = 1e-4
# Initial μ, and its factors after a step that failed and after one that succeeded.
FIRST_DAMPING, HARDER, SOFTER = 1e-3, 10.0, 0.1
MOST_DAMPING = 1e12
# A step below this, mm or degrees, ends the search.
STILL = 1e-7
# So does one that would lower the sum of squares by less than this share, along a valley that
# residuals do not determine.
FLAT = 1e-10

# Names of the numbers of a segment, in order: mm and degrees.
NUMBERS = ("forwards", "up", "left", "pitch", "yaw", "roll")
# A number this close to a bound is at the bound, mm or degrees.
AT_BOUND = 1e-6
# Standard deviation of an undetermined number, mm or degrees; and the share of the prior's standard
# deviation above which a number counts as open.
OPEN, OPEN_SHARE = 1e3, 0.25


@dataclass(frozen=True, eq=False)
class Minimum:
    """The result of a search: x (n,), residuals (m,), their derivatives (m, n).

    converged: Whether the next step is too small to matter, before the steps ran out.
    """

    x: Floats
    residuals: Floats
    jacobian: Floats
    steps: int
    converged: bool


def bounded_least_squares(
    residuals: Callable[[Floats], Floats], start: Floats, low: Floats, high: Floats, *, steps: int
) -> Minimum:
    """The least sum of squares of residuals of n numbers within bounds, in `steps` at most."""
    x = np.clip(start, low, high)
    r = residuals(x)
    jacobian = _jacobian(residuals, x, r)
    damping, taken = FIRST_DAMPING, 0
    for taken in range(1, steps + 1):
        gradient = jacobian.T @ r
        free = ~(((x <= low) & (gradient > 0.0)) | ((x >= high) & (gradient < 0.0)))
        if not free.any():
            return Minimum(x, r, jacobian, taken, converged=True)
        normal = (jacobian.T @ jacobian)[np.ix_(free, free)]
        scale = np.maximum(np.diagonal(normal), 1e-12 * max(float(normal.max()), 1e-30))
        while True:
            step = np.zeros_like(x)
            step[free] = -np.linalg.solve(normal + damping * np.diag(scale), gradient[free])
            there = np.clip(x + step, low, high)
            change = jacobian @ step
            still = float(np.abs(there - x).max()) <= STILL
            still |= float(-2.0 * (r @ change) - change @ change) <= FLAT * float(r @ r)
            if still or damping > MOST_DAMPING:
                return Minimum(x, r, jacobian, taken, converged=still)
            found = residuals(there)
            if found @ found < r @ r:
                break
            damping *= HARDER
        x, r = there, found
        damping *= SOFTER
        jacobian = _jacobian(residuals, x, r)
    return Minimum(x, r, jacobian, taken, converged=False)


def _jacobian(residuals: Callable[[Floats], Floats], x: Floats, here: Floats) -> Floats:
    columns = []
    for index in range(len(x)):
        step = np.zeros_like(x)
        step[index] = STEP
        columns.append((residuals(x + step) - here) / STEP)
    return np.stack(columns, axis=1)


@dataclass(frozen=True, eq=False)
class FaceSearch:
    """Options of the search for a plan.

    Attributes
    ----------
    segments : sequence of str or None
        Those that may move; by default, those that the reference moves.
    follows : mapping of str to str
        Segments that stay in place relative to another one: {"mandible_body": "maxilla"} keeps
        the final bite of the reference plan.
    shift, turn : float, mm and degrees
        Bounds of every number, in both directions.
    prior_shift, prior_turn : float or None, mm and degrees
        Standard deviations of a prior that favours no movement; None for no prior.
    steps : int
        Maximum number of steps.

    Raises
    ------
    CaseError
        (also `ValueError`) A bound, deviation or count that is not above 0.

    Examples
    --------
    >>> import cmfsim
    >>> search = cmfsim.FaceSearch(follows={"mandible_body": "maxilla"}, shift=10.0)
    >>> search.prior_turn
    40.0
    """

    segments: Sequence[str] | None = None
    follows: Mapping[str, str] = field(default_factory=dict)
    shift: float = 15.0
    turn: float = 15.0
    prior_shift: float | None = 40.0
    prior_turn: float | None = 40.0
    steps: int = 50

    def __post_init__(self) -> None:
        for name in ("shift", "turn", "steps"):
            as_positive(name, getattr(self, name))
        for name in ("prior_shift", "prior_turn"):
            if getattr(self, name) is not None:
                as_positive(name, getattr(self, name))


@dataclass(frozen=True, eq=False)
class FacePlan:
    """A plan found for a desired face.

    Attributes
    ----------
    plan : mapping of str to (4, 4) float64, mm
        Of every segment.
    motions : mapping of str to ClinicalMotion
        Of the free segments, in words and numbers.
    std : mapping of str to (6,) float64
        Standard deviation of each number of `NUMBERS`, given targets and prior, mm and degrees; 0
        where the number is at a bound.
    covariance : (6 s, 6 s) float64
        Of the numbers of the free segments, one after the other; 0 where a number is at a bound.
    undetermined : tuple of str
        Numbers that the targets leave open: their standard deviation is more than a quarter of
        that of the prior, or there is no prior and nothing else determines the number.
    at_bounds : tuple of str
        Numbers that are at a bound.
    residuals : tuple of (m,) float64
        Of each target, in its standard deviations, by the plan operator.
    exact : Prediction or None
        The exact solution of the plan.
    exact_residuals : tuple of (m,) float64
        As `residuals`, of the exact solution; empty if it was not requested.
    steps : int
    converged : bool
    """

    plan: Mapping[str, Floats]
    motions: Mapping[str, ClinicalMotion]
    std: Mapping[str, Floats]
    covariance: Floats
    undetermined: tuple[str, ...]
    at_bounds: tuple[str, ...]
    residuals: tuple[Floats, ...]
    exact: Prediction | None
    exact_residuals: tuple[Floats, ...]
    steps: int
    converged: bool

    @property
    def exact_rms(self) -> list[float]:
        """Root mean square of the exact residuals of each target."""
        return [float(np.sqrt((row**2).mean())) for row in self.exact_residuals]

    def as_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return {
            "plan": {name: motion.as_dict() for name, motion in self.motions.items()},
            "std": {name: row.tolist() for name, row in self.std.items()},
            "undetermined": list(self.undetermined),
            "at_bounds": list(self.at_bounds),
            "rms": self.exact_rms,
            "converged": self.converged,
        }


def plan_for_face(
    planning: PlanningModel,
    targets: Sequence[Target],
    search: FaceSearch | None = None,
    *,
    exact: bool = True,
) -> FacePlan:
    """The plan whose predicted face is closest to the targets.

    Parameters
    ----------
    planning : PlanningModel
    targets : sequence of PointTarget, MeasureTarget and SurfaceTarget
    search : FaceSearch, optional
    exact : bool
        Whether to solve the plan that was found exactly, with contact.

    Raises
    ------
    CaseError
        (also `ValueError`) No target; a segment that the patient does not have, or that follows a
        follower; a target that no plan moves.
    ContactError, SolverError
        The plan that was found cannot be solved.

    Notes
    -----
    The search uses the plan operator: where tissue slides, its error away from the reference
    (`expected_error`) is an error of the plan as well; `exact_residuals` shows it.

    Examples
    --------
    >>> import cmfsim
    >>> wish = [cmfsim.MeasureTarget("nasolabial_angle", 105.0)]
    >>> found = cmfsim.plan_for_face(planning, wish)  # doctest: +SKIP
    >>> found.motions["maxilla"].text  # doctest: +SKIP
    '3.1 mm forwards, 0.4 mm down at the upper incisors (supradentale)'
    """
    search = search or FaceSearch()
    if not targets:
        raise CaseInputError("there is no target: give points, measures or a surface")
    space = _Space(planning, search)
    wishes = [wish_of(planning, target) for target in targets]
    points = np.concatenate([wish.points for wish in wishes])
    carried = CarriedPoints(planning, points) if len(points) else None
    prior = _prior(search, len(space.free))

    def residuals(numbers: Floats) -> Floats:
        plan = space.plan(numbers)
        places = points + carried.displacements(plan) if carried else points
        return np.concatenate([*_rows(wishes, places, plan), numbers * prior])

    bound = np.tile([search.shift] * 3 + [search.turn] * 3, len(space.free)).astype(np.float64)
    found = bounded_least_squares(
        residuals, space.numbers_of_reference(), -bound, bound, steps=search.steps
    )
    plan = space.plan(found.x)
    solved, exact_rows = None, tuple[Floats, ...]()
    if exact:
        solved = planning.solve(plan)
        places = points + solved.carried(points) if len(points) else points
        exact_rows = _rows(wishes, places, plan)
    held = np.abs(found.x) >= bound - AT_BOUND
    covariance, undetermined = _covariance(found.jacobian, prior, held)
    stds = np.sqrt(np.diagonal(covariance))
    sizes = np.cumsum([len(row) for row in _rows(wishes, points, plan)])
    return FacePlan(
        plan=plan,
        motions={name: space.stated(name, plan[name]) for name in space.free},
        std={name: stds[6 * i : 6 * i + 6] for i, name in enumerate(space.free)},
        covariance=covariance,
        undetermined=tuple(space.labels[i] for i in np.flatnonzero(undetermined)),
        at_bounds=tuple(space.labels[i] for i in np.flatnonzero(held)),
        residuals=tuple(np.split(found.residuals, sizes)[:-1]),
        exact=solved,
        exact_residuals=exact_rows,
        steps=found.steps,
        converged=found.converged,
    )


def _rows(wishes: Sequence[Wish], places: Floats, plan: Mapping[str, Floats]) -> tuple[Floats, ...]:
    """The residuals of each target, from the positions of all points in one array."""
    ends = np.cumsum([len(wish.points) for wish in wishes])
    parts = np.split(places, ends[:-1])
    return tuple(wish.rows(part, plan) for wish, part in zip(wishes, parts, strict=True))


def _covariance(
    jacobian: Floats, prior: Floats, held: NDArray[np.bool_]
) -> tuple[Floats, NDArray[np.bool_]]:
    """The covariance of the numbers that are not at a bound, and which of them targets leave open.

    (JᵀJ)⁻¹ with the rows of the prior in J. Directions that neither targets nor prior determine
    get the variance OPEN².
    """
    free = ~held
    normal = (jacobian.T @ jacobian)[np.ix_(free, free)]
    values, vectors = np.linalg.eigh(normal)
    variance = 1.0 / np.maximum(values, OPEN**-2)
    covariance = np.zeros((len(prior), len(prior)))
    covariance[np.ix_(free, free)] = (vectors * variance) @ vectors.T
    alone = np.where(prior > 0.0, 1.0 / np.where(prior > 0.0, prior, 1.0), OPEN)
    return covariance, free & (np.sqrt(np.diagonal(covariance)) > OPEN_SHARE * alone)


class _Space:
    """The numbers of the free segments, and the plans that they represent."""

    def __init__(self, planning: PlanningModel, search: FaceSearch) -> None:
        reference = planning.reference
        named = list(search.segments or moving_segments(planning))
        for name in (*named, *search.follows, *search.follows.values()):
            if name not in planning.segments:
                known = ", ".join(planning.segments)
                raise CaseInputError(f"there is no segment {name!r}; segments are: {known}")
        for follower, leader in search.follows.items():
            if leader in search.follows or leader == follower:
                raise CaseInputError(
                    f"{follower!r} follows {leader!r}, which does not move independently"
                )
        self.reference = reference
        self.free = [name for name in dict.fromkeys(named) if name not in search.follows]
        if not self.free:
            raise CaseInputError("every segment follows another, so nothing is free to move")
        self.patient = planning.patient
        self.points = {name: self.stated(name, np.eye(4)).point for name in self.free}
        # The motion of the follower relative to its leader: the final bite.
        self.bites = {
            follower: (leader, np.linalg.inv(reference[leader]) @ reference[follower])
            for follower, leader in search.follows.items()
        }

    def stated(self, name: str, motion: Floats) -> ClinicalMotion:
        return clinical_motion(
            name,
            motion,
            landmarks=self.patient.landmarks.get("skull"),
            vertices=self.patient.segment_vertices(name),
        )

    def numbers_of_reference(self) -> Floats:
        rows = [self.stated(name, self.reference[name]) for name in self.free]
        return np.array([getattr(row, number) for row in rows for number in NUMBERS])

    def plan(self, numbers: Floats) -> dict[str, Floats]:
        plan = dict(self.reference)
        for index, name in enumerate(self.free):
            shift, turn = numbers[6 * index : 6 * index + 3], numbers[6 * index + 3 : 6 * index + 6]
            point = self.points[name]
            place = np.zeros(3) if point is None else point
            plan[name] = planned_motion(place, shift=shift, turn=turn)
        for follower, (leader, bite) in self.bites.items():
            plan[follower] = plan[leader] @ bite
        return plan

    @property
    def labels(self) -> list[str]:
        return [f"{name}: {number}" for name in self.free for number in NUMBERS]


def _prior(search: FaceSearch, segments: int) -> Floats:
    """The weights of the numbers in the residuals of the prior; 0 for none."""
    shift = 0.0 if search.prior_shift is None else 1.0 / search.prior_shift
    turn = 0.0 if search.prior_turn is None else 1.0 / search.prior_turn
    return np.tile([shift] * 3 + [turn] * 3, segments)
