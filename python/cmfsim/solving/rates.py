"""Derivatives of a solved face with respect to uncertain parameters, by one linear solve each.

Of a material constant p, K ∂u/∂p = −(∂K/∂p) u: the right-hand side is a difference of internal
forces at the solved u, and the factor or preconditioner is that of the solution. Sliding contact is
continued to first order, its set of held nodes unchanged. The motion of a bone enters as a load of
what is joined to it and as a motion of its contact surface.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from cmfsim._core import MassTensors, Solution, StaticSolver
from cmfsim.errors import CaseInputError
from cmfsim.solving.simulation import scene_plan
from cmfsim.solving.tissue_changes import TissueParts, tissue_parts
from cmfsim.values.checks import Floats
from cmfsim.values.patient_model import PatientModel
from cmfsim.values.scene import Scene
from cmfsim.values.surface_data import MovedSurface
from cmfsim.values.uncertainty import PLAN, TISSUE, Source

# Difference of forces, in standard deviations: small enough for its error of first order to be
# 1e-4 of it, far above rounding. Downwards, away from ν = 0.5 and from a fraction of 1.
STEP = -1e-4
# Error that an iterative solve may leave in a derivative, as a share of it in the energy norm: a
# third of the 1 % that is asked of derivatives.
ACCURACY = 3e-3
# Unit axes to the left, back and up (LPS).
AXES = np.eye(3)


@dataclass(frozen=True, eq=False)
class SkinRates:
    """Displacements of the skin by one standard deviation of each source.

    Attributes
    ----------
    rates : mapping of str to (k, 3) float64, mm
        By source; those of a plan are called "SEGMENT: SOURCE".
    sources : mapping of str to Source
        By the same names.
    left_out : tuple of str
        Sources that the scene does not allow, with the reason.
    seconds : float
    """

    rates: Mapping[str, Floats]
    sources: Mapping[str, Source]
    left_out: tuple[str, ...]
    seconds: float


def skin_rates(
    patient: PatientModel, scene: Scene, solver: StaticSolver, solution: Solution
) -> SkinRates:
    """The derivatives of the skin with respect to tissue and plan, each times its prior's sd.

    Parameters
    ----------
    patient : PatientModel
    scene : Scene
        What was solved: `model_scene` of the patient.
    solver : StaticSolver
    solution : Solution
        Of the scene's plan.

    Returns
    -------
    SkinRates

    Raises
    ------
    CaseError
        (also `ValueError`) Kinematics that are not linear, or lips in contact: no linear map.
    SolverError
        A linear solve that fails.
    """
    begun = time.perf_counter()
    _check_scene(scene)
    changes: dict[str, ArrayLike | Mapping[str, ArrayLike]] = {}
    sources: dict[str, Source] = {}
    left_out: list[str] = []
    parts = scene_parts(patient, scene)
    if parts is None:
        left_out.append(
            "tissue: fat and muscle cannot be distinguished in the stiffness of the scene"
        )
    else:
        for source in (s for s in TISSUE if s.name in parts.sources):
            u, forces = solution.all_displacements, solution.all_forces
            changes[source.name] = tissue_load(solver.tensors, u, forces, parts, source)
            sources[source.name] = source
    for segment, rates in _plan_changes(patient, scene, left_out).items():
        for source, rate in zip(PLAN, rates, strict=True):
            name = f"{segment}: {source.name}"
            changes[name], sources[name] = {segment: rate}, source
    listed: Sequence[ArrayLike | Mapping[str, ArrayLike]] = list(changes.values())
    found = solver.responses(solution, scene_plan(scene), listed, accuracy=ACCURACY)
    rates_found = {name: patient.skin_field(u) for name, u in zip(changes, found, strict=True)}
    return SkinRates(rates_found, sources, tuple(left_out), time.perf_counter() - begun)


def _check_scene(scene: Scene) -> None:
    if scene.options.kinematics != "linear":
        raise CaseInputError(
            f"a band requires linear kinematics, but the case has {scene.options.kinematics}: "
            'set kinematics = "linear" in [solver], or predict without a band'
        )
    if scene.touching or scene.obstacles:
        raise CaseInputError(
            "a band cannot be computed if lips are in contact, because the nodes in contact "
            "change: set contact = false in [lips], or predict without a band"
        )


def scene_parts(patient: PatientModel, scene: Scene) -> TissueParts | None:
    """Fat and muscle of a scene's tissue; None where they cannot be told apart."""
    # A homogeneous model has no muscle, whatever the patient has.
    fraction = None if scene.tissue is patient.fat else patient.fraction
    return tissue_parts(scene.tissue, scene.n_tets, patient.fat, fraction)


def tissue_load(
    tensors: MassTensors, u: Floats, forces: Floats, parts: TissueParts, source: Source
) -> Floats:
    """−(∂K/∂p) u times the standard deviation, (n, 3) N.

    Parameters
    ----------
    tensors : MassTensors
        Of the tissue as it is.
    u, forces : (n, 3) float64, mm and N
        Displacements, and their forces K u.
    parts : TissueParts
    source : Source
        One of `parts.sources`.
    """
    tissue = parts.changed(source.name, STEP * source.sd).tissue()
    changed = MassTensors(tensors.mesh, tissue, element=tensors.element)
    return -(changed.force(u) - forces) / STEP


def _plan_changes(
    patient: PatientModel, scene: Scene, left_out: list[str]
) -> dict[str, list[Floats]]:
    """Rates of the motion of each segment that is moved, (4, 4) each, in the order of `PLAN`."""
    if "achieved" in patient.summary:
        left_out.append("execution of the plan: the plan was measured on the post-operative bones")
        return {}
    found = {}
    for name, motion in scene.plan.items():
        if isinstance(motion, MovedSurface) or motion.shape != (4, 4):
            left_out.append(f"execution of the plan: {name} moves vertex by vertex")
            continue
        nodes = scene.segments[name].joined
        if np.array_equal(motion, np.eye(4)) or not len(nodes):
            continue
        middle = scene.nodes[nodes].mean(axis=0)
        found[name] = _rates(motion, motion[:3, :3] @ middle + motion[:3, 3])
    return found


def _rates(matrix: Floats, middle: Floats) -> list[Floats]:
    """The change of x ↦ R x + t by one sd of each of `PLAN`: shifts, and turns about `middle`."""
    found = []
    for number, source in enumerate(PLAN):
        rate, axis = np.zeros((4, 4)), AXES[number % 3]
        if source.unit == "mm":
            rate[:3, 3] = source.sd * axis
        else:
            # ω × as a matrix: column j is ω × e_j.
            turn = np.radians(source.sd) * np.cross(axis, AXES).T
            rate[:3, :3] = turn @ matrix[:3, :3]
            rate[:3, 3] = turn @ (matrix[:3, 3] - middle)
        found.append(rate)
    return found
