"""The muscles of a patient: a template carried to the skull, and its share in each tet."""

import time
from collections.abc import Mapping
from dataclasses import asdict, replace

from cmfsim._core import TetMesh
from cmfsim.checks import Floats
from cmfsim.errors import LandmarkInputError
from cmfsim.muscles.equivalent import equivalent_material
from cmfsim.muscles.fitting import fit_muscles
from cmfsim.muscles.mixing import MODULI_CODES
from cmfsim.muscles.template import MuscleTemplate
from cmfsim.values.case_parts import CaseMuscles
from cmfsim.values.moduli import FatModuli
from cmfsim.values.patient_model import PatientModel

__all__ = ["with_muscles"]


def with_muscles(
    patient: PatientModel,
    given: CaseMuscles,
    *,
    landmarks: Mapping[str, Floats] | None = None,
    mesh: TetMesh | None = None,
) -> PatientModel:
    """The patient with a template's muscles and their equivalent material (paper 2.2, 2.3).

    Parameters
    ----------
    patient : PatientModel
    given : CaseMuscles
    landmarks : mapping of str to (3,) float64, mm, optional
        Instead of the patient's own skull landmarks, as for a trial of their error.
    mesh : TetMesh, optional
        That of the patient's scene, where the caller has it already.

    Returns
    -------
    PatientModel

    Raises
    ------
    LandmarkError
        (also `ValueError`) The patient has no skull landmarks, or they do not fit the template's.
    CaseError
        (also `ValueError`) There is no such template; the patient's fat is not one fat.
    MaterialError
        (also `ValueError`) Moduli for a muscle that the template has not.

    Examples
    --------
    >>> import cmfsim
    >>> patient = cmfsim.with_muscles(patient, cmfsim.CaseMuscles())  # doctest: +SKIP
    """
    skull = patient.landmarks.get("skull") if landmarks is None else landmarks
    if not skull:
        raise LandmarkInputError(
            f"{patient.name}: muscles are placed from skull landmarks, and the case has none: add "
            "[landmarks] skull, or take a homogeneous model"
        )
    begun = time.perf_counter()
    muscles = MuscleTemplate.load(given.template).morph(skull, smoothing=given.smoothing)
    placed = time.perf_counter()
    fit = fit_muscles(muscles, patient.anatomy) if given.fit else None
    # A head in which muscles lie right already is left alone.
    helps = fit is not None and fit.helps
    if fit is not None and helps:
        muscles = fit.musculature
    fitted = time.perf_counter()
    scene = patient.scene
    mixture = equivalent_material(
        TetMesh(scene.nodes, scene.tets) if mesh is None else mesh,
        muscles,
        preset=given.preset,
        mixing=given.mixing,
        samples=given.samples,
        seed=given.seed,
        moduli=replace(given.moduli, fat=FatModuli.of(patient.fat)),
    )
    timings = {
        **patient.summary.get("timings", {}),
        "placing the muscles": placed - begun,
        "sampling the muscles": time.perf_counter() - fitted,
    }
    if fit is not None:
        timings["fitting the muscles"] = fitted - placed
    # What the doctor found already has the line of the case.
    repeated = {"template-landmarks-missing", *MODULI_CODES}
    known = {f.code for f in patient.findings} & repeated
    more = [f for f in (*muscles.findings, *mixture.findings) if f.code not in known]
    findings = tuple(dict.fromkeys([*patient.findings, *more]))
    summary = {
        **patient.summary,
        "timings": timings,
        "findings": [asdict(finding) for finding in findings],
        "muscles": {**asdict(given), "template": str(given.template), **mixture.summary},
        "muscle_fit": None if fit is None else {"used": helps, **fit.summary()},
    }
    return replace(
        patient,
        scene=replace(scene, tissue=mixture.tissue_data),
        muscles=muscles,
        fraction=mixture.fraction,
        fibre=mixture.fibre,
        findings=findings,
        summary=summary,
    )
