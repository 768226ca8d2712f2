"""Large deformation: closed forms, and balance of forces computed by scikit-fem.

Without a closed form, the error is the step that Newton's method would still take from the forces
of `independent.py`, with the tangent of cmfsim; at equilibrium this step is zero.
"""

from __future__ import annotations

import functools
import time
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

import cmfsim
from benches.scenes import independent
from benches.scenes.extended import Material, isotropic
from benches.scenes.meshes import box
from benches.stability.extreme import bodies
from benches.stability.extreme.problem import FAT, NU, Problem, hull, one, signed_volumes, where
from benches.stability.extreme.rows import PATIENCE, Case, Row, patience

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

COLUMNS = ("true residual", "error", "least J")
KINDS = ("corotational", "hyperelastic")
ELEMENTS = ("p1", "anp", "p2")
EVERY = tuple(f"{element} {kind}" for kind in KINDS for element in ELEMENTS)
# Without `anp`, of which there are no independent forces.
CHECKED = tuple(f"{element} {kind}" for kind in KINDS for element in ("p1", "p2"))
LINEAR_TETS = tuple(f"p1 {kind}" for kind in KINDS)
# Error over the largest displacement, and forces out of balance over those at the held nodes.
ERROR = 1e-7
RESIDUAL = 1e-6
# A word of the error of a plan that Newton's method may lose.
LOST = ("newton did not converge",)


def deformed(gradient: Floats, material: Material, size: tuple[float, float, float]) -> Problem:
    """A uniform body with u = (F − I) x on its whole boundary, and so inside."""
    nodes, tets = box((3, 3, 3), size, jitter=0.15)
    exact = nodes @ (gradient - np.eye(3)).T
    ids = hull(nodes)
    joined, plan = {"all": ids}, {"all": exact[ids]}
    return Problem(nodes, tets, (material,), one(tets), joined=joined, plan=plan, exact=exact)


def turned(angle: float, fibre: tuple[float, float, float] | None = None) -> Problem:
    """A body whose boundary turns: so does the inside, without stress."""
    material = Material(10 * FAT, FAT, 0.43, fibre) if fibre else isotropic(FAT, NU)
    gradient = cmfsim.rigid_motion(angle=angle, axis=(1.0, 2.0, -1.0))[:3, :3]
    return deformed(gradient, material, bodies.BOX)


def bar(contrast: float = 1.0) -> tuple[Floats, NDArray[np.uint32], Problem]:
    """A bar of 60 × 20 × 20 mm held at one end, its cells soft or stiff at random."""
    nodes, tets = box((6, 2, 2), (60.0, 20.0, 20.0), jitter=0.15)
    cell = np.floor(nodes[tets].mean(axis=1) / 10.0).astype(np.int64)
    draw = np.random.default_rng(3).random((6, 2, 2)) < 0.3
    material_of = draw[tuple(np.clip(cell, 0, [5, 1, 1]).T)].astype(np.uint32)
    materials = (isotropic(FAT, NU), isotropic(FAT * contrast, NU))
    end = where(nodes[:, 0] == 60.0)
    problem = Problem(
        nodes, tets, materials, material_of, fixed=where(nodes[:, 0] == 0.0), joined={"end": end}
    )
    return nodes, end, problem


def moved_end(
    translation: tuple[float, float, float],
    angle: float,
    axis: tuple[float, float, float],
    contrast: float = 1.0,
) -> Problem:
    """The bar with its free end moved and turned about its middle."""
    _, _, problem = bar(contrast)
    return replace(
        problem, plan={"end": cmfsim.rigid_motion(translation, angle, axis, (60.0, 10.0, 10.0))}
    )


def cases(*, quick: bool = False) -> list[Case]:
    """All cases, or with `quick` the ones that the tests run."""
    return [c for c in _cases() if c.quick or not quick]


def _cases() -> Iterator[Case]:
    bind = functools.partial
    group = "large deformation"
    for angle in (5.0, 30.0, 60.0, 90.0, 120.0):
        yield Case(group, "turned", f"{angle:g}°", bind(turned, angle), EVERY, quick=angle == 120.0)
    slanted = bind(turned, 90.0, (0.6, 0.0, 0.8))
    yield Case(group, "turned, with fibres", "90°", slanted, EVERY, quick=False)
    for ratio in (0.8, 0.5, 0.2):
        build = bind(deformed, np.diag([ratio, 1.0, 1.0]), isotropic(FAT, NU), bodies.BOX)
        yield Case(group, "squeezed", f"J = {ratio:g}", build, EVERY, quick=ratio == 0.2)
    shear = np.array([[1.0, 0.0, 4.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    layer = bind(deformed, shear, isotropic(FAT, NU), (60.0, 50.0, 0.5))
    yield Case(group, "layer of 0.5 mm sheared", "400 %", layer, EVERY, quick=False)
    along = (1.0, 0.0, 0.0)
    for angle in (45.0, 90.0, 170.0):
        build = bind(moved_end, (0.0, 0.0, 0.0), angle, along)
        yield Case(group, "bar twisted", f"{angle:g}°", build, CHECKED, quick=angle == 90.0)
    build = bind(moved_end, (0.0, 0.0, 0.0), 60.0, along, 1e4)
    yield Case(group, "bar twisted, contrast 1e4", "60°", build, CHECKED, LOST, quick=False)
    for angle in (45.0, 90.0):
        build = bind(moved_end, (-10.0, 15.0, 0.0), angle, (0.0, 0.0, 1.0))
        yield Case(group, "bar bent", f"{angle:g}°", build, CHECKED, quick=False)
    for shift in (-18.0, -30.0, -90.0):
        text = f"{-shift / 60.0:.0%} of its length"
        build = bind(moved_end, (shift, 0.0, 0.0), 0.0, along)
        yield Case(group, "bar pushed together", text, build, LINEAR_TETS, LOST, quick=False)


@functools.cache
def problem(case: Case) -> Problem:
    """The built case."""
    built: Problem = case.build()
    return built


def forget() -> None:
    """Drops what is kept of the cases."""
    problem.cache_clear()


def judge(case: Case, method: str) -> Row:
    """Solves a case with an element and kinematics and compares.

    Cases with a `refusal` may be refused with it, or come to rest.
    """
    element, kind = method.split()
    p = problem(case)
    row = Row(case.group, case.name, case.parameter, method)
    along, across, nu = (
        np.array([getattr(m, name) for m in p.materials])[p.material_of]
        for name in ("along", "across", "poisson")
    )
    tissue = cmfsim.Tissue.isotropic(along, nu)
    if p.materials[0].fibre is not None:
        tissue = cmfsim.Tissue.transversely_isotropic(along, across, nu, p.materials[0].fibre)
    tensors = cmfsim.MassTensors(cmfsim.TetMesh(p.nodes, p.tets), tissue, element=element)
    boundary = cmfsim.Boundary(fixed=p.fixed, joined=p.joined)
    begin = time.perf_counter()
    try:
        with patience(PATIENCE):
            solver = cmfsim.StaticSolver(tensors, boundary, "cholesky", kinematics=kind)
            result = solver.solve(p.plan)
    except cmfsim.SolverError as refusal:
        passed = bool(case.refusal) and all(word in str(refusal) for word in case.refusal)
        verdict = f"{'' if passed else 'WRONG: '}refused: SolverError: {refusal}"
        return replace(row, verdict=verdict, passed=passed, seconds=time.perf_counter() - begin)
    except TimeoutError:
        return replace(row, verdict=f"WRONG: no answer in {PATIENCE} s")
    seconds = time.perf_counter() - begin
    u = result.all_displacements
    size = float(np.linalg.norm(u, axis=1).max())
    moved = np.asarray(p.nodes) + result.displacements
    least = float((signed_volumes(moved, p.tets) / signed_volumes(p.nodes, p.tets)).min())
    faults = []
    residual = None
    if p.exact is None:
        residual, error = _balance(p, tensors, u, kind, along, nu)
        error /= size
        if residual > RESIDUAL:
            faults.append(f"forces out of balance by {residual:.1e}")
    else:
        error = float(np.linalg.norm(result.displacements - p.exact, axis=1).max()) / size
    if not error <= ERROR:
        faults.append(f"error {error:.1e} where {ERROR:.1e} is allowed")
    said = "ok" if least > 0.0 else "at rest, with inverted tets: do not use"
    return replace(
        row,
        reference="scikit-fem forces" if p.exact is None else "closed form",
        true_residual=residual,
        error=error,
        least_volume=least,
        allowed=ERROR,
        iterations=result.iterations,
        seconds=seconds,
        verdict=said if not faults else "WRONG: " + "; ".join(faults),
        passed=not faults,
    )


def _balance(
    p: Problem, tensors: cmfsim.MassTensors, u: Floats, kind: str, young: Floats, poisson: Floats
) -> tuple[float, float]:
    """Forces out of balance over those at the held nodes, and the step they would bring, mm."""
    stress = independent.STRESSES[kind]
    forces = independent.internal_forces(tensors.mesh, tensors, u, stress, young, poisson)
    mask, _ = p.prescribed()
    ends = np.asarray(tensors.mid_edges).astype(np.int64).reshape(-1, 2)
    held = np.concatenate([mask, mask[ends].all(axis=1)])
    rest = forces[~held].ravel()
    free = np.flatnonzero(np.repeat(~held, 3))
    tangent = sp.csr_matrix(tensors.tangent(u, kinematics=kind))[free][:, free]
    step = spla.splu(sp.csc_matrix(tangent)).solve(rest).reshape(-1, 3)
    residual = float(np.linalg.norm(rest) / np.linalg.norm(forces[held]))
    return residual, float(np.linalg.norm(step, axis=1).max())
