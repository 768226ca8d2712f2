"""The linear model: every method against closed forms and 32 digits."""

from __future__ import annotations

import functools
import time
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

import cmfsim
from benches.scenes.extended import ExtendedModel, Material, Reference, Twofold, isotropic, solve
from benches.stability.extreme import bodies, holding
from benches.stability.extreme.problem import FAT, MUSCLE, NU, Problem
from benches.stability.extreme.rows import (
    ALL,
    BOUND_FACTOR,
    CONDITION_FACTOR,
    EPS,
    ERROR_LIMIT,
    FAST,
    PATIENCE,
    RESIDUAL_FACTOR,
    SWEEPS,
    WORTHLESS,
    Case,
    Row,
    patience,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]


COLUMNS = ("κ", "residual", "error", "estimate")


def forget() -> None:
    """Drops what is kept of the cases."""
    for cached in (problem, model, reference):
        cached.cache_clear()


def _number(value: float) -> str:
    return f"{value:g}"


def cases(*, quick: bool = False) -> list[Case]:
    """All cases of the suite, or with `quick` those that take less than a second each."""
    every = list(_cases())
    return [c for c in every if c.quick or not quick]


def _cases() -> Iterator[Case]:
    bind = functools.partial
    ratios = (0.0, 0.3, 0.45, 0.49, 0.499, 0.4999)
    for nu in ratios:
        group, text = "Poisson ratio", f"ν = {_number(nu)}"
        methods = ALL if nu <= 0.49 else FAST
        yield Case(
            group, "affine patch", text, bind(bodies.affine_patch, isotropic(MUSCLE, nu)), methods
        )
        yield Case(group, "clamped block", text, bind(bodies.nearly_incompressible, nu), ALL)
        yield Case(
            group, "blown-up sphere", text, bind(bodies.pressed_shell, nu), FAST, quick=nu >= 0.49
        )
    for power in (0, 2, 4, 6, 8):
        contrast = 10.0**power
        text = f"contrast 1e{power}"
        yield Case("contrast", "bar in series", text, bind(bodies.series_bar, contrast), ALL)
        yield Case("contrast", "layers", text, bind(bodies.layered, contrast), ALL)
        yield Case("contrast", "random inclusions", text, bind(bodies.checkerboard, contrast), ALL)
    for power in (4, 8):
        yield Case(
            "contrast",
            "random inclusions, 10 368 tets",
            f"contrast 1e{power}",
            bind(bodies.checkerboard, 10.0**power, (12, 12, 12)),
            quick=False,
        )
    for power in (0, 4, 8):
        text = f"contrast 1e{power}"
        yield Case(
            "contrast", "stiff cube afloat", text, bind(bodies.afloat_in_soft, 10.0**power), ALL
        )
    for power in (0, 2, 4, 8):
        text = f"contrast 1e{power}"
        yield Case("contrast", "thin neck", text, bind(bodies.neck, 10.0**power), ALL)
    yield Case("contrast", "thinner neck", "contrast 1e2", bind(bodies.neck, 1e2, 5), FAST)
    yield Case("contrast", "thinner neck", "contrast 1e8", bind(bodies.neck, 1e8, 5), ALL)
    for power, tolerance in ((6, 1e-6), (4, 1e-4), (2, 1e-2)):
        yield Case(
            "contrast",
            "thin neck",
            f"contrast 1e{power}, tolerance {tolerance:.0e}",
            bind(bodies.neck, 10.0**power),
            ("pcg", "relaxation"),
            tolerance=tolerance,
        )
    diagonal = (0.5**0.5, 0.5**0.5, 0.0)
    for power in (-3, -1, 1, 3):
        ratio = 10.0**power
        text = f"E_l/E_t = 1e{power}"
        patch = Material(0.01 * ratio, 0.01, 0.43, diagonal)
        yield Case("fibres", "affine patch, 45°", text, bind(bodies.affine_patch, patch))
        yield Case("fibres", "bar along, ν = 0", text, bind(bodies.fibre_bar, ratio))
        yield Case("fibres", "block along", text, bind(bodies.fibres, ratio, (1.0, 0.0, 0.0)))
        yield Case("fibres", "block across", text, bind(bodies.fibres, ratio, (0.0, 0.0, 1.0)))
        yield Case("fibres", "block at 45°", text, bind(bodies.fibres, ratio, diagonal), ALL)
    stiff_fibre = Material(10.0, 0.01, 0.4999, diagonal)
    yield Case(
        "fibres", "affine patch, 45°", "1e3, ν = 0.4999", bind(bodies.affine_patch, stiff_fibre)
    )
    for degrees in (10.0, 1.0, 0.1):
        text = f"dihedral {_number(degrees)}°"
        yield Case("slivers", "block", text, bind(bodies.squashed, degrees), ALL)
        yield Case("slivers", "block, ν = 0.49", text, bind(bodies.squashed, degrees, 0.49))
    for length, text in ((1e3, "mm → µm (× 1e3)"), (1e-3, "mm → m (× 1e-3)"), (1e-6, "× 1e-6")):
        yield Case("units", "random inclusions", text, bind(bodies.scaled, length), ALL)
    for modulus, text in ((1e6, "MPa → Pa (× 1e6)"), (1e-9, "MPa → 1e15 Pa (× 1e-9)")):
        yield Case("units", "random inclusions", text, bind(bodies.scaled, 1.0, modulus))
    # Coordinates of more than 1e6 mm are refused.
    for distance in (1e4, 9e5):
        yield Case(
            "units", "far from the origin", f"{distance:.0e} mm", bind(bodies.far_away, distance)
        )
    for angle in (30.0, 90.0, 180.0):
        text = f"{_number(angle)}°"
        yield Case(
            "large moves",
            "rigid boundary",
            text,
            bind(bodies.rigid_patch, angle, isotropic(FAT, NU)),
            ALL,
        )
        yield Case("large moves", "one segment turned", text, bind(bodies.moved, angle, 0.0))
    yield Case(
        "large moves",
        "rigid boundary",
        "50 mm",
        bind(bodies.rigid_patch, 0.0, isotropic(FAT, NU), 50.0),
    )
    yield Case("large moves", "one segment moved", "50 mm", bind(bodies.moved, 0.0, 50.0), ALL)
    yield Case("large moves", "one segment moved", "50 mm and 90°", bind(bodies.moved, 90.0, 50.0))
    yield Case("large moves", "one segment moved", "1e-9 mm", bind(bodies.moved, 0.0, 1e-9), ALL)
    for shift in (0.0, 1e-15):
        text = f"segment moved by {_number(shift)} mm"
        yield Case("loads", "random inclusions", text, bind(bodies.loaded, shift), ALL)
    yield Case("loads", "cantilever 1:3", "1e-03 N", bind(bodies.slender, 3, 1e-3), ALL)
    yield Case("loads", "cantilever 1:3", "1e+06 N", bind(bodies.slender, 3, 1e6), ALL)
    for load in (1e-3, 1e-12):
        yield Case("loads", "cantilever 1:20", f"{load:.0e} N", bind(bodies.slender, 20, load), ALL)
    yield Case("loads", "cantilever 1:200", "1e-03 N", bind(bodies.slender, 200, 1e-3), ALL)
    yield Case("loads", "cantilever 1:1000", "1e-03 N", bind(bodies.slender, 1000, 1e-3))
    for offset in (1.0, 1e-1, 1e-2, 1e-3):
        text = f"{_number(offset)} mm off the line"
        build = bind(bodies.hung_on_three_nodes, offset)
        # From there on κ ε > 1e-4: counted as in line.
        refusal = ("rotation about x",) if offset < 1e-2 else ()
        yield Case("holding", "three nodes almost in line", text, build, FAST, refusal)
    yield Case("small", "single tet", "all joined", bind(holding.single_tet, 4), ALL)
    yield Case("small", "single tet", "3 joined, 1 free", bind(holding.single_tet, 3), ALL)
    yield Case(
        "small", "single tet", "3 joined, 1 fixed", bind(holding.single_tet, 3, fixed=1), ALL
    )
    yield Case("small", "single tet", "all fixed", bind(holding.single_tet, 0, fixed=4), ALL)
    yield Case(
        "holding",
        "single tet",
        "2 joined, 2 free",
        bind(holding.single_tet, 2),
        ALL,
        ("rotation about x",),
    )
    yield Case(
        "holding",
        "single tet",
        "1 joined, 3 free",
        bind(holding.single_tet, 1),
        ALL,
        ("rotation about",) * 3,
    )
    for count in (1, 30, 31):
        text = f"{count} apart from one another"
        yield Case("holding", "three-hinged arches", text, bind(holding.arches, count), ALL)
    yield Case("holding", "two islands", "both held", bind(holding.islands, second_held=True), ALL)
    free = "all six rigid modes are free"
    yield Case(
        "holding",
        "two islands",
        "one unheld",
        bind(holding.islands, second_held=False),
        ALL,
        (free, "part"),
    )
    yield Case(
        "holding",
        "block afloat in a cavity",
        "touches nothing",
        holding.afloat,
        ALL,
        (free, "part"),
    )
    yield Case("holding", "body", "no node held", holding.unheld, ALL, (free, "the body"))
    yield Case(
        "holding", "body", "one node held", bind(holding.pinned, 1), ALL, ("rotation about",) * 3
    )
    yield Case(
        "holding", "body", "two nodes held", bind(holding.pinned, 2), ALL, ("rotation about x",)
    )
    yield Case(
        "holding", "hinge", "edge", bind(holding.hinge, "edge"), ALL, ("rotation about z", "part")
    )
    yield Case(
        "holding",
        "hinge",
        "node",
        bind(holding.hinge, "node"),
        ALL,
        ("rotation about",) * 3 + ("part",),
    )
    for shared in ("edge", "node"):
        text = f"{shared}, far end held"
        yield Case("holding", "hinge", text, bind(holding.hinge, shared, far_end_held=True), ALL)
    for degrees, nu, power in ((1.0, 0.49, 4), (1.0, 0.499, 6), (0.1, 0.4999, 8)):
        text = f"ν = {_number(nu)}, contrast 1e{power}, {_number(degrees)}°"
        yield Case(
            "all at once", "block", text, bind(bodies.squashed, degrees, nu, 10.0**power), ALL
        )


# Running.


@functools.cache
def problem(case: Case) -> Problem:
    """The built case."""
    built: Problem = case.build()
    return built


@functools.cache
def model(case: Case) -> ExtendedModel:
    """Its forces with 32 digits."""
    p = problem(case)
    return ExtendedModel(p.nodes, p.tets, p.materials, p.material_of)


@functools.cache
def reference(case: Case) -> Reference:
    """Its displacements with 32 digits."""
    p = problem(case)
    return solve(model(case), *p.prescribed(), p.loads)


def run_cmfsim(case: Case, method: str) -> cmfsim.Solution:
    """What a user would do with the case."""
    p = problem(case)
    along, across, nu = (
        np.array([getattr(m, name) for m in p.materials])[p.material_of]
        for name in ("along", "across", "poisson")
    )
    if all(m.fibre is None for m in p.materials):
        tissue = cmfsim.Tissue.isotropic(along, nu)
    else:
        fibre = np.array([m.fibre for m in p.materials])[p.material_of]
        tissue = cmfsim.Tissue.transversely_isotropic(along, across, nu, fibre)
    tensors = cmfsim.MassTensors(cmfsim.TetMesh(p.nodes, p.tets), tissue)
    boundary = cmfsim.Boundary(fixed=p.fixed, joined=p.joined)
    limit = SWEEPS if method == "relaxation" else None
    solver = cmfsim.StaticSolver(
        tensors, boundary, method, max_iterations=limit, tolerance=case.tolerance
    )
    return solver.solve(p.plan, loads=p.loads)


def judge(case: Case, method: str) -> Row:
    """Solves a case with a method and compares."""
    blank = Row(case.group, case.name, case.parameter, method)
    problem(case)
    begin = time.perf_counter()
    try:
        with patience(PATIENCE):
            result = run_cmfsim(case, method)
    except cmfsim.CmfsimError as error:
        return _refused(case, blank, error, time.perf_counter() - begin)
    except TimeoutError:
        return replace(blank, verdict=f"WRONG: no answer in {PATIENCE} s")
    except BaseException as error:  # a Rust panic is no Exception
        if isinstance(error, KeyboardInterrupt):
            raise
        return replace(blank, verdict=f"WRONG: {type(error).__name__}: {error}")
    return _compared(case, method, blank, result, time.perf_counter() - begin)


def _refused(case: Case, row: Row, error: cmfsim.CmfsimError, seconds: float) -> Row:
    """A refusal: wanted where nothing holds the body, and open to the iterative methods."""
    text = f"{type(error).__name__}: {error}"
    verdict = f"refused: {text}"
    if case.refusal:
        counts = {word: case.refusal.count(word) for word in case.refusal}
        named = all(text.count(word) >= count for word, count in counts.items())
        passed = isinstance(error, cmfsim.BoundaryError) and named
        if not passed:
            verdict = f"WRONG: the refusal must be a BoundaryError with {case.refusal}: {text}"
        return replace(row, seconds=seconds, verdict=verdict, passed=passed, reference="mechanism")
    condition = reference(case).condition
    round_off = CONDITION_FACTOR * EPS * condition
    open_to = {
        "cholesky": round_off > WORTHLESS,
        "pcg": round_off > case.tolerance,
        "relaxation": round_off > case.tolerance or condition > SWEEPS,
    }
    passed = open_to[row.method] and isinstance(error, cmfsim.SolverError)
    if not passed:
        verdict = f"WRONG: refused though κ ε leaves room to solve it: {text}"
    return replace(
        row,
        seconds=seconds,
        verdict=verdict,
        passed=passed,
        condition=condition,
        reference=_kind(case),
    )


def _kind(case: Case) -> str:
    return "32 digits" if problem(case).exact is None else "closed form"


def _compared(case: Case, method: str, row: Row, result: cmfsim.Solution, seconds: float) -> Row:
    p = problem(case)
    if case.refusal:
        return replace(row, seconds=seconds, verdict="WRONG: solved, but it is a mechanism")
    known = reference(case)
    exact = known.displacements if p.exact is None else p.exact
    u = result.displacements
    size = float(np.linalg.norm(exact, axis=1).max()) or 1.0
    error = float(np.linalg.norm(u - exact, axis=1).max()) / size
    bound = result.error_estimate / size
    rounding, true_residual = _residual(case, u)
    round_off = min(CONDITION_FACTOR * EPS * known.condition, WORTHLESS)
    if method == "cholesky":
        allowed = min(max(ERROR_LIMIT, round_off), bound + round_off)
    else:
        allowed = BOUND_FACTOR * bound + round_off
    floor = RESIDUAL_FACTOR * rounding
    faults = []
    if not error <= allowed:
        faults.append(f"error {error:.1e} where {allowed:.1e} is allowed")
    if not abs(result.residual - true_residual) <= floor + 0.01 * true_residual:
        faults.append(f"reports residual {result.residual:.1e}, true is {true_residual:.1e}")
    if method == "cholesky" and not true_residual <= floor:
        faults.append(f"residual {true_residual:.1e} above round-off {floor:.1e}")
    return replace(
        row,
        condition=known.condition,
        reference=_kind(case),
        residual=result.residual,
        true_residual=true_residual,
        error=error,
        error_estimate=bound,
        allowed=allowed,
        iterations=result.iterations,
        seconds=seconds,
        verdict="ok" if not faults else "WRONG: " + "; ".join(faults),
        passed=not faults,
    )


def _residual(case: Case, u: Floats) -> tuple[float, float]:
    """ε ‖|K| |u|‖ / ‖b‖ and ‖K u − loads‖ / ‖b‖ over the unknowns, b the forces brought in."""
    p = problem(case)
    mask, motion = p.prescribed()
    unknown = np.repeat(~mask, 3)
    if not unknown.any():
        return 0.0, 0.0
    loads = np.zeros_like(u) if p.loads is None else p.loads
    brought = (model(case).forces(motion) - Twofold(loads)).hi.ravel()[unknown]
    rest = (model(case).forces(Twofold(u)) - Twofold(loads)).hi.ravel()[unknown]
    size = float(np.linalg.norm(brought)) or 1.0
    products = (abs(model(case).matrix) @ np.abs(u).ravel())[unknown]
    softening = max(max(m.across / m.along, 1.0) for m in p.materials)
    rounding = EPS * softening * float(np.linalg.norm(products)) / size
    return rounding, float(np.linalg.norm(rest)) / size
