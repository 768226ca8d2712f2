"""A patient's planning model: the face under any rigid plan, by a product or solved exactly."""

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim._core import PlanOperator, StaticSolver
from cmfsim.errors import CaseInputError, SolverError
from cmfsim.planning.replanning.correction import PlanCorrection
from cmfsim.solving.models import model_scene, predict_patient
from cmfsim.solving.simulation import scene_plan, scene_tensors, solver_of
from cmfsim.values.checks import Floats, frozen, listing
from cmfsim.values.motion import rigid_matrix
from cmfsim.values.patient_model import LiftedTissue, PatientModel
from cmfsim.values.prediction import Prediction
from cmfsim.values.scene import Scene
from cmfsim.values.skin_motion import carried_points
from cmfsim.values.surface_data import MovedSurface, SurfaceData

# Numbers of a segment: nine of R − I, three for the displacement of its centre.
COLUMNS = 12


@dataclass(frozen=True, eq=False)
class PlanColumns:
    """A linear map from the rigid motions of segments to displacements.

    u(q) = u₀ + Σ_s A_s q_s, with twelve numbers for each segment: q_s = (R − I row by row,
    t + (R − I) c_s) for the motion x ↦ R x + t. The core provides A and c_s.

    segments: In the order of the columns.
    centres: (s, 3), mm, LPS. The point of each segment to which its columns refer.
    matrix: (k, 3, 12 s), for each node and axis: nine columns per segment for R − I, row by row,
        mm, and three for the displacement of its centre.
    offset: u₀, (k, 3), mm. Displacements if no segment moves: contact closes gaps at rest.
    """

    segments: tuple[str, ...]
    centres: Floats
    matrix: Floats
    offset: Floats

    def numbers(self, plan: Mapping[str, ArrayLike]) -> Floats:
        """The numbers q of a plan, (12 s,): R − I of each segment, then its centre's motion."""
        found = []
        for name, centre in zip(self.segments, self.centres, strict=True):
            matrix = np.asarray(plan[name], dtype=np.float64)
            turn = matrix[:3, :3] - np.eye(3)
            found += [turn.ravel(), matrix[:3, 3] + turn @ centre]
        return np.concatenate(found)

    def displacements(self, plan: Mapping[str, ArrayLike]) -> Floats:
        """The displacements under a plan, (k, 3) mm."""
        return self.offset + self.matrix @ self.numbers(plan)


def plan_columns(operator: PlanOperator) -> PlanColumns:
    """The columns of an operator, with their centres."""
    names = tuple(operator.segments)
    rest = {name: np.eye(4) for name in names}
    offset = operator(rest)
    matrix = operator.matrix.reshape(len(offset), 3, -1)
    return PlanColumns(names, frozen(operator.centres), frozen(matrix), frozen(offset))


# Contact counts as solved at this gap, mm, where a case asks for less. Newton's method converges
# quadratically, so that nodes are within 0.001 mm of where 0.0001 mm leaves them: a step is saved.
CONTACT_TOLERANCE = 0.01
# Rigid motions by segment, (4, 4) mm each.
Motions = Mapping[str, ArrayLike]


@dataclass(frozen=True, eq=False)
class PlanningModel:
    """The face of one patient under any rigid plan.

    A plan can be computed in two ways. `displacements`, `skin`, `face` and `carried` use one
    product with the columns of the plan operator, in which contact is linearised about the
    reference plan, tissue stays lifted off the bone as there, and `correction` corrects the rest.
    `solve` is exact. Both agree at the reference, and everywhere if the model `is_exact`.

    Attributes
    ----------
    patient : PatientModel
    model : str
        "H", "M", "H+S" or "M+S".
    solver : StaticSolver
        Factorised once, for every plan.
    columns : PlanColumns
        Of the nodes of the skin.
    reference : mapping of str to (4, 4) float64, mm
        The plan about which contact is continued.
    correction : PlanCorrection or None
        Correction of the product by exact solutions, away from the reference
        (`corrected_planning`).
    """

    patient: PatientModel
    model: str
    solver: StaticSolver
    columns: PlanColumns
    reference: Mapping[str, Floats]
    correction: PlanCorrection | None = None

    def __repr__(self) -> str:
        """The patient, the model, what may move, the reference plan and whether it is exact."""
        scene = self.patient.scene
        how = "corrected by exact solutions" if self.correction else "linearised contact"
        rows = {
            "model": self.model,
            "mesh": f"{scene.n_nodes} nodes, {scene.n_tets} tets",
            "segments": ", ".join(self.segments),
            "reference": scene.plan_text(),
            "product": "exact for rigid plans" if self.is_exact else how,
        }
        return listing(f"PlanningModel {self.patient.name!r}", rows)

    @property
    def segments(self) -> tuple[str, ...]:
        """The segments that a plan may move."""
        return self.columns.segments

    @cached_property
    def is_exact(self) -> bool:
        """Whether the product is exact for every plan: no tissue slides, or is lifted."""
        segments = model_scene(self.patient, self.model).segments.values()
        lifted = self.patient.lifted
        return not any(np.size(segment.sliding) for segment in segments) and (
            lifted is None or not len(lifted.nodes)
        )

    @cached_property
    def skin_before(self) -> SurfaceData:
        """The skin before the operation, as the mesh has it."""
        return self.patient.skin

    def whole(self, plan: Motions) -> dict[str, Floats]:
        """The plan completed with every segment; segments that it does not name stay.

        Raises
        ------
        CaseError
            (also `ValueError`) A segment that the patient does not have.
        BoundaryError
            (also `ValueError`) A matrix that is not a rigid motion.
        """
        unknown = [name for name in plan if name not in self.segments]
        if unknown:
            known = ", ".join(self.segments) or "none"
            raise CaseInputError(f"the plan moves {unknown[0]!r}; segments are: {known}")
        return {
            name: rigid_matrix(plan[name], f"motion of {name!r}") if name in plan else np.eye(4)
            for name in self.segments
        }

    def displacements(self, plan: Motions) -> Floats:
        """How each vertex of the skin moves under a plan, (k, 3) mm, by one product."""
        whole = self.whole(plan)
        found = self.columns.displacements(whole)
        return found if self.correction is None else found + self.correction.displacements(whole)

    def skin(self, plan: Motions) -> SurfaceData:
        """The skin of the mesh under a plan, by one product."""
        before = self.skin_before
        vertices = before.vertices + self.displacements(plan)
        return SurfaceData(vertices, before.triangles)

    def carried(self, plan: Motions, points: ArrayLike) -> Floats:
        """How points on or near the skin move under a plan, (n, 3) mm, as `Prediction.carried`."""
        return carried_points(self.skin_before, self.displacements(plan), points)

    def face(self, plan: Motions) -> SurfaceData:
        """The face in full detail under a plan, as `Prediction.face`."""
        before = self.patient.face or self.skin_before
        vertices = before.vertices
        return SurfaceData(vertices + self.carried(plan, vertices), before.triangles)

    def solve(self, plan: Motions) -> Prediction:
        """The prediction of `predict` under a plan, solved exactly, contact included.

        Tissue is lifted off the bone as by this plan, with the factor of the reference; where that
        does not hold and free nodes (quadratic tets, another method, more sliding and lifted nodes
        than fit into memory), the equations are set up again, and solved as a single plan is.

        Raises
        ------
        ContactError, SolverError
            Contact does not converge, or the equations are not solved.
        """
        patient, solver = self._posed(plan)
        return predict_patient(patient, self.model, solver=solver)

    def solve_skin(self, plan: Motions) -> tuple[Floats, bool]:
        """What `solve` finds of the skin, (k, 3) mm, and whether contact converged."""
        patient, solver = self._posed(plan)
        scene = model_scene(patient, self.model)
        solution = solver.solve(scene_plan(scene), loads=scene.loads)
        return patient.skin_field(solution.displacements), solution.contact_converged

    def _posed(self, plan: Motions) -> tuple[PatientModel, StaticSolver]:
        """The patient under a plan, and a solver of what it holds and frees."""
        patient = self.patient.with_plan(self.whole(plan))
        lifted, scene = patient.lifted, patient.scene
        if lifted is None:
            return patient, self.solver
        held, own = (
            np.setdiff1d(lifted.nodes, lifted.free(p)) for p in (scene.plan, self.reference)
        )
        if np.array_equal(held, own):
            return patient, self.solver
        if len(self.solver.boundary.liftable):
            return patient, self.solver.holding(held)
        # A factorisation pays for many plans only.
        options = replace(scene.options, method="auto")
        patient = replace(patient, scene=replace(scene, options=options))
        return patient, solver_of(model_scene(patient, self.model), self.solver.tensors)


def planning_model(
    patient: PatientModel | Prediction,
    model: str | None = None,
    *,
    reference: Motions | None = None,
) -> PlanningModel:
    """The planning model of a patient: the face under any rigid plan.

    Parameters
    ----------
    patient : PatientModel or Prediction
        The result of `build_model`, or a prediction.
    model : str, optional
        "H", "M", "H+S" or "M+S"; default: that of the prediction, or "M+S".
    reference : mapping of str to (4, 4) float64, mm, optional
        The plan about which contact is linearised; default: the patient's own.

    Raises
    ------
    CaseError
        (also `ValueError`) No segment moves; a motion that is given vertex by vertex; kinematics
        other than linear, in which no product gives the face.
    ContactError, SolverError
        The reference plan cannot be solved, or its factorisation does not fit into memory.

    Notes
    -----
    Where the scene leaves the method open, the equations are factorised (Cholesky): every further
    plan then takes a fraction of a second. Contact is solved to 0.01 mm, or to the case's
    `contact_tolerance` if that is larger.

    Examples
    --------
    >>> import cmfsim
    >>> prediction = cmfsim.predict("case.toml")  # doctest: +SKIP
    >>> planning = cmfsim.planning_model(prediction)  # doctest: +SKIP
    >>> motion = cmfsim.rigid_motion(translation=(0, -4, 0))
    >>> planning.skin({"maxilla": motion}).vertices  # doctest: +SKIP
    """
    if isinstance(patient, Prediction):
        model = model or patient.model
        patient = patient.patient
    model = model or "M+S"
    if reference is not None:
        patient = patient.with_plan(reference)
    scene = model_scene(patient, model)
    _check_scene(scene)
    own = scene.options
    options = replace(
        own,
        method="cholesky" if own.method == "auto" else own.method,
        contact_tolerance=max(own.contact_tolerance, CONTACT_TOLERANCE),
    )
    scene = replace(scene, options=options)
    patient = replace(patient, scene=replace(patient.scene, options=options))
    solver = _solver(scene, patient.lifted)
    plan = scene_plan(scene)
    operator = solver.plan_operator(nodes=patient.skin_nodes, plan=plan)
    motions: dict[str, NDArray[np.float64]] = {
        name: np.asarray(scene.plan[name], dtype=np.float64) for name in scene.segments
    }
    columns = plan_columns(operator)
    end = patient.skin_end
    columns = replace(
        columns, matrix=end.continued(columns.matrix), offset=end.continued(columns.offset)
    )
    return PlanningModel(patient, model, solver, columns, motions)


def _solver(scene: Scene, lifted: LiftedTissue | None) -> StaticSolver:
    """The solver of a scene, and where it can of those of all plans, whatever they lift."""
    tensors = scene_tensors(scene)
    options = scene.options
    if lifted is not None and options.method == "cholesky" and options.element != "p2":
        # Too many nodes, or too little memory: plans that lift others are then solved on their own.
        with contextlib.suppress(SolverError):
            return solver_of(scene, tensors, (lifted.nodes, lifted.segment))
    return solver_of(scene, tensors)


def _check_scene(scene: Scene) -> None:
    """Refuses a scene of which no product gives the face."""
    if scene.options.kinematics != "linear":
        raise CaseInputError(
            f"the case has {scene.options.kinematics} kinematics, for which the face is not a "
            'matrix product: set kinematics = "linear", or predict each plan'
        )
    if not scene.segments:
        raise CaseInputError("no bone segment moves: add an osteotomy or a plan to the case")
    for name, motion in scene.plan.items():
        if isinstance(motion, MovedSurface) or np.shape(motion) != (4, 4):
            raise CaseInputError(
                f"segment {name!r} moves vertex by vertex: a planning model needs rigid motions; "
                "give it translation, angle, axis and centre, or a transform"
            )
