"""The muscles of a patient: a template carried to the skull, and its share in each tet."""

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace

from cmfsim._core import TetMesh
from cmfsim.muscles.blurring import blurred
from cmfsim.muscles.equivalent import (
    MODULI_CODES,
    PreparedMuscles,
    equivalent_material,
    prepared_muscles,
)
from cmfsim.muscles.template.muscle_template import (
    MorphedMusculature,
    MuscleTemplate,
    too_few,
    without_lost,
)
from cmfsim.values.case_parts import CaseMuscles
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding
from cmfsim.values.moduli import FatModuli
from cmfsim.values.patient_model import PatientModel


@dataclass(frozen=True, eq=False)
class PlacedMuscles:
    """A template's muscles in a head, what a mesh is sampled by, and the seconds of each step."""

    muscles: MorphedMusculature
    prepared: PreparedMuscles
    seconds: Mapping[str, float]


@dataclass(frozen=True)
class NoMuscles:
    """Why no muscle of a template can be placed in a head."""

    findings: tuple[Finding, ...]


def placed_muscles(given: CaseMuscles, skull: Mapping[str, Floats]) -> PlacedMuscles | NoMuscles:
    """The muscles that a case's skull landmarks place in a head, with findings on the others.

    Raises `LandmarkError`: The landmarks do not fit the template's.
    Raises `CaseError`: There is no such template.
    """
    begun = time.perf_counter()
    template = MuscleTemplate.load(given.template)
    few = too_few(template, skull)
    if few is not None:
        return NoMuscles((few,))
    muscles = without_lost(template.morph(skull, smoothing=given.smoothing))
    if not muscles.muscles:
        return NoMuscles(muscles.findings)
    seconds = {"placing the muscles": time.perf_counter() - begun}
    begun = time.perf_counter()
    prepared = prepared_muscles(muscles)
    seconds["preparing the muscles"] = time.perf_counter() - begun
    return PlacedMuscles(muscles, prepared, seconds)


def with_muscles(
    patient: PatientModel,
    given: CaseMuscles,
    *,
    landmarks: Mapping[str, Floats] | None = None,
    mesh: TetMesh | None = None,
    placed: Callable[[], PlacedMuscles | NoMuscles] | None = None,
) -> PatientModel:
    """The patient with a template's muscles and their equivalent material (paper 2.2, 2.3).

    Parameters
    ----------
    patient : PatientModel
    given : CaseMuscles
    landmarks : mapping of str to (3,) float64, mm, optional
        Instead of the patient's own skull landmarks, as for a trial of their error.
    mesh : TetMesh, optional
        That of the patient's scene, if the caller already has it.
    placed : callable, optional
        Returns the muscles in the head, if the caller places them in parallel with other work; only
        the time spent waiting for them counts in the timings.

    Raises
    ------
    LandmarkError
        (also `ValueError`) The patient has no skull landmarks, or they do not fit the template's.
    CaseError
        (also `ValueError`) There is no such template; the patient's fat is not uniform.
    MaterialError
        (also `ValueError`) Moduli for a muscle that the template does not have.

    Examples
    --------
    >>> import cmfsim
    >>> patient = cmfsim.with_muscles(patient, cmfsim.CaseMuscles())
    """
    begun = time.perf_counter()
    skull = patient.landmarks.get("skull", {}) if landmarks is None else landmarks
    found = placed_muscles(given, skull) if placed is None else placed()
    if isinstance(found, NoMuscles):
        findings = tuple(dict.fromkeys([*patient.findings, *found.findings]))
        summary = {**patient.summary, "findings": [asdict(finding) for finding in findings]}
        return replace(patient, findings=findings, summary=summary)
    muscles, timings = found.muscles, dict(found.seconds)
    if placed is not None:
        timings = {"placing the muscles": time.perf_counter() - begun}
    begun = time.perf_counter()
    scene = patient.scene
    mesh = TetMesh(scene.nodes, scene.tets) if mesh is None else mesh
    mixture = equivalent_material(
        mesh,
        found.prepared,
        preset=given.preset,
        mixing=given.mixing,
        samples=given.samples,
        seed=given.seed,
        moduli=replace(given.moduli, fat=FatModuli.of(patient.fat)),
    )
    fraction, fibre, tissue = blurred(
        mesh, mixture.fraction, mixture.fibre, mixture.tissue_data, given.blur
    )
    timings["sampling the muscles"] = time.perf_counter() - begun
    # What the doctor found already has the line of the case.
    repeated = {"template-landmarks-missing", *MODULI_CODES}
    known = {f.code for f in patient.findings} & repeated
    more = [f for f in (*muscles.findings, *mixture.findings) if f.code not in known]
    findings = tuple(dict.fromkeys([*patient.findings, *more]))
    summary = {
        **patient.summary,
        "timings": {**patient.summary.get("timings", {}), **timings},
        "findings": [asdict(finding) for finding in findings],
        "muscles": {**asdict(given), "template": str(given.template), **mixture.summary},
    }
    return replace(
        patient,
        scene=replace(scene, tissue=tissue),
        muscles=muscles,
        fraction=fraction,
        fibre=fibre,
        findings=findings,
        summary=summary,
    )
