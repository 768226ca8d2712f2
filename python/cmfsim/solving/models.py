"""The face that one of the four models predicts for a patient, and where its skin is torn."""

import hashlib
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim._core import MassTensors, Solution, StaticSolver, rigid_fit
from cmfsim.errors import CaseInputError
from cmfsim.solving.simulation import scene_tensors, solved_scene, solver_of, told
from cmfsim.values.checks import Floats, check_one_of
from cmfsim.values.clinical_motion import clinical_motion
from cmfsim.values.finding import Finding
from cmfsim.values.motion import decompose_motion, plan_digits
from cmfsim.values.patient_model import PatientModel
from cmfsim.values.prediction import MODELS, Prediction
from cmfsim.values.scene import Scene, SegmentData
from cmfsim.values.surface_data import MovedSurface, SurfaceData, area_vectors

# Skin fails in tension at a stretch of about 1.5 (Ní Annaidh et al. 2012: 54 % ± 17 % at failure).
MOST_STRETCH = 1.5
# Edges that lengthen by less, mm, and triangles of less area, mm², are too small to be seen.
VISIBLE_LENGTH = 1.5
VISIBLE_AREA = 0.5


def model_scene(patient: PatientModel, model: str = "M+S") -> Scene:
    """The scene of a patient under one of the paper's four models.

    Homogeneous models have the patient's fat everywhere. Models without sliding move the nodes at
    teeth and mucosa with their bone segment, as those that are joined to it, and have no contact
    of the lips, with each other or with the teeth.

    Parameters
    ----------
    patient : PatientModel
    model : str
        "H", "M", "H+S" or "M+S" (Kim et al. 2010, section 3.2).

    Raises
    ------
    CaseError
        (also `ValueError`) Another name; muscles where the patient has none.

    Examples
    --------
    >>> import cmfsim
    >>> scene = cmfsim.model_scene(patient, "H+S")
    """
    check_one_of("model", model, MODELS)
    left_out = any(finding.code == "muscles-left-out" for finding in patient.findings)
    if model.startswith("M") and patient.muscles is None and not left_out:
        raise CaseInputError(
            f"model {model} needs muscles, but {patient.name!r} was built without them: add "
            "[muscles] to the case and skull landmarks"
        )
    scene = patient.scene
    if model.startswith("H"):
        scene = replace(scene, tissue=patient.fat)
    if model.endswith("+S"):
        return scene
    joined = {}
    for name, segment in scene.segments.items():
        lifted = [lip.released[name] for lip in patient.lips.values() if name in lip.released]
        nodes = np.concatenate([segment.joined, segment.sliding, *lifted])
        joined[name] = SegmentData(joined=np.unique(nodes))
    return replace(scene, segments=joined, touching=(), obstacles=())


def predict_patient(
    patient: PatientModel, model: str = "M+S", *, solver: StaticSolver | None = None
) -> Prediction:
    """The face that a model predicts for a patient who is already built.

    Parameters
    ----------
    patient : PatientModel
    model : str
        "H", "M", "H+S" or "M+S".
    solver : StaticSolver, optional
        Of `model_scene(patient, model)`, with any plan, if it already exists: a new plan then needs
        no factorisation.

    Raises
    ------
    CaseError, MeshError, MaterialError, BoundaryError, ContactError, SolverError
        As `model_scene` and `solve_scene`.

    Examples
    --------
    >>> import cmfsim
    >>> prediction = cmfsim.predict_patient(patient, "H+S")
    >>> len(prediction.skin.vertices) == len(prediction.skin_displacements)
    True
    """
    return solved_patient(patient, model, solver=solver).prediction


@dataclass(frozen=True, eq=False)
class SolvedPatient:
    """A prediction with what solved it, for whoever goes on from there."""

    prediction: Prediction
    scene: Scene
    solver: StaticSolver
    solution: Solution


def solved_patient(
    patient: PatientModel,
    model: str,
    *,
    solver: StaticSolver | None = None,
    tensors: MassTensors | None = None,
) -> SolvedPatient:
    """The prediction of `predict_patient`, with its solver and solution.

    tensors: Of its mesh and tissue, if another model has them already.
    """
    scene = model_scene(patient, model)
    begun = time.perf_counter()
    solver = solver or solver_of(scene, tensors or scene_tensors(scene))
    result, solution = solved_scene(scene, solver)
    timings = {**patient.summary.get("timings", {}), "solving": time.perf_counter() - begun}
    skin = patient.skin_field(result.displacements)
    if (torn := tear_finding(patient.skin, skin)) is not None:
        noticed = [*result.summary["findings"], told(torn)]
        result = replace(result, summary={**result.summary, "findings": noticed})
    moved = np.linalg.norm(skin, axis=1)
    summary = {
        **patient.summary,
        "model": model,
        "case_key": _case_key(patient, scene),
        "plan": planned_motions(patient, scene),
        "plan_digits": plan_digits(scene.plan),
        "skin": {
            "mean": float(moved.mean()),
            "p95": float(np.percentile(moved, 95)),
            "largest": float(moved.max()),
        },
        "findings": [
            *patient.summary.get("findings", []),
            *_lip_findings(patient, model),
            *result.summary["findings"],
        ],
        "solution": dict(result.summary),
        "timings": timings,
        "left_out": _left_out(patient, scene, model),
    }
    found = Prediction(model, patient, scene, result, summary, predicted_by=predict_patient)
    return SolvedPatient(found, scene, solver, solution)


def _case_key(patient: PatientModel, scene: Scene) -> str:
    """The key of what a prediction belongs to, the same for all models of a patient and plan.

    Beyond the key of the case's files it is that of mesh and motions, since a patient may be given
    another plan in memory.
    """
    digest = hashlib.sha256(str(patient.summary.get("inputs_key", "")).encode())
    for name, array in _arrays(scene):
        values = np.ascontiguousarray(array)
        digest.update(f"{name} {values.dtype.str} {values.shape}\n".encode())
        digest.update(values.tobytes())
    return digest.hexdigest()


def _arrays(scene: Scene) -> Iterator[tuple[str, NDArray[Any]]]:
    """Mesh and motions of a scene, each with its name."""
    yield "nodes", scene.nodes
    yield "tets", scene.tets
    for name, motion in scene.plan.items():
        if isinstance(motion, MovedSurface):
            yield f"surface of {name}", motion.surface.vertices
            yield f"moved {name}", motion.moved_vertices
        else:
            yield f"motion of {name}", motion


def planned_motions(patient: PatientModel, scene: Scene) -> dict[str, dict[str, Any]]:
    """The motions of a scene by segment, in a planner's numbers and in a surgeon's."""
    return {name: _motion(patient, scene, name) for name in scene.plan}


def _motion(patient: PatientModel, scene: Scene, name: str) -> dict[str, Any]:
    """A segment's motion in a planner's numbers, and in a surgeon's.

    A planner's are those about the segment's own centre (paper, Table 2).
    """
    motion = scene.plan[name]
    if isinstance(motion, MovedSurface) or np.shape(motion) == (4, 4):
        vertices = patient.segment_vertices(name)
    else:
        vertices = scene.nodes[scene.segments[name].joined]
    clinical = clinical_motion(
        name,
        motion,
        landmarks=patient.landmarks.get("skull"),
        vertices=vertices,
        source=patient.summary.get("plan_sources", {}).get(name, ""),
    ).as_dict()
    if isinstance(motion, MovedSurface):
        here, there = motion.surface.vertices, motion.moved_vertices
        size = np.linalg.norm(there - here, axis=1)
        fit = rigid_fit(here, there)
        return {
            "mean": float(size.mean()),
            "largest": float(size.max()),
            # The nearest rigid motion, and what it leaves of the vertices' own.
            **_rigid_numbers(fit.matrix, here.mean(axis=0)),
            "bending": float(fit.rms),
            "clinical": clinical,
        }
    if motion.shape != (4, 4):
        size = np.linalg.norm(motion, axis=1)
        return {"mean": float(size.mean()), "largest": float(size.max()), "clinical": clinical}
    return {**_rigid_numbers(motion, vertices.mean(axis=0)), "clinical": clinical}


def _rigid_numbers(matrix: NDArray[np.float64], centre: NDArray[np.float64]) -> dict[str, Any]:
    parts = decompose_motion(matrix, centre)
    return {
        "translation": parts.translation.tolist(),
        "angle": parts.angle,
        "axis": parts.axis.tolist(),
        "centre": parts.centre.tolist(),
    }


def _lip_findings(patient: PatientModel, model: str) -> list[dict[str, str]]:
    """That separate lips do not touch, in a model without contact."""
    if not patient.lips or model.endswith("+S"):
        return []
    found = Finding(
        "lips-contact",
        f"the lips are separate, but model {model} has no contact between them",
        severity="warning",
        where="[lips]",
        why="each lip follows its teeth, so the lips may pass through each other, which is "
        "impossible if they are one piece",
        fix=f"use model {model}+S, or set contact = false in [lips]",
    )
    return [told(found)]


def _left_out(patient: PatientModel, scene: Scene, model: str) -> list[str]:
    """What the scene did not need, as sentences."""
    left = []
    if model.startswith("H"):
        left.append("muscles: the model is homogeneous")
    elif patient.fraction is not None:
        share = float(np.mean(patient.fraction == 0.0))
        left.append(f"muscle law: {100 * share:.0f} % of the tets contain no muscle and are fat")
    if not any(np.size(segment.sliding) for segment in scene.segments.values()):
        left.append("contact: no node slides")
    still = [name for name, motion in scene.plan.items() if _stays(motion)]
    if still:
        left.append(f"motion: {', '.join(still)} stay")
    return left


def _stays(motion: Floats | MovedSurface) -> bool:
    return not isinstance(motion, MovedSurface) and np.array_equal(motion, np.eye(4))


def tear_finding(skin: SurfaceData, displacements: Floats) -> Finding | None:
    """The warning, "skin-torn", that displacements (v, 3), mm, tear a skin or fold it over.

    An edge counts as torn if it is stretched by more than half, and becomes longer by at least
    1.5 mm; a triangle as turned over if its normal turns by more than a right angle, and if it has
    at least 0.5 mm² before the operation.
    """
    before, triangles = skin.vertices, skin.triangles.astype(np.int64)
    after = before + displacements
    ends = np.sort(np.concatenate([triangles[:, [k, (k + 1) % 3]] for k in range(3)]), axis=1)
    # As one number each: rows would be sorted twenty times as slowly.
    edges = np.column_stack(np.divmod(np.unique(ends @ [len(before), 1]), len(before)))
    rest, now = (np.linalg.norm(np.subtract(*v[edges.T]), axis=1) for v in (before, after))
    torn = (now > MOST_STRETCH * rest) & (now - rest > VISIBLE_LENGTH)
    one, other = (area_vectors(v, triangles) for v in (before, after))
    turned = (np.einsum("ta,ta->t", one, other) < 0.0) & (
        np.linalg.norm(one, axis=1) > VISIBLE_AREA
    )
    if not torn.any() and not turned.any():
        return None
    facts = []
    if turned.any():
        count = int(turned.sum())
        facts.append(f"{count} {'triangle is' if count == 1 else 'triangles are'} turned over")
        worst = int(np.argmax(np.where(turned, np.linalg.norm(one, axis=1), 0.0)))
        place = before[triangles[worst]].mean(axis=0)
    if torn.any():
        count = int(torn.sum())
        longer = np.where(torn, now - rest, 0.0)
        worst = int(longer.argmax())
        place = before[edges[worst]].mean(axis=0)
        facts.insert(
            0,
            f"{count} {'edge' if count == 1 else 'edges'} of the predicted skin "
            f"{'is' if count == 1 else 'are'} stretched by more than half (worst: from "
            f"{rest[worst]:.1f} to {now[worst]:.1f} mm)",
        )
    else:
        facts[0] += " in the predicted skin"
    return Finding(
        "skin-torn",
        ", and ".join(facts),
        where=f"about ({place[0]:.0f}, {place[1]:.0f}, {place[2]:.0f}) mm",
    )
