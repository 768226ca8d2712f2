"""Derivatives of a solved face with respect to uncertain parameters, by one linear solve each.

Of a material constant p, K ∂u/∂p = −(∂K/∂p) u: the right-hand side is a difference of internal
forces at the solved u, and the factor or preconditioner is that of the solution. Sliding contact is
continued to first order, its set of held nodes unchanged. The motion of a bone enters as a load of
what is joined to it and as a motion of its contact surface.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from cmfsim._core import MassTensors, Solution, StaticSolver, Tissue
from cmfsim.errors import CaseInputError, MaterialError
from cmfsim.solving.simulation import scene_plan
from cmfsim.values.calibration import PLAN, TISSUE, Source
from cmfsim.values.checks import Floats
from cmfsim.values.moduli import PRESET_MODULI, FatModuli
from cmfsim.values.motion import rigid_motion
from cmfsim.values.patient_model import PatientModel
from cmfsim.values.scene import Scene
from cmfsim.values.surface_data import MovedSurface
from cmfsim.values.tissue_data import TissueData

# Difference of forces, in standard deviations: small enough for its error of first order to be
# 1e-4 of it, far above rounding. Downwards, away from ν = 0.5 and from a fraction of 1.
STEP = -1e-4
# Error that an iterative solve may leave in a derivative, as a share of it in the energy norm: a
# third of the 1 % that is asked of derivatives.
ACCURACY = 3e-3
# Unit axes to the left, back and up (LPS).
AXES = np.eye(3)


@dataclass(frozen=True, eq=False)
class TissueParts:
    """The share of fat and of muscle in the constants of each tet.

    With the fraction p of muscle, (m,), E = E_fat (1 − p) + E_m along and across, ν likewise.
    along, across, poisson: (m,). What muscle adds, Σ p_i E_i in MPa and Σ p_i ν_i.
    """

    fat_young: float
    fat_poisson: float
    fraction: Floats
    along: Floats
    across: Floats
    poisson: Floats
    fibre: Floats
    law: str

    def tissue(self) -> Tissue:
        """The tissue of all tets; `MaterialError` unless every stiffness is positive definite."""
        rest = 1.0 - self.fraction
        fat, poisson = rest * self.fat_young, rest * self.fat_poisson + self.poisson
        if not self.fraction.any():
            return Tissue.isotropic(fat, poisson)
        along, across = fat + self.along, fat + self.across
        return Tissue.transversely_isotropic(along, across, poisson, self.fibre, law=self.law)

    def changed(self, source: str, by: float) -> "TissueParts":
        """The parts with one source of `TISSUE` changed, in its unit; degrees for directions."""
        return _CHANGES[source](self, by)

    @property
    def sources(self) -> tuple[str, ...]:
        """The sources that have an effect: those of muscle only where there is muscle.

        Without muscle the modulus has none: displacements depend on ratios alone.
        """
        return tuple(_CHANGES) if self.fraction.any() else ("fat Poisson's ratio",)


def _turned(axis: tuple[float, float, float]) -> Callable[[TissueParts, float], TissueParts]:
    def change(parts: TissueParts, degrees: float) -> TissueParts:
        turn = rigid_motion(angle=degrees, axis=axis)[:3, :3]
        return replace(parts, fibre=parts.fibre @ turn.T)

    return change


def _more_muscle(parts: TissueParts, by: float) -> TissueParts:
    scale = 1.0 + by
    return replace(
        parts,
        fraction=scale * parts.fraction,
        along=scale * parts.along,
        across=scale * parts.across,
        poisson=scale * parts.poisson,
    )


_CHANGES: Mapping[str, Callable[[TissueParts, float], TissueParts]] = {
    "fat modulus": lambda p, by: replace(p, fat_young=p.fat_young * math.exp(by)),
    "muscle modulus along": lambda p, by: replace(p, along=p.along * math.exp(by)),
    "muscle modulus across": lambda p, by: replace(p, across=p.across * math.exp(by)),
    "fat Poisson's ratio": lambda p, by: replace(p, fat_poisson=p.fat_poisson + by),
    "muscle Poisson's ratio": lambda p, by: replace(p, poisson=p.poisson + by * p.fraction),
    "muscle fraction": _more_muscle,
    "fibre direction about L": _turned((1.0, 0.0, 0.0)),
    "fibre direction about P": _turned((0.0, 1.0, 0.0)),
    "fibre direction about S": _turned((0.0, 0.0, 1.0)),
}


def tissue_parts(
    data: TissueData, n_tets: int, fat: TissueData, fraction: Floats | None
) -> TissueParts | None:
    """Fat and muscle of a scene's tissue; None where they cannot be told apart.

    fraction: (m,) or None. Share of muscle in each tet; None in a patient without.
    """
    if data.kind == "stiffness" or (data.kind == "preset" and data.mixing != "moduli"):
        return None
    arrays = {
        name: np.broadcast_to(value, (n_tets, *value.shape[1:]))
        for name, value in data.arrays().items()
    }
    none = np.zeros(n_tets)
    straight = np.broadcast_to([1.0, 0.0, 0.0], (n_tets, 3))
    if data.kind == "preset":
        moduli = PRESET_MODULI[data.preset]
        young, poisson = moduli.fat.constants()
        p = arrays["fraction"]
        along, across, ratio = (p * value for value in moduli.muscle.constants())
        law = "spencer"
    else:
        try:
            young, poisson = FatModuli.of(fat).constants()
        except MaterialError:
            return None
        law = data.law
        if data.kind == "isotropic":
            uniform = all(np.size(value) == 1 for value in data.arrays().values())
            if not uniform:
                return None
            young, poisson = float(arrays["young"][0]), float(arrays["poisson"][0])
            return TissueParts(young, poisson, none, none, none, none, straight, law)
        if fraction is None:
            return None
        p = fraction
        along, across = (arrays[n] - (1.0 - p) * young for n in ("young_along", "young_across"))
        ratio = arrays["poisson"] - (1.0 - p) * poisson
    # Fat has no direction; any unit vector serves.
    fibre = np.where(p[:, None] > 0.0, arrays.get("fibre", straight), straight)
    return TissueParts(young, poisson, p, along, across, ratio, fibre, law)


@dataclass(frozen=True, eq=False)
class SkinRates:
    """Displacements of the skin by one standard deviation of each source, (k, 3), mm, by its name.

    Those of a plan are called "SEGMENT: SOURCE"; `left_out`: what the scene forbids, and why.
    """

    rates: Mapping[str, Floats]
    sources: Mapping[str, Source]
    left_out: tuple[str, ...]
    seconds: float


def skin_rates(
    patient: PatientModel, scene: Scene, solver: StaticSolver, solution: Solution
) -> SkinRates:
    """The derivatives of the skin with respect to tissue and plan, each times its prior's sd.

    scene: What was solved, its plan's solution: `model_scene` of the patient.
    Raises `CaseError`: Kinematics that are not linear, or lips in contact: no linear map.
    Raises `SolverError`: A linear solve that fails.
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
    """−(∂K/∂p) u times the standard deviation of a source of the tissue as it is, (n, 3) N.

    u, forces: (n, 3), mm and N. Displacements, and their forces K u.
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
    sizes = [s.sd if s.unit == "mm" else np.radians(s.sd) for s in PLAN]
    for name, motion in scene.plan.items():
        if isinstance(motion, MovedSurface) or motion.shape != (4, 4):
            left_out.append(f"execution of the plan: {name} moves vertex by vertex")
            continue
        nodes = scene.segments[name].joined
        if np.array_equal(motion, np.eye(4)) or not len(nodes):
            continue
        middle = scene.nodes[nodes].mean(axis=0)
        found[name] = motion_rates(motion, motion[:3, :3] @ middle + motion[:3, 3], sizes)
    return found


def motion_rates(matrix: Floats, middle: Floats, sizes: ArrayLike) -> list[Floats]:
    """The changes of x ↦ R x + t, (4, 4) each: shifts to the left, back, up, and turns about these.

    By sizes (6,), mm and radians; `middle` (3,), mm, stays where it is after the motion.
    """
    found = []
    for number, size in enumerate(np.asarray(sizes, dtype=np.float64)):
        rate, axis = np.zeros((4, 4)), AXES[number % 3]
        if number < 3:
            rate[:3, 3] = size * axis
        else:
            # ω × as a matrix: column j is ω × e_j.
            turn = size * np.cross(axis, AXES).T
            rate[:3, :3] = turn @ matrix[:3, :3]
            rate[:3, 3] = turn @ (matrix[:3, 3] - middle)
        found.append(rate)
    return found
