"""The band of a planning model: how far to trust the skin under any rigid plan, by one product.

The variance along the normal at a vertex is v + Σ_p (r_p + R_p q)². The constant v has the parts
that do not depend on the plan (errors of its execution and errors along the normal) and, at their
values for the reference plan, the tissue sources other than the moduli. One standard deviation of
modulus p moves the skin by r_p at the reference; R_p are the rates of r_p with six numbers q of
each segment, zero at the reference: the further shift of its centre and its further rotation, to
first order, with contact linearised about the reference.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmfsim._core import Solution, Surface
from cmfsim.errors import CaseInputError
from cmfsim.planning.replanning.model import Motions, PlanColumns, PlanningModel
from cmfsim.solving.models import model_scene
from cmfsim.solving.rates import ACCURACY, motion_rates, scene_parts, tissue_load
from cmfsim.solving.simulation import scene_plan
from cmfsim.values.calibration import TISSUE, Source
from cmfsim.values.checks import Floats
from cmfsim.values.motion import decompose_motion
from cmfsim.values.prediction import Prediction
from cmfsim.values.skin_band import SkinBand

# The sources whose effect grows with the plan by tenths of a millimetre; that of the others, below
# 0.1 mm, is taken as at the reference.
MODULI = ("fat modulus", "muscle modulus along", "muscle modulus across")
# Numbers of a segment: the shift of its centre, mm, and its rotation vector, radians.
NUMBERS = 6


@dataclass(frozen=True, eq=False)
class PlanBand:
    """The standard deviation of the skin along its normal under any rigid plan.

    Attributes
    ----------
    columns : PlanColumns
        Segments and centres of the numbers.
    reference : mapping of str to (4, 4) float64, mm
        The plan about which it is linear.
    at_reference : SkinBand
        The band of the reference plan, solved exactly: regions, factors, state.
    still : (k,) float64, mm²
        The part of the variance that does not depend on the plan.
    shift : (p, k) float64, mm
        Movement of the skin by one standard deviation of each modulus, at the reference plan.
    rates : (p, k, 6 s) float64
        Its change with each number of a plan.
    """

    columns: PlanColumns
    reference: Mapping[str, Floats]
    at_reference: SkinBand
    still: Floats
    shift: Floats
    rates: Floats

    def sd(self, plan: Motions) -> Floats:
        """The standard deviation at each vertex of the mesh's skin, (k,) mm."""
        shift = self.shift + self.rates @ self.numbers(plan)
        total: Floats = np.sqrt(self.still + (shift**2).sum(axis=0))
        return total

    def numbers(self, plan: Motions) -> Floats:
        """Six numbers of each segment, (6 s,): shift of its centre, mm, and turn, radians."""
        found = []
        for name, centre in zip(self.columns.segments, self.columns.centres, strict=True):
            new, old = (np.asarray(of[name], dtype=np.float64) for of in (plan, self.reference))
            # The further motion, about where the reference has the centre.
            further = np.eye(4)
            further[:3, :3] = new[:3, :3] @ old[:3, :3].T
            further[:3, 3] = new[:3, 3] - further[:3, :3] @ old[:3, 3]
            motion = decompose_motion(further, old[:3, :3] @ centre + old[:3, 3])
            found += [motion.translation, np.radians(motion.angle) * motion.axis]
        return np.concatenate(found)

    def half_widths(self, plan: Motions) -> dict[str, float]:
        """The mean half-width of the band in each region of the face, mm."""
        sd, band = self.sd(plan), self.at_reference
        factors = {name: known.factor for name, known in band.factors.items()}
        return {
            name: factors.get(name, band.plain_factor) * float(sd[part].mean())
            for name, part in band.regions.items()
        }

    @property
    def factor(self) -> Floats:
        """How many standard deviations the band has at each vertex, (k,); NaN where it has none."""
        band = self.at_reference
        return np.ma.filled(band.half_width, np.nan) / band.sd


def plan_band(planning: PlanningModel, reference: Prediction) -> PlanBand:
    """The band of a planning model under any rigid plan.

    Parameters
    ----------
    planning : PlanningModel
    reference : Prediction
        Of its reference plan, with a band: `predict_with_band`.

    Raises
    ------
    CaseError
        (also `ValueError`) A prediction without a band, or of another skin.
    SolverError
        A linear solve that fails.

    Examples
    --------
    >>> import cmfsim
    >>> reference = cmfsim.predict_with_band(planning.patient, planning.model)  # doctest: +SKIP
    >>> band = cmfsim.plan_band(planning, reference)  # doctest: +SKIP
    >>> band.half_widths({"maxilla": cmfsim.rigid_motion((0, -6, 0))})  # doctest: +SKIP
    {'face': 1.6, 'upper lip': 1.9}
    """
    band = reference.band
    if band is None:
        raise CaseInputError("the prediction has no band: make it with predict_with_band")
    if len(band.sd) != len(planning.columns.matrix):
        raise CaseInputError(
            f"the band has {len(band.sd)} vertices and the planning model's skin "
            f"{len(planning.columns.matrix)}: give the prediction of its reference plan"
        )
    scene = model_scene(planning.patient, planning.model)
    plan = scene_plan(scene)
    solution = planning.solver.solve(plan)
    moduli = [name for name in MODULI if name in band.parts]
    columns = planning.columns
    skin = reference.skin
    normals = Surface(skin.vertices, skin.triangles).vertex_normals
    rates = np.zeros((len(moduli), len(normals), NUMBERS * len(columns.segments)))
    if moduli:
        rates = _rates(planning, solution, moduli, normals)
    return PlanBand(
        columns,
        planning.reference,
        band,
        sum(
            (np.square(part) for name, part in band.parts.items() if name not in moduli),
            np.zeros(len(normals)),
        ),
        np.array([band.parts[name] for name in moduli]).reshape(len(moduli), len(normals)),
        rates,
    )


def _rates(
    planning: PlanningModel, solution: Solution, moduli: list[str], normals: Floats
) -> Floats:
    """The change of each modulus's part with each number of a plan, along the normals."""
    solver = planning.solver
    scene = model_scene(planning.patient, planning.model)
    plan, patient = scene_plan(scene), planning.patient
    moves = solver.responses(solution, plan, _unit_rates(planning), accuracy=ACCURACY)
    parts = scene_parts(patient, scene)
    assert parts is not None  # noqa: S101 (the band of the reference has the moduli's parts)
    sources: Mapping[str, Source] = {source.name: source for source in TISSUE}
    # A common factor on all moduli moves nothing, so that the last follows from the others.
    solved = moduli[:-1]
    loads = [
        tissue_load(solver.tensors, move, solver.tensors.force(move), parts, sources[name])
        for name in solved
        for move in moves
    ]
    found = solver.responses(solution, plan, loads, accuracy=ACCURACY)
    along = np.array([np.einsum("ka,ka->k", normals, patient.skin_field(u)) for u in found])
    rates: NDArray[np.float64] = along.reshape(len(solved), len(moves), -1).transpose(0, 2, 1)
    by_sd = np.array([sources[name].sd for name in solved])
    last = -sources[moduli[-1]].sd * np.einsum("pkq,p->kq", rates, 1.0 / by_sd)
    return np.concatenate([rates, last[None]])


def _unit_rates(planning: PlanningModel) -> list[dict[str, Floats]]:
    """The change of each segment's motion with each of its numbers, (4, 4)."""
    found = []
    for name, centre in zip(planning.columns.segments, planning.columns.centres, strict=True):
        matrix = planning.reference[name]
        middle = matrix[:3, :3] @ centre + matrix[:3, 3]
        found += [{name: rate} for rate in motion_rates(matrix, middle, np.ones(NUMBERS))]
    return found
