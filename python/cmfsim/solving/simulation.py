"""A scene solved: plain values become core objects and come back as arrays; slip is reported."""

import logging
import math
import platform
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim._core import (
    Boundary,
    MassTensors,
    Solution,
    StaticSolver,
    SurfaceMotion,
    TetMesh,
    Tissue,
    __version__,
)
from cmfsim.errors import BoundaryInputError
from cmfsim.values.checks import Floats, Indices
from cmfsim.values.finding import Finding
from cmfsim.values.scene import Scene, SceneResult
from cmfsim.values.surface_data import MovedSurface
from cmfsim.values.tissue_data import TissueData

# Of 60 random plans of two real heads, one in thirty has a node that slips further than this
# multiple of what bones moved: a node that went round an edge of the bone.
MOST_SLIP = 1.25
# Slip that needs no explanation, mm.
SMALL_SLIP = 4.0

_log = logging.getLogger(__name__)


def scene_solver(scene: Scene) -> StaticSolver:
    """The solver of a scene, ready for its plan and for others.

    Returns
    -------
    StaticSolver
        Mesh, tissue and boundary are at `.tensors.mesh`, `.tensors.tissue` and `.boundary`.

    Raises
    ------
    MeshError, MaterialError, BoundaryError, ContactError, SolverError
        (the input errors also `ValueError`) A problem that the core finds in the scene.

    Examples
    --------
    >>> import cmfsim
    >>> solver = cmfsim.scene_solver(scene)
    >>> plan = cmfsim.scene_plan(scene) | {"maxilla": cmfsim.rigid_motion((0, -5, 0))}
    >>> solution = solver.solve(plan)
    """
    return solver_of(scene, scene_tensors(scene))


def scene_tensors(scene: Scene) -> MassTensors:
    """The tensors of a scene, which depend on mesh, tissue and element alone."""
    mesh = TetMesh(scene.nodes, scene.tets)
    _log.info("mesh: %d nodes, %d tets", mesh.n_nodes, mesh.n_tets)
    return MassTensors(mesh, _tissue(scene.tissue), element=scene.options.element)


def solver_of(
    scene: Scene, tensors: MassTensors, liftable: tuple[Indices, str | None] | None = None
) -> StaticSolver:
    """The solver of a scene with its tensors, which scenes of other conditions may share.

    liftable: Nodes that plans hold or free, and the segment that they are then joined to, or None
        where they are fixed: `holding` of the solver then serves the scenes of all plans.
    """
    options = scene.options.as_dict()
    del options["element"]
    boundary = _boundary(scene, liftable)
    if boundary.conflicts:
        _log.warning("%d nodes had two kinds; the stronger one was kept", boundary.conflicts)
    solver = StaticSolver(tensors, boundary, options.pop("method"), **options)
    _log.info("solver: %s, %d unknowns", solver.method, solver.n_unknowns)
    return solver


def _boundary(scene: Scene, liftable: tuple[Indices, str | None] | None) -> Boundary:
    """The boundary conditions of a scene."""
    segments = scene.segments.items()
    sliding = {name: s.sliding for name, s in segments if np.size(s.sliding)}
    # A scene without one-sided contact does not pay for it.
    one_sided: dict[str, Any] = {}
    if scene.touching:
        one_sided["touching"] = [(touch.nodes, touch.triangles) for touch in scene.touching]
    if scene.obstacles:
        one_sided["obstacles"] = [
            (obstacle.nodes, obstacle.segment, obstacle.surface.searched)
            for obstacle in scene.obstacles
        ]
    return Boundary(
        fixed=scene.fixed,
        joined={name: s.joined for name, s in segments if np.size(s.joined)},
        sliding=sliding,
        contact={name: s.contact.searched for name, s in segments if s.contact is not None},
        gap={name: s.gap for name, s in segments if name in sliding},
        conflicts=scene.conflicts,
        liftable=liftable,
        **one_sided,
    )


def scene_plan(scene: Scene) -> dict[str, NDArray[np.float64] | SurfaceMotion]:
    """The plan of a scene in the form that `StaticSolver.solve` takes.

    Returns
    -------
    dict of str to (4, 4) float64, (j, 3) float64 or SurfaceMotion

    Raises
    ------
    MeshError
        (also `ValueError`) A moved surface with degenerate triangles.

    Examples
    --------
    >>> import cmfsim
    >>> plan = cmfsim.scene_plan(scene)
    """
    plan: dict[str, NDArray[np.float64] | SurfaceMotion] = {}
    for name, motion in scene.plan.items():
        if isinstance(motion, MovedSurface):
            plan[name] = SurfaceMotion(motion.surface.searched, motion.moved_vertices)
        else:
            plan[name] = motion
    return plan


def solve_scene(scene: Scene, *, solver: StaticSolver | None = None) -> SceneResult:
    """The solution of a scene under its own plan, loads and options.

    Parameters
    ----------
    scene : Scene
    solver : StaticSolver, optional
        Of this scene, with any plan and loads, if `scene_solver` has already made one. What touches
        from one side and the solver's other options cannot be compared with those of the scene.

    Returns
    -------
    SceneResult
        If large deformation leaves tets inverted, `summary["inverted_tets"]` counts them and
        `summary["findings"]` states which is worst and what to do. In linear kinematics the count
        is None, because it would have no meaning.

    Raises
    ------
    MeshError, MaterialError, BoundaryError, ContactError, SolverError
        (the input errors also `ValueError`) The scene is invalid, or the solution did not converge;
        the error states the figures reached. `BoundaryError`: the solver is of another scene.

    Examples
    --------
    >>> import cmfsim
    >>> scene = cmfsim.Scene(
    ...     nodes=[[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]],
    ...     tets=[[0, 1, 2, 3]],
    ...     tissue=cmfsim.TissueData("isotropic", young=1.0, poisson=0.0),
    ...     fixed=[0, 1, 2],
    ...     segments={"tip": cmfsim.SegmentData(joined=[3])},
    ...     plan={"tip": cmfsim.rigid_motion(translation=(0, 0, 0.1))},
    ... )
    >>> result = cmfsim.solve_scene(scene)
    >>> float(round(result.forces[3, 2], 9))  # V E g² u = 1/6 · 1 · 1 · 0.1
    0.016666667
    """
    if solver is None:
        solver = scene_solver(scene)
    else:
        _check_solver(solver, scene)
    return solved_scene(scene, solver)[0]


def _check_solver(solver: StaticSolver, scene: Scene) -> None:
    """Refuses the solver of another scene: its solution would be taken for that of this one."""
    mesh, tissue, given = solver.tensors.mesh, solver.tensors.tissue, solver.boundary
    needed, options = _boundary(scene, None), scene.options
    parts: dict[str, list[tuple[Any, Any]]] = {
        "nodes": [(mesh.nodes, scene.nodes)],
        "tets": [(mesh.tets, scene.tets)],
        "segments": [(given.segments, needed.segments)],
        "fixed nodes": [(given.fixed, needed.fixed)],
        "joined nodes": [(given.joined.get(name), j) for name, j in needed.joined.items()],
        "sliding nodes": [(given.sliding.get(name), s) for name, s in needed.sliding.items()],
        "contact surfaces": [
            (getattr(given.contact.get(name), of, None), getattr(surface, of))
            for name, surface in needed.contact.items()
            for of in ("vertices", "triangles")
        ],
        "gaps": [(given.gap.get(name), gap) for name, gap in needed.gap.items()],
        "element": [(solver.tensors.element, options.element)],
        "kinematics": [(solver.kinematics, options.kinematics)],
        "tissue": [(tissue.stiffness(), _tissue(scene.tissue).stiffness())],
    }
    for part, pairs in parts.items():
        if not all(np.array_equal(one, other) for one, other in pairs):
            raise BoundaryInputError(
                f"the solver is of another scene, with other {part}: make one of this scene "
                "(scene_solver)"
            )


def solved_scene(scene: Scene, solver: StaticSolver) -> tuple[SceneResult, Solution]:
    """The result of a scene as `solve_scene` has it, and the core's solution, to go on from."""
    solution = solver.solve(scene_plan(scene), loads=scene.loads)
    _log.info(
        "solved: residual %.2e, error %.2e mm (estimated)",
        solution.residual,
        solution.error_estimate,
    )
    inverted, findings = _inverted(solver, solution)
    findings += _contact_findings(solution)
    if len(solution.contact_nodes):
        slipped = slip_finding(scene, solution.displacements)
        findings += [] if slipped is None else [told(slipped)]
    summary: dict[str, Any] = {
        "scene_sha256": scene.sha256(),
        "n_nodes": scene.n_nodes,
        "n_tets": scene.n_tets,
        "n_unknowns": solver.n_unknowns,
        "method": solver.method,
        "element": solver.tensors.element,
        "kinematics": solver.kinematics,
        "contact": scene.options.contact,
        "conflicts": solver.boundary.conflicts,
        "residual": _finite(solution.residual),
        "error_estimate": _finite(solution.error_estimate),
        "iterations": solution.iterations,
        "contact_gap": _finite(solution.contact_gap),
        "contact_unbalanced": _finite(solution.contact_unbalanced),
        "contact_converged": solution.contact_converged,
        "contact_iterations": solution.contact_iterations,
        "inverted_tets": inverted,
        **_touching(scene, solution),
        "findings": findings,
        "factor_bytes": solver.factor_bytes,
        "timings": {"set_up": dict(solver.timings), "solve": dict(solution.timings)},
        "versions": {
            "cmfsim": __version__,
            "numpy": np.__version__,
            "python": platform.python_version(),
        },
    }
    mesh = solver.tensors.mesh
    result = SceneResult(
        nodes=mesh.nodes,
        tets=mesh.tets,
        skin_triangles=mesh.boundary_triangles(),
        displacements=solution.displacements,
        forces=solution.forces,
        residual_history=solution.residual_history,
        contact_nodes=solution.contact_nodes,
        contact_points=solution.contact_points,
        contact_normals=solution.contact_normals,
        contact_forces=solution.contact_forces,
        contact_gaps=solution.contact_gaps,
        summary=summary,
    )
    return result, solution


def _inverted(solver: StaticSolver, solution: Solution) -> tuple[int | None, list[dict[str, str]]]:
    """Tets that rest inverted, and what to say of them; linear kinematics has none to count."""
    if solver.kinematics == "linear":
        return None, []
    # A linear scene does not pay for it.
    from cmfsim.solving.inversion import inversion_finding  # noqa: PLC0415

    count, found = inversion_finding(solver.tensors, solution.all_displacements)
    return count, [] if found is None else [told(found)]


def _touching(scene: Scene, solution: Solution) -> dict[str, dict[str, Any]]:
    """What a result states of one-sided contact; nothing where the scene has none."""
    if not scene.touching and not scene.obstacles:
        return {}
    return {
        "touching": {
            "pressed": int(np.count_nonzero(solution.touching_forces > 0.0)),
            "penetration": _finite(solution.penetration),
            "rounds": solution.touching_rounds,
            "converged": solution.touching_converged,
        }
    }


def _contact_findings(solution: Solution) -> list[dict[str, str]]:
    """That contact stopped above its tolerance, with figures that no face would show."""
    findings = []
    if not solution.contact_converged:
        found = Finding(
            "contact-stopped",
            f"contact stopped after {solution.contact_iterations} steps with gaps of "
            f"{solution.contact_gap:.1e} mm and nodes {solution.contact_unbalanced:.1e} mm out of "
            "balance",
            where="contact",
        )
        findings.append(told(found))
    if not solution.touching_converged:
        found = Finding(
            "contact-stopped",
            f"one-sided contact stopped after {solution.touching_rounds} rounds with tissue "
            f"{solution.penetration:.1e} mm deep in other tissue or bone",
            where="contact",
            why="further rounds might change which nodes are in contact",
            fix="check the lips in the result; a smaller motion or a smoother surface is more "
            "likely to converge",
        )
        findings.append(told(found))
    return findings


def told(found: Finding) -> dict[str, str]:
    """The finding as results hold it, after a warning: the command line prints findings itself."""
    words = (found.code, found.what, found.where, found.why, found.fix)
    _log.warning("%s: %s, %s: %s; %s", *words, extra={"is_finding": True})
    return asdict(found)


def _finite(value: float) -> float | None:
    """A figure as JSON can hold it: null stands for one that is not known."""
    return value if math.isfinite(value) else None


def _tissue(data: TissueData) -> Tissue:
    arrays = data.arrays()
    if data.kind == "isotropic":
        return Tissue.isotropic(**arrays)
    if data.kind == "transversely_isotropic":
        return Tissue.transversely_isotropic(**arrays, law=data.law)
    if data.kind == "stiffness":
        return Tissue.from_stiffness(arrays["stiffness"])
    return Tissue.preset(data.preset, arrays["fraction"], arrays.get("fibre"), mixing=data.mixing)


def slip_finding(scene: Scene, displacements: ArrayLike) -> Finding | None:
    """The warning, "contact-slipped-far", that nodes slid further along a bone than bones moved.

    A node slips because its bone moves under tissue that is held elsewhere, or because other bones
    move that tissue: by about the motion of its bone at its place plus the largest of any other. A
    node that slips by more has usually gone round an edge, and the plan may have another
    equilibrium in which it has not. Segments that follow surfaces are left out, and so is
    unilateral contact, where nodes may leave the bone.
    """
    if scene.options.contact != "bilateral":
        return None
    u = np.asarray(displacements, dtype=np.float64)
    motions = _motions(scene)
    farthest = {name: float(np.linalg.norm(way, axis=1).max()) for name, way in motions.items()}
    count, worst, largest = 0, "", 0.0
    for name, way in motions.items():
        nodes = scene.segments[name].sliding
        if not len(nodes):
            continue
        # The motions of a segment's sliding nodes come first.
        own = way[: len(nodes)]
        slip = np.linalg.norm(u[nodes] - own, axis=1)
        others = max((far for other, far in farthest.items() if other != name), default=0.0)
        explained = MOST_SLIP * (np.linalg.norm(own, axis=1) + others)
        excess = slip / np.maximum(explained, SMALL_SLIP)
        count += int(np.count_nonzero(excess > 1.0))
        if excess.max() > largest:
            at = int(excess.argmax())
            largest = float(excess[at])
            x, y, z = scene.nodes[nodes[at]]
            worst = f"{slip[at]:.1f} mm on {name!r} at ({x:.1f}, {y:.1f}, {z:.1f}) mm"
    if count == 0:
        return None
    return Finding(
        "contact-slipped-far",
        f"{count} sliding {'node' if count == 1 else 'nodes'} slipped further than bones moved, at "
        f"most {worst} before the operation",
        where="contact",
    )


def _motions(scene: Scene) -> Mapping[str, Floats]:
    """How bone moves at the nodes of each rigid segment, sliding nodes first, (k, 3), mm."""
    motions = {}
    for name, segment in scene.segments.items():
        plan = scene.plan[name]
        nodes = np.concatenate([segment.sliding, segment.joined]).astype(np.int64)
        if isinstance(plan, MovedSurface) or plan.shape != (4, 4) or not len(nodes):
            continue
        places = scene.nodes[nodes]
        motions[name] = places @ plan[:3, :3].T + plan[:3, 3] - places
    return motions
