"""One case from its files to the predicted face."""

import logging
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from cmfsim.errors import CaseInputError, ContactError, SolverError
from cmfsim.io import Case, CaseOrPath, as_case
from cmfsim.pipeline.building.case_model import model_of
from cmfsim.pipeline.building.inputs import case_key, input_hashes, plan_key
from cmfsim.pipeline.building.stages import BuildKeywords, BuildOptions, build_options
from cmfsim.solving.models import predict_patient
from cmfsim.values.band_options import BandOptions
from cmfsim.values.case_parts import CaseMuscles
from cmfsim.values.checks import check_one_of
from cmfsim.values.patient_model import PatientModel
from cmfsim.values.prediction import MODELS, Prediction
from cmfsim.values.progress import expected_stages

if TYPE_CHECKING:
    from typing_extensions import Unpack

_log = logging.getLogger(__name__)


def predict(
    case: CaseOrPath,
    *,
    model: str = "M+S",
    band: BandOptions | None = None,
    **options: "Unpack[BuildKeywords]",
) -> Prediction:
    """The face that a model predicts for a case; nothing is written.

    Models with muscles use the template of the case, or the built-in one if the case names none.

    Parameters
    ----------
    case : Case, or path of its file or folder
    model : str
        "H", "M", "H+S" or "M+S" (Kim et al. 2010, section 3.2): homogeneous or with muscles,
        without or with sliding at teeth and mucosa.
    band : BandOptions, optional
        Adds a band around the face, as the prediction's `band`.
    **options
        Those of `BuildOptions`: `progress`, called with the name of each stage as it begins,
        or True for a bar; `check`, whether the doctor checks the case first; and others.

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
    for found in [*predict_models(case, model, band=band, **options)]:
        return found
    raise SolverError(f"model {model} could not be solved, as the observer was told")


def predict_models(
    case: CaseOrPath,
    models: str | Sequence[str] = MODELS,
    *,
    band: BandOptions | None = None,
    **options: "Unpack[BuildKeywords]",
) -> Iterator[Prediction]:
    """The predictions of several models for one case, which is built once.

    Parameters
    ----------
    case : Case, or path of its file or folder
    models : str or sequence of str
    band : BandOptions, optional
    **options
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
    with build_options(options, expected) as asked:
        yield from predictions_of(case, models, asked, band=band)


def predictions_of(
    case: Case, models: Sequence[str], options: BuildOptions, *, band: BandOptions | None = None
) -> Iterator[Prediction]:
    """The predictions of several models for one case, as `predict_models` makes them."""
    if band is not None:
        # Before a case is built for a minute.
        band.check(models)
    patient = build_patient(case, models, options)
    if patient.muscles is not None:
        options.observer.muscles(patient.muscles, patient.segments)
    known = set(patient.findings)
    for model in models:
        options.observer.stage(f"solving {model}")
        try:
            if band is None:
                prediction = predict_patient(patient, model)
            else:
                # Regions and proposed landmarks: a prediction without a band does not load them.
                from cmfsim.pipeline.banding import predict_with_band  # noqa: PLC0415

                prediction = predict_with_band(patient, model, band)
        except (ContactError, SolverError) as error:
            options.observer.failed(model, error)
            _log.warning("model %s: %s", model, error)
        else:
            new = [finding for finding in prediction.findings if finding not in known]
            if new:
                options.observer.found(new)
            known.update(new)
            yield prediction


def named_models(models: str | Sequence[str]) -> tuple[str, ...]:
    """Models by name, each once, in the order given.

    Raises `CaseError`: None, or another name: with the one that was meant, it seems.
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

    Raises `CaseError`: A file of the case changed while the work went on.
    """
    case, options = as_case(case), options or BuildOptions()
    # Before the files are read: the key must be that of what is built.
    hashes = input_hashes(case)
    key, about = case_key(case, hashes), plan_key(case)
    patient = model_of(case_for_models(case, models), options)
    options.observer.found(patient.findings)
    for name, found in patient.summary["inputs"].items():
        if hashes.get(name, found) != found:
            raise CaseInputError(
                f"{name}: changed while the case was running; run the case again when no other "
                "program writes to this file"
            )
    return replace(patient, summary={**patient.summary, "inputs_key": key, "plan_key": about})
