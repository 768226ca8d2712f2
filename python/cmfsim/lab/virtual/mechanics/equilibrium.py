"""Equilibrium of the true tissue as bones move: Newton's method in steps of the motion."""

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from itertools import pairwise
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError, SolverError, third_party
from cmfsim.lab.virtual.mechanics.body import HyperelasticBody
from cmfsim.values.checks import Floats, as_whole

_log = logging.getLogger(__name__)

# Forces below this share of shear modulus times the body's size squared are rounding errors.
LEAST_FORCE = 1e-9
# Newton iterations in a step at most.
MOST_ROUNDS = 60
# Number of times that a step is halved before the search fails.
HALVINGS = 12
# Share of the decrease predicted by the slope that a step must achieve (Armijo 1966).
ARMIJO = 1e-4
# Decreases of energy below this share of shear modulus times volume are lost in rounding: the full
# step is then taken.
ROUNDING = 1e-13
# Number of steps with a convex stiffness after the true one was indefinite or its step too long.
CONVEX_ROUNDS = 4
# Largest relative residual of a linear solve; it decreases with Newton's residual, down to the
# second value.
LOOSEST_SOLVE, TIGHTEST_SOLVE = 0.01, 1e-5
MOST_ITERATIONS = 400
# Nodes of the coarsest level, with six unknowns each, which is solved by a dense pseudo-inverse.
MOST_COARSE = 60


class Contact(Protocol):
    """Contact forces on the tissue after a fraction of the motion of the bones."""

    def energy(self, displacements: Floats, part: float) -> float:
        """N·mm."""

    def forces(self, displacements: Floats, part: float) -> tuple[Floats, Floats]:
        """The gradient of the energy, (n, 3) N, and the stiffness of each node, (n, 3, 3) N/mm."""

    def coupling(self, displacements: Floats, part: float) -> Any:
        """Further stiffness, between nodes: (3n, 3n) scipy BSR, N/mm, or None."""


def penalty(depth: Floats, onset: float) -> tuple[Floats, Floats, Floats]:
    """Energy, pressure and stiffness of contact at a depth, mm, for a final stiffness of 1.

    The pressure is d² / 2δ to the depth δ of its onset, from there d − δ/2.
    """
    d, is_shallow = depth, depth < onset
    energy = np.where(
        is_shallow, d**3 / (6.0 * onset), 0.5 * (d - 0.5 * onset) ** 2 + onset**2 / 24.0
    )
    pressure = np.where(is_shallow, 0.5 * d**2 / onset, d - 0.5 * onset)
    return energy, pressure, np.minimum(d / onset, 1.0)


@dataclass(frozen=True)
class EquilibriumOptions:
    """Options of the search for equilibrium, in so many steps of the motion.

    tolerance: Largest residual at the end: the norm of the forces on free nodes, relative to the
        largest norm of the forces on held nodes so far; `loose` is that of all other steps.
    """

    steps: int = 2
    tolerance: float = 5e-4
    loose: float = 0.03

    def __post_init__(self) -> None:
        as_whole("steps", self.steps, 1)
        if not 0.0 < self.tolerance <= self.loose < 1.0:
            raise CaseInputError("tolerance and loose: 0 < tolerance ≤ loose < 1 is needed")


@dataclass(frozen=True, eq=False)
class Equilibrium:
    """The tissue in equilibrium with the bones moved: displacements (n, 3) mm.

    residual: As defined for `EquilibriumOptions.tolerance`.
    energy: N·mm. Elastic energy plus that of contact.
    history: Fraction of the motion and residual, for each Newton iteration.
    last_step: (n, 3), mm. Change of the displacements in the last Newton iteration.
    """

    displacements: Floats
    residual: float
    energy: float
    history: tuple[tuple[float, float], ...]
    last_step: Floats
    linear_iterations: int = 0
    seconds: float = field(default=0.0, compare=False)


def find_equilibrium(
    body: HyperelasticBody,
    held: NDArray[Any],
    path: Callable[[float], Floats],
    contacts: Sequence[Contact] = (),
    options: EquilibriumOptions | None = None,
) -> Equilibrium:
    """The equilibrium of a body whose held nodes (k,) have moved along a path.

    path: Their displacements (k, 3) mm after a fraction of the motion, 0 to 1; zero at 0.
    Raises `SolverError`: Newton's method does not converge, or a tet is inverted at the end.
    """
    return _Search(body, held, path, contacts, options or EquilibriumOptions()).run()


class _Search:
    """The state of one search along the motion."""

    def __init__(
        self,
        body: HyperelasticBody,
        held: NDArray[Any],
        path: Callable[[float], Floats],
        contacts: Sequence[Contact],
        options: EquilibriumOptions,
    ) -> None:
        self.body, self.path, self.contacts, self.options = body, path, contacts, options
        self.held = held.astype(np.int64)
        self.free = np.setdiff1d(np.arange(len(body.nodes)), self.held)
        self.linear = _LinearSolver(body.nodes[self.free])
        self.u: Floats = np.zeros_like(body.nodes)
        self.last_step: Floats = np.zeros_like(body.nodes)
        self.history: list[tuple[float, float]] = []
        size = float(np.ptp(body.nodes, axis=0).max())
        self.least_fall = ROUNDING * float(body.tissue.mu @ body.volumes)
        self.largest_hold = LEAST_FORCE * float(body.tissue.mu.max()) * size**2

    def run(self) -> Equilibrium:
        begun = time.perf_counter()
        residual = 0.0
        parts = np.linspace(0.0, 1.0, self.options.steps + 1)
        for before, part in pairwise(parts.tolist()):
            self._advance(before, part)
            last = part >= 1.0
            residual = self._converge(part, self.options.tolerance if last else self.options.loose)
            _log.info("truth: %3.0f %% of the motion, residual %.1e", 100.0 * part, residual)
        self._check()
        return Equilibrium(
            self.u,
            residual,
            self._energy(self.u, 1.0),
            tuple(self.history),
            self.last_step,
            self.linear.total,
            time.perf_counter() - begun,
        )

    def _energy(self, u: Floats, part: float) -> float:
        return self.body.energy(u) + sum(contact.energy(u, part) for contact in self.contacts)

    def _forces(self, u: Floats, part: float) -> tuple[Floats, Floats]:
        force, stiffness = np.zeros_like(u), np.zeros((*u.shape, 3))
        for contact in self.contacts:
            pushing, stiffening = contact.forces(u, part)
            force, stiffness = force + pushing, stiffness + stiffening
        return self.body.forces(u) + force, stiffness

    def _stiffness(self, added: Floats, part: float, *, convex: bool) -> Any:
        """Stiffness of tissue and contact; `added` is the second result of `_forces`."""
        matrix = self.body.stiffness(self.u, added, convex=convex)
        found = (contact.coupling(self.u, part) for contact in self.contacts)
        return sum((coupling for coupling in found if coupling is not None), start=matrix)

    def _advance(self, part: float, target: float) -> None:
        """Predicts the state at the target along the tangent."""
        forces, added = self._forces(self.u, part)
        matrix = self._stiffness(added, part, convex=True)
        step = np.zeros_like(self.u)
        step[self.held] = self.path(target) - self.path(part)
        pull = (matrix @ step.ravel()).reshape(-1, 3)
        self.linear.take(_free_blocks(matrix, self.free))
        step[self.free], _ = self.linear.solve(-(forces + pull)[self.free], LOOSEST_SOLVE)
        self.u = self.u + step
        self.u[self.held] = self.path(target)

    def _check(self) -> None:
        """Raises an error if a tet is inverted."""
        ratio = self.body.volume_ratios(self.u)
        worst = int(np.argmin(ratio))
        if ratio[worst] <= 0.0:
            x, y, z = self.body.nodes[self.body.tets[worst]].mean(axis=0)
            raise SolverError(
                f"tet {worst} at ({x:.0f}, {y:.0f}, {z:.0f}) mm is inverted after the motion: "
                "bones squeeze the tissue there; plan a smaller motion, or use a finer mesh"
            )

    def _converge(self, part: float, tolerance: float) -> float:
        """The residual that Newton's method with a line search reaches."""
        energy = self._energy(self.u, part)
        convex = 0
        for _ in range(MOST_ROUNDS):
            forces, added = self._forces(self.u, part)
            right = -forces[self.free]
            hold = float(np.linalg.norm(forces[self.held]))
            self.largest_hold = max(self.largest_hold, hold)
            residual = float(np.linalg.norm(right)) / self.largest_hold
            self.history.append((part, residual))
            if residual <= tolerance:
                return residual
            precision = min(LOOSEST_SOLVE, max(residual, TIGHTEST_SOLVE))
            step, true = self._step(right, added, part, precision, convex=convex > 0)
            slope = -float((step[self.free] * right).sum())
            share = 1.0
            for _ in range(HALVINGS):
                there = self._energy(self.u + share * step, part)
                if there <= energy + ARMIJO * share * slope or (
                    share == 1.0 and -slope < self.least_fall and there <= energy + self.least_fall
                ):
                    break
                share *= 0.5
            else:
                raise SolverError(
                    f"Newton's method stalled at {part:.0%} of the motion with a residual of "
                    f"{residual:.1e} ({tolerance:.0e} is needed)"
                )
            convex = max(convex - 1, 0) if convex or (true and share == 1.0) else CONVEX_ROUNDS
            self.last_step = share * step
            self.u = self.u + self.last_step
            energy = there
            _log.debug(
                "truth: %.3f of the motion, residual %.2e, step of %.3g Newton's%s: %.2e mm",
                part,
                residual,
                share,
                "" if true else ", convex",
                float(np.linalg.norm(self.last_step, axis=1).max()),
            )
        raise SolverError(
            f"after {MOST_ROUNDS} Newton iterations at {part:.0%} of the motion the "
            f"residual is {residual:.1e} ({tolerance:.0e} is needed)"
        )

    def _step(
        self, right: Floats, added: Floats, part: float, precision: float, *, convex: bool
    ) -> tuple[Floats, bool]:
        """Newton's step, (n, 3) mm, and whether it was computed with the true stiffness."""
        step = np.zeros_like(self.u)
        for cut in (True,) if convex else (False, True):
            matrix = self._stiffness(added, part, convex=cut)
            self.linear.take(_free_blocks(matrix, self.free))
            step[self.free], upright = self.linear.solve(right, precision)
            if upright:
                break
        return step, not cut


def _free_blocks(matrix: Any, free: NDArray[np.int64]) -> Any:
    """The rows and columns of free nodes of a matrix in 3 × 3 blocks."""
    n = matrix.shape[0] // 3
    number = np.full(n, -1)
    number[free] = np.arange(len(free))
    rows = np.repeat(np.arange(n), np.diff(matrix.indptr))
    kept = (number[rows] >= 0) & (number[matrix.indices] >= 0)
    starts = np.concatenate([[0], np.cumsum(np.bincount(number[rows[kept]], minlength=len(free)))])
    sparse = import_module("scipy.sparse")
    size = 3 * len(free)
    return sparse.bsr_array(
        (matrix.data[kept], number[matrix.indices[kept]], starts), shape=(size, size)
    )


class _LinearSolver:
    """Conjugate gradients with smoothed aggregation (PyAMG; Vaněk, Mandel & Brezina 1996)."""

    def __init__(self, nodes: Floats) -> None:
        self.total = 0
        self._modes = _rigid_modes(nodes)
        self._matrix: Any = None
        self._cycle: Any = None

    def take(self, matrix: Any) -> None:
        """Stores a matrix and computes its preconditioner.

        The preconditioner of the previous matrix would take several times the iterations, since
        tets that are squeezed near bone stiffen by orders of magnitude.
        """
        pyamg = third_party("pyamg", "virtual patients are solved", "study")
        self._matrix = matrix
        # PyAMG draws the start of its power iterations from numpy's global generator.
        state = np.random.get_state()  # noqa: NPY002
        np.random.seed(0)  # noqa: NPY002
        try:
            hierarchy = pyamg.smoothed_aggregation_solver(
                import_module("scipy.sparse").bsr_matrix(matrix),
                B=self._modes,
                symmetry="symmetric",
                strength=("symmetric", {"theta": 0.0}),
                smooth=("jacobi", {"omega": 1.0, "weighting": "local"}),
                improve_candidates=None,
                presmoother=("block_gauss_seidel", {"sweep": "forward"}),
                postsmoother=("block_gauss_seidel", {"sweep": "backward"}),
                max_coarse=MOST_COARSE,
            )
        finally:
            np.random.set_state(state)  # noqa: NPY002
        self._cycle = hierarchy.aspreconditioner(cycle="V")

    def solve(self, right: Floats, precision: float) -> tuple[Floats, bool]:
        """A step (k, 3) that decreases the energy, and whether it is the solution.

        If the matrix has negative curvature, the step is the iterate found before that.
        """
        r = right.ravel().copy()
        x = np.zeros_like(r)
        z = self._cycle @ r
        p = z.copy()
        rz = float(r @ z)
        goal = precision * float(np.linalg.norm(r))
        for count in range(1, MOST_ITERATIONS + 1):
            q = self._matrix @ p
            curvature = float(p @ q)
            if not curvature > 0.0:
                _log.debug("truth: negative curvature after %d iterations", count)
                return (x if count > 1 else p).reshape(-1, 3), False
            length = rz / curvature
            x += length * p
            r -= length * q
            self.total += 1
            if float(np.linalg.norm(r)) <= goal:
                break
            z = self._cycle @ r
            rz, before = float(r @ z), rz
            p = z + (rz / before) * p
        return x.reshape(-1, 3), True


def _rigid_modes(nodes: Floats) -> Floats:
    """The six rigid motions, (3n, 6)."""
    x, y, z = ((nodes - nodes.mean(axis=0)) / np.abs(nodes).max()).T
    modes = np.zeros((len(nodes), 3, 6))
    modes[:, [0, 1, 2], [0, 1, 2]] = 1.0
    modes[:, 1, 3], modes[:, 2, 3] = -z, y
    modes[:, 2, 4], modes[:, 0, 4] = -x, z
    modes[:, 0, 5], modes[:, 1, 5] = -y, x
    return modes.reshape(-1, 6)
