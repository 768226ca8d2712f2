"""Elements in linear kinematics: the same mesh in scikit-fem or numpy, and how far they bend.

The error is from the displacements that an independent stiffness of the same element gives
(`independent.py`), factored by scipy. The deflection is that of the tip over scikit-fem's quadratic
tets on a mesh twice as fine: it measures the element, not the solver.
"""

from __future__ import annotations

import functools
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

import cmfsim
from benches.scenes import independent
from benches.scenes.extended import condition_number, isotropic
from benches.scenes.panels import BEAM, COOK, far_side_loads, panel
from benches.stability.extreme import bodies
from benches.stability.extreme.problem import FAT, Problem, one, where
from benches.stability.extreme.rows import (
    CONDITION_FACTOR,
    EPS,
    ERROR_LIMIT,
    PATIENCE,
    WORTHLESS,
    Case,
    Row,
    patience,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

COLUMNS = ("κ", "residual", "error", "deflection")
METHODS = ("p1 cholesky", "anp cholesky", "anp pcg", "p2 cholesky", "p2 pcg")
DIRECT = ("p1 cholesky", "anp cholesky", "p2 cholesky")
# Deflection over that of the same element at ν = 0.3 below which it is said to lock, as `anp` and
# `p2` must not. (A coarse mesh of linear tets is too stiff at any ν.)
LOCKED = 0.5
COMPRESSIBLE = 0.3
# Share of the largest row sum of |K| |u| that the residual of a direct solve may have, over ε.
RESIDUAL_FACTOR = 100.0
# Refinements of the independent solution with its own factor.
REFINEMENTS = 3
TIP_LOAD = 1e-4
# Deflections of fine meshes by shape, cells and ν: dear, and asked for again and again.
_FINE: dict[tuple[bytes, tuple[int, int, int], float], float] = {}


@dataclass(frozen=True, eq=False)
class Panel:
    """A clamped panel and the traction on its far side.

    Attributes
    ----------
    corners : (4, 2) float64, mm
    cells : (3,) int
        Boxes along, across and through.
    poisson : float
    """

    corners: Floats
    cells: tuple[int, int, int]
    poisson: float

    def problem(self, halvings: int = 0) -> Problem:
        """Its mesh with boxes cut in two `halvings` times, clamped at x = 0."""
        cells = tuple(n * 2**halvings for n in self.cells)
        nodes, tets = panel((cells[0], cells[1], cells[2]), self.corners, 8.0)
        material = (isotropic(FAT, self.poisson),)
        return Problem(nodes, tets, material, one(tets), fixed=where(nodes[:, 0] < 1e-9))


def cases(*, quick: bool = False) -> list[Case]:
    """All cases, or with `quick` the ones that the tests run."""
    return [c for c in _cases() if c.quick or not quick]


def _itself(panel: Panel) -> Panel:
    return panel


def _cases() -> Iterator[Case]:
    bind = functools.partial
    for nu in (0.3, 0.45, 0.49, 0.499, 0.4999):
        text = f"ν = {nu:g}"
        beam, cook = Panel(BEAM, (6, 2, 2), nu), Panel(COOK, (4, 4, 1), nu)
        yield Case("bending", "cantilever", text, bind(_itself, beam), METHODS, quick=False)
        yield Case(
            "bending", "Cook's membrane", text, bind(_itself, cook), METHODS, quick=nu == 0.499
        )
    for power in (0, 4, 8):
        build = bind(bodies.checkerboard, 10.0**power, (4, 3, 3))
        text = f"contrast 1e{power}"
        yield Case("elements", "random inclusions", text, build, METHODS, quick=power == 4)
    for degrees in (10.0, 1.0, 0.1):
        build = bind(bodies.squashed, degrees, 0.49)
        text = f"dihedral {degrees:g}°"
        yield Case("elements", "slivers, ν = 0.49", text, build, DIRECT, quick=False)


@functools.cache
def built(case: Case) -> tuple[Problem, Panel | None]:
    """The problem of a case, and the panel that it is of, if any."""
    made = case.build()
    return (made.problem(), made) if isinstance(made, Panel) else (made, None)


def _fields(p: Problem) -> tuple[Floats, Floats]:
    young = np.array([m.along for m in p.materials])[p.material_of]
    return young, np.array([m.poisson for m in p.materials])[p.material_of]


def _tensors(p: Problem, element: str) -> cmfsim.MassTensors:
    tissue = cmfsim.Tissue.isotropic(*_fields(p))
    return cmfsim.MassTensors(cmfsim.TetMesh(p.nodes, p.tets), tissue, element=element)


@dataclass(frozen=True, eq=False)
class Solved:
    """The independent solution: its stiffness, and which unknowns are free."""

    matrix: sp.csr_matrix
    free: NDArray[np.intp]
    displacements: Floats
    scaled: sp.csc_matrix
    factor: spla.SuperLU

    @functools.cached_property
    def condition(self) -> float:
        """κ of the equilibrated matrix of the free unknowns."""
        return condition_number(self.scaled, self.factor)


@functools.cache
def reference(case: Case, element: str) -> Solved:
    """What an independent stiffness of the same element and mesh gives."""
    p, panel_of = built(case)
    return _solve(p, panel_of, element)


def _solve(p: Problem, panel_of: Panel | None, element: str) -> Solved:
    tensors = _tensors(p, element)
    matrix = independent.stiffness(tensors.mesh, tensors, *_fields(p))
    mask, motion = p.prescribed()
    ends = np.asarray(tensors.mid_edges).astype(np.int64).reshape(-1, 2)
    # An edge moves with its ends where both are prescribed; none joins two segments here.
    x, corners = np.asarray(tensors.nodes), len(p.nodes)
    held = np.concatenate([mask, mask[ends].all(axis=1)])
    u = np.zeros_like(x)
    u[:corners] = motion.hi
    u[corners:] = 0.5 * motion.hi[ends].sum(axis=1) * held[corners:, None]
    loads = np.zeros_like(x)
    if panel_of is not None:
        loads = far_side_loads(tensors.mesh, tensors, panel_of.corners, TIP_LOAD)
    free = np.flatnonzero(np.repeat(~held, 3))
    scale = 1.0 / np.sqrt(matrix.diagonal()[free])
    inner = sp.csc_matrix(sp.diags(scale) @ matrix[free][:, free] @ sp.diags(scale))
    factor = spla.splu(inner, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
    for _ in range(1 + REFINEMENTS):
        rest = (loads.ravel() - matrix @ u.ravel())[free]
        flat = u.ravel()
        flat[free] += scale * factor.solve(scale * rest)
        u = flat.reshape(-1, 3)
    return Solved(matrix, free, u, inner, factor)


def fine_deflection(panel_of: Panel) -> float:
    """Of the tip of a panel, by scikit-fem's quadratic tets of half the edge."""
    key = (panel_of.corners.tobytes(), panel_of.cells, panel_of.poisson)
    if key not in _FINE:
        p = panel_of.problem(halvings=1)
        _FINE[key] = _tip(p, panel_of, _solve(p, panel_of, "p2").displacements)
    return _FINE[key]


def _share(panel_of: Panel, element: str) -> float:
    """Deflection by the independent stiffness of an element over that of the finer mesh."""
    p = panel_of.problem()
    return _tip(p, panel_of, _solve(p, panel_of, element).displacements) / fine_deflection(panel_of)


def _tip(p: Problem, panel_of: Panel, u: Floats) -> float:
    far = np.linalg.norm(p.nodes[:, :2] - panel_of.corners[2], axis=1) < 1e-9
    return float(u[: len(p.nodes)][far, 1].mean())


def forget() -> None:
    """Drops what is kept of the cases."""
    for cached in (built, reference):
        cached.cache_clear()


def judge(case: Case, method: str) -> Row:
    """Solves a case with an element and a solver and compares."""
    element, solver_name = method.split()
    row = Row(case.group, case.name, case.parameter, method, reference="same element")
    p, panel_of = built(case)
    tensors = _tensors(p, element)
    loads = None
    if panel_of is not None:
        loads = far_side_loads(tensors.mesh, tensors, panel_of.corners, TIP_LOAD)
    known = reference(case, element)
    round_off = CONDITION_FACTOR * EPS * known.condition
    begin = time.perf_counter()
    try:
        with patience(PATIENCE):
            boundary = cmfsim.Boundary(fixed=p.fixed, joined=p.joined)
            solver = cmfsim.StaticSolver(tensors, boundary, solver_name, tolerance=case.tolerance)
            result = solver.solve(p.plan, loads=loads)
    except cmfsim.SolverError as refusal:
        # As for linear tets: conjugate gradients may give up where rounding keeps them away.
        limit = WORTHLESS if solver_name == "cholesky" else case.tolerance
        passed = round_off > limit
        verdict = f"{'' if passed else 'WRONG: '}refused: SolverError: {refusal}"
        return replace(row, condition=known.condition, verdict=verdict, passed=passed)
    except TimeoutError:
        return replace(row, verdict=f"WRONG: no answer in {PATIENCE} s")
    u = result.all_displacements
    size = float(np.linalg.norm(known.displacements, axis=1).max())
    error = float(np.linalg.norm(u - known.displacements, axis=1).max()) / size
    bound = 0.0 if solver_name == "cholesky" else result.error_estimate / size
    allowed = max(ERROR_LIMIT, min(round_off, WORTHLESS)) + bound
    outside = np.zeros(u.size) if loads is None else loads.ravel()
    rest = (known.matrix @ u.ravel() - outside)[known.free]
    size_of = (abs(known.matrix) @ np.abs(u).ravel())[known.free]
    residual = float(np.linalg.norm(rest) / np.linalg.norm(size_of))
    faults = []
    if not error <= allowed:
        faults.append(f"error {error:.1e} where {allowed:.1e} is allowed")
    if solver_name == "cholesky" and residual > RESIDUAL_FACTOR * EPS:
        faults.append(f"residual {residual:.1e} above round-off")
    deflection, said = None, "ok"
    if panel_of is not None:
        deflection = _tip(p, panel_of, u) / fine_deflection(panel_of)
        least = LOCKED * _share(replace(panel_of, poisson=COMPRESSIBLE), element)
        if deflection < least:
            said = "locks: do not use"
            if element != "p1":
                faults.append(f"locks: bends {deflection:.2f} where {least:.2f} is allowed")
    return replace(
        row,
        condition=known.condition,
        residual=residual,
        error=error,
        error_estimate=bound,
        allowed=allowed,
        deflection=deflection,
        iterations=result.iterations,
        seconds=time.perf_counter() - begin,
        verdict=said if not faults else "WRONG: " + "; ".join(faults),
        passed=not faults,
    )
