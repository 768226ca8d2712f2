"""One case from its files to the predicted face."""

import logging
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

from cmfsim.errors import CaseInputError, CmfsimError, ContactError, SolverError
from cmfsim.io import Case, CaseOrPath, as_case
from cmfsim.pipeline.building.case_model import model_of
from cmfsim.pipeline.building.inputs import case_key, input_hashes, plan_key
from cmfsim.pipeline.building.stages import BuildOptions, OnMuscles
from cmfsim.pipeline.building.surgery.postoperative import Postoperative
from cmfsim.solving.models import predict_patient
from cmfsim.values.anatomy import Anatomy
from cmfsim.values.band_options import BandOptions
from cmfsim.values.case_parts import CaseMuscles
from cmfsim.values.checks import check_one_of
from cmfsim.values.finding import Finding, OnFindings
from cmfsim.values.patient_model import PatientModel
from cmfsim.values.prediction import MODELS, Prediction
from cmfsim.values.progress import ProgressOrBar, expected_stages, shown_progress

_log = logging.getLogger(__name__)


def predict(
    case: CaseOrPath,
    *,
    model: str = "M+S",
    progress: ProgressOrBar = None,
    check: bool = True,
    band: BandOptions | None = None,
) -> Prediction:
    """The face that a model predicts for a case; nothing is written.

    Models with muscles use the template of the case, or the built-in one if the case names none.

    Parameters
    ----------
    case : Case, or path of its file or folder
    model : str
        "H", "M", "H+S" or "M+S" (Kim et al. 2010, section 3.2): homogeneous or with muscles,
        without or with sliding at teeth and mucosa.
    progress : callable or bool, optional
        Called with the name of each stage as it begins; True shows a bar (tqdm).
    check : bool
        Whether the doctor checks the case first; an error that it finds ends the work.
    band : BandOptions, optional
        Adds a band around the face, as the prediction's `band`.

    Returns
    -------
    Prediction

    Raises
    ------
    CmfsimError
        (also `ValueError` where the input is at fault) What a stage cannot work with.

    Examples
    --------
    >>> import cmfsim
    >>> prediction = cmfsim.predict(cmfsim.Case.load("case.toml"), model="M+S")  # doctest: +SKIP
    >>> prediction.skin.vertices.shape  # doctest: +SKIP
    (19840, 3)
    """
    # To its end: a bar then ends full.
    (found,) = predict_models(case, model, progress=progress, check=check, band=band)
    return found


def predict_models(  # noqa: PLR0913 (options by name)
    case: CaseOrPath,
    models: str | Sequence[str] = MODELS,
    *,
    progress: ProgressOrBar = None,
    check: bool = True,
    findings: Iterable[Finding] = (),
    anatomy: Anatomy | None = None,
    after: Postoperative | None = None,
    failed: dict[str, CmfsimError] | None = None,
    on_findings: OnFindings | None = None,
    on_muscles: OnMuscles | None = None,
    band: BandOptions | None = None,
) -> Iterator[Prediction]:
    """The predictions of several models for one case, which is built once.

    Parameters
    ----------
    case : Case, or path of its file or folder
    models : str or sequence of str
    progress : callable or bool, optional
    check : bool
        As for `predict`.
    findings : iterable of Finding
        What is known of the case already.
    anatomy : Anatomy, optional
        The head, where it is known; the image or surfaces of the case are then not read.
    after : Postoperative, optional
        The post-operative data, if they were already read.
    failed : dict, optional
        If given, a model that cannot be solved (for example, because contact does not converge) is
        recorded here with its error, and the others continue.
    on_findings : callable, optional
        Called with new findings of each stage and each solution.
    on_muscles : callable, optional
        Called with the muscles and the segments of bone once both are known, and perhaps again
        before any model is solved.
    band : BandOptions, optional
        As for `predict`.

    Yields
    ------
    Prediction
        One at a time, as each is solved.

    Raises
    ------
    CmfsimError
        As `predict`.

    Examples
    --------
    >>> import cmfsim
    >>> for prediction in cmfsim.predict_models(case, ["H", "M+S"]):  # doctest: +SKIP
    ...     print(prediction.model, prediction.result.summary["residual"])
    """
    case, models = as_case(case), named_models(models)
    expected = expected_stages(*(f"solving {model}" for model in models))
    with shown_progress(progress, expected) as shown:
        options = BuildOptions(
            progress=shown,
            check=check,
            findings=findings,
            anatomy=anatomy,
            after=after,
            on_findings=on_findings,
            on_muscles=on_muscles,
        )
        yield from predictions_of(case, models, options, failed, band=band)


def predictions_of(
    case: Case,
    models: Sequence[str],
    options: BuildOptions,
    failed: dict[str, CmfsimError] | None = None,
    *,
    band: BandOptions | None = None,
) -> Iterator[Prediction]:
    """The predictions of several models for one case, as `predict_models` makes them."""
    if band is not None:
        # Before a case is built for a minute.
        band.check(models)
    patient = build_patient(case, models, options)
    if options.on_muscles is not None and patient.muscles is not None:
        options.on_muscles(patient.muscles, patient.segments)
    known = set(patient.findings)
    for model in models:
        if options.progress is not None:
            options.progress(f"solving {model}")
        try:
            if band is None:
                prediction = predict_patient(patient, model)
            else:
                # Regions and proposed landmarks: a prediction without a band does not load them.
                from cmfsim.pipeline.banding import predict_with_band  # noqa: PLC0415

                prediction = predict_with_band(patient, model, band)
        except (ContactError, SolverError) as error:
            if failed is None:
                raise
            _log.warning("model %s: %s", model, error)
            failed[model] = error
        else:
            new = [finding for finding in prediction.findings if finding not in known]
            if new and options.on_findings is not None:
                options.on_findings(new)
            known.update(new)
            yield prediction


def named_models(models: str | Sequence[str]) -> tuple[str, ...]:
    """Models by name, each once, in the order given.

    Raises
    ------
    CaseError
        (also `ValueError`) None, or another name: with the one that was meant, it seems.
    """
    named = (models,) if isinstance(models, str) else tuple(dict.fromkeys(models))
    if not named:
        raise CaseInputError(f"no model is named: give one or more of {', '.join(MODELS)}")
    for model in named:
        meant = model.strip().upper() if isinstance(model, str) else None
        if model not in MODELS and meant in MODELS:
            raise CaseInputError(f"model is {model!r}: did you mean {meant!r}?")
        check_one_of("model", model, MODELS)
    return named


def case_for_models(case: Case, models: Sequence[str]) -> Case:
    """The case as models need it: with muscles, if one of them has muscles, and only then."""
    if not any(model.startswith("M") for model in models):
        return replace(case, muscles=None)
    return case if case.muscles is not None else replace(case, muscles=CaseMuscles())


def build_patient(
    case: CaseOrPath, models: Sequence[str], options: BuildOptions | None = None
) -> PatientModel:
    """The patient as models need it: muscles are placed if one of them has muscles.

    Raises
    ------
    CaseError
        (also `ValueError`) A file of the case changed while the work went on.
    """
    case, options = as_case(case), options or BuildOptions()
    # Before the files are read: the key must be that of what is built.
    hashes = input_hashes(case)
    key, about = case_key(case, hashes), plan_key(case)
    patient = model_of(case_for_models(case, models), options)
    if options.on_findings is not None:
        options.on_findings(patient.findings)
    for name, found in patient.summary["inputs"].items():
        if hashes.get(name, found) != found:
            raise CaseInputError(
                f"{name}: changed while the case was running; run the case again when no other "
                "program writes to this file"
            )
    return replace(patient, summary={**patient.summary, "inputs_key": key, "plan_key": about})
