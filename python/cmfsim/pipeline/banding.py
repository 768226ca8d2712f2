"""The band around a prediction, by regions of the face whose landmarks are found if need be."""

import statistics
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim._core import StaticSolver, Surface
from cmfsim.errors import CalibrationError, CmfsimError, LandmarkInputError
from cmfsim.evaluation.conformal import calibrate
from cmfsim.evaluation.regions import skin_regions
from cmfsim.pipeline.proposing import head_surfaces, propose_landmarks
from cmfsim.solving.models import solved_patient
from cmfsim.solving.rates import SkinRates, skin_rates
from cmfsim.surfaces.depth import tissue_depth
from cmfsim.values.calibration import (
    ADDED,
    NOT_COVERED,
    BandFactor,
    Calibration,
    band_sources,
    settings_digest,
)
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding
from cmfsim.values.landmark_sites import SKIN_LANDMARKS
from cmfsim.values.patient_model import PatientModel
from cmfsim.values.prediction import Prediction
from cmfsim.values.skin_band import WHOLE_FACE, BandOptions, SkinBand


@dataclass(frozen=True)
class FaceLandmarks:
    """Landmarks that place the regions of a face: all of `SKIN_LANDMARKS`, (3,) mm, or none.

    findings: That they were proposed, or why there are none.
    """

    points: Mapping[str, Floats]
    findings: tuple[Finding, ...] = ()


def face_landmarks(patient: PatientModel) -> FaceLandmarks:
    """The skin landmarks that place the regions of a patient's face.

    Those of the case where it has all of them; else they are proposed on its surfaces, which takes
    a few seconds. Proposed ones place regions, and nothing else: no distance depends on them.
    """
    known = patient.landmarks.get("skin", {})
    if patient.landmarks_are_found:
        errors = {
            name: site["error"] for name, site in patient.summary["landmarks"]["skin"].items()
        }
        return _proposed(known, errors)
    if all(name in known for name in SKIN_LANDMARKS):
        return FaceLandmarks(known)
    try:
        found = propose_landmarks(*head_surfaces(patient.anatomy)).skin
    except CmfsimError as error:
        return FaceLandmarks({}, (_none(str(error)),))
    points = {name: site.point for name, site in found.items()}
    return _proposed(points, {name: site.error for name, site in found.items()})


def _proposed(points: Mapping[str, Floats], errors: Mapping[str, float]) -> FaceLandmarks:
    """Proposed points, with what to know of them; none where one is missing."""
    missing = [name for name in SKIN_LANDMARKS if name not in points]
    if missing:
        return FaceLandmarks({}, (_none(f"{', '.join(missing)} were not found"),))
    worst = max(errors[name] for name in SKIN_LANDMARKS)
    note = Finding(
        "regions-none",
        "regions of the face are placed by proposed landmarks, each with an expected error of "
        f"up to {worst:.1f} mm",
        where="landmarks.skin",
        why="The case has no complete skin landmarks. The borders between regions are equally "
        "uncertain.",
    )
    return FaceLandmarks({name: points[name] for name in SKIN_LANDMARKS}, (note,))


def _none(reason: str) -> Finding:
    return Finding(
        "regions-none", f"the face is not divided into regions: {reason}", where="landmarks.skin"
    )


def face_motion(prediction: Prediction) -> dict[str, float]:
    """How far the skin of the face moves on average, "face_mean", mm; empty without landmarks."""
    known = prediction.patient.landmarks.get("skin", {})
    if any(name not in known for name in SKIN_LANDMARKS):
        return {}
    try:
        face = skin_regions(prediction.skin_before.vertices, known)["face"]
    except LandmarkInputError:
        return {}
    moved = np.linalg.norm(prediction.skin_displacements[face], axis=1)
    return {"face_mean": float(moved.mean())} if len(moved) else {}


# Regions of `skin_regions` that a band holds simultaneously, each by itself.
BAND_REGIONS = (WHOLE_FACE, "nose", "upper lip", "lower lip", "chin", "left cheek", "right cheek")
# Noses and necks, which are deeper, do not become thicker as cheeks do, mm.
THICKEST = 12.0


def predict_with_band(
    patient: PatientModel,
    model: str = "M+S",
    options: BandOptions | None = None,
    *,
    solver: StaticSolver | None = None,
) -> Prediction:
    """The face that a model predicts for a patient, with the band around it.

    Parameters
    ----------
    patient : PatientModel
    model : str
        "H", "M", "H+S" or "M+S".
    options : BandOptions, optional
        Default: 90 %, uncalibrated.
    solver : StaticSolver, optional
        As for `predict_patient`.

    Returns
    -------
    Prediction
        With `band`.

    Raises
    ------
    CalibrationError
        (also `ValueError`) The calibration belongs to another model, to other settings or another
        coverage, is too small for the coverage, or has no region of this face.
    CaseError
        (also `ValueError`) Kinematics that are not linear; lips in contact.
    CmfsimError
        As `predict_patient`.

    Notes
    -----
    The standard deviation at a vertex is √Σ(n·∂u/∂p σ_p)² over tissue and plan, plus the sources
    that act along the normal n without a solve: change of thickness, segmentation, scan noise.

    Examples
    --------
    >>> import cmfsim
    >>> prediction = cmfsim.predict_with_band(patient, "M+S")  # doctest: +SKIP
    >>> prediction.band.state, prediction.band.half_width.mean()  # doctest: +SKIP
    ('uncalibrated', 1.3)
    """
    options = options or BandOptions()
    options.check((model,))
    solved = solved_patient(patient, model, solver=solver)
    begun = time.perf_counter()
    rates = skin_rates(patient, solved.scene, solved.solver, solved.solution)
    band = _band(solved.prediction, rates, options)
    seconds = time.perf_counter() - begun
    summary = dict(solved.prediction.summary)
    summary["timings"] = {**summary["timings"], "band": seconds}
    band = replace(band, about={**band.about, "seconds": seconds})
    summary["band"] = band.as_dict()
    return replace(solved.prediction, summary=summary, band=band)


def band_settings(prediction: Prediction) -> dict[str, Any]:
    """The settings on which the band of a prediction depends besides its case, as plain values.

    Predictions with equal settings may calibrate one another. The edge length is not included: use
    a convergence study to find the effect of a coarser mesh.

    Examples
    --------
    >>> import cmfsim
    >>> settings = cmfsim.band_settings(prediction)  # doctest: +SKIP
    """
    options = prediction.scene.options
    used = prediction.patient.summary.get("muscles", {})
    muscles = {}
    if prediction.model.startswith("M"):
        muscles = {name: used.get(name) for name in ("mixing", "moduli")}
    tissue = prediction.patient.fat
    fat = {name: value.tolist() for name, value in tissue.arrays().items()}
    if tissue.kind == "preset":
        fat["preset"] = tissue.preset
    return {
        "model": prediction.model,
        "element": options.element,
        "kinematics": options.kinematics,
        "contact": options.contact if prediction.model.endswith("+S") else "none",
        "fat": {"kind": tissue.kind, **fat},
        **muscles,
        "plan": "achieved" if "achieved" in prediction.patient.summary else "planned",
        "sources": band_sources(),
    }


def band_regions(patient: PatientModel) -> dict[str, NDArray[np.bool_]]:
    """The vertices of a patient's skin in each region of a band.

    They are placed on the skin before the operation, as those of an evaluation, by the skin
    landmarks of the case or by proposed ones; empty if there are neither.

    Returns
    -------
    dict of str to (k,) bool

    Examples
    --------
    >>> import cmfsim
    >>> regions = cmfsim.band_regions(patient)  # doctest: +SKIP
    >>> regions["upper lip"].sum()  # doctest: +SKIP
    """
    return _placed(patient, face_landmarks(patient))


def _placed(patient: PatientModel, landmarks: FaceLandmarks) -> dict[str, NDArray[np.bool_]]:
    if not landmarks.points:
        return {}
    found = skin_regions(patient.skin.vertices, landmarks.points)
    return {name: found[name] for name in BAND_REGIONS if found[name].any()}


def _band(prediction: Prediction, rates: SkinRates, options: BandOptions) -> SkinBand:
    skin = prediction.skin
    normals = Surface(skin.vertices, skin.triangles).vertex_normals
    parts: dict[str, Floats] = {
        name: np.einsum("ka,ka->k", normals, rate) for name, rate in rates.rates.items()
    }
    bones = [segment.surface for segment in prediction.patient.segments]
    depth = tissue_depth(prediction.skin_before.vertices, bones)
    depth = np.minimum(depth, THICKEST)
    for source in ADDED:
        scale = depth if source.unit == "share" else np.ones(len(depth))
        parts[source.name] = source.sd * scale
    sd = np.sqrt(sum(np.square(part) for part in parts.values()))
    landmarks = face_landmarks(prediction.patient)
    settings, regions = band_settings(prediction), _placed(prediction.patient, landmarks)
    factors: Mapping[str, BandFactor] = {}
    if options.calibration is not None:
        _check_settings(options.calibration, settings)
        factors = _factors(options.calibration, options, regions)
    sources = {**rates.sources, **{source.name: source for source in ADDED}}
    return SkinBand(
        coverage=options.coverage,
        sd=sd,
        parts=parts,
        regions=regions,
        factors=factors,
        plain_factor=statistics.NormalDist().inv_cdf(0.5 * (1.0 + options.coverage)),
        settings=settings,
        about={
            "sources": {name: source.as_dict() for name, source in sources.items()},
            "not_covered": [*rates.left_out, *NOT_COVERED],
            "notes": [finding.what for finding in landmarks.findings],
            "calibration": _calibration_values(options),
        },
    )


def _calibration_values(options: BandOptions) -> dict[str, Any] | None:
    found = options.calibration
    if found is None:
        return None
    return {
        "file": options.source,
        "note": found.note,
        "group": options.group,
        "n": len([c for c in found.cases if options.group in (None, c.group)]),
        "settings_digest": found.digest,
    }


def _check_settings(calibration: Calibration, settings: Mapping[str, Any]) -> None:
    if calibration.digest == settings_digest(settings):
        return
    theirs = calibration.settings
    differing = [
        f"{name} is {_shown(theirs.get(name))} there and {_shown(settings.get(name))} here"
        for name in sorted(set(theirs) | set(settings))
        if theirs.get(name) != settings.get(name)
    ]
    raise CalibrationError(
        f"the calibration was made under other settings: {'; '.join(differing)}; calibrate with "
        "cases that were predicted with the settings of this prediction"
    )


def _shown(value: object) -> str:
    return "missing" if value is None else f"{value!r:.120}"


def _factors(
    calibration: Calibration, options: BandOptions, regions: Mapping[str, NDArray[np.bool_]]
) -> dict[str, BandFactor]:
    if not regions:
        raise CalibrationError(
            "a calibrated band needs the regions of the face, but the case has no skin "
            f"landmarks to place them: add {', '.join(SKIN_LANDMARKS)} to [landmarks], or let "
            "cmfsim landmarks propose them"
        )
    if options.group is not None and options.group not in calibration.groups:
        known = ", ".join(repr(group) for group in calibration.groups)
        raise CalibrationError(f"the calibration has no group {options.group!r}; it has: {known}")
    missing = [name for name in regions if name not in calibration.regions]
    if missing:
        raise CalibrationError(
            f"the calibration has no score of {', '.join(missing)}; it has: "
            f"{', '.join(calibration.regions)}"
        )
    found = {}
    for name in regions:
        try:
            found[name] = calibrate(calibration.scores(name, options.group), options.coverage)
        except CalibrationError as error:
            raise CalibrationError(f"region {name}: {error}") from error
    return found
