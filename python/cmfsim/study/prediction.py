"""One case from its files to the predicted face."""

import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace

from cmfsim.build import Postoperative, build_model
from cmfsim.case import Anatomy, Finding
from cmfsim.checks import check_one_of
from cmfsim.errors import CmfsimError, ContactError, SolverError
from cmfsim.io import Case
from cmfsim.model import PatientModel
from cmfsim.patient import CaseMuscles
from cmfsim.patient_prediction import predict_patient
from cmfsim.prediction import MODELS, Prediction

__all__ = ["build_patient", "predict", "predict_models"]

_log = logging.getLogger(__name__)

Progress = Callable[[str], None]


def predict(
    case: Case, *, model: str = "M+S", progress: Progress | None = None, check: bool = True
) -> Prediction:
    """The face that a model predicts for a case; nothing is written.

    Models with muscles take the case's template, or the package's own where the case names none.

    Parameters
    ----------
    case : Case
    model : str
        "H", "M", "H+S" or "M+S" (Kim et al. 2010, section 3.2): homogeneous or with muscles,
        without or with sliding at teeth and mucosa.
    progress : callable, optional
        Called with the name of each stage as it begins.
    check : bool
        Whether the doctor looks at the case first; an error that it finds ends the work.

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
    check_one_of("model", model, MODELS)
    return next(predict_models(case, (model,), progress=progress, check=check))


def predict_models(
    case: Case,
    models: Sequence[str] = MODELS,
    *,
    progress: Progress | None = None,
    check: bool = True,
    findings: Iterable[Finding] = (),
    anatomy: Anatomy | None = None,
    after: Postoperative | None = None,
    failed: dict[str, CmfsimError] | None = None,
) -> Iterator[Prediction]:
    """The predictions of several models for one case, which is built once.

    Parameters
    ----------
    case : Case
    models : sequence of str
    progress : callable, optional
    check : bool
        As for `predict`.
    findings : iterable of Finding
        What is known of the case already.
    anatomy : Anatomy, optional
        The head, where it is known; the image or surfaces of the case are then not read.
    after : Postoperative, optional
        What is known after the operation, where that was read already.
    failed : dict, optional
        Where given, a model whose solution does not come about (contact that does not settle, say)
        is put there with its error, and the others go on.

    Yields
    ------
    Prediction
        One by one, as each is solved.

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
    for model in models:
        check_one_of("model", model, MODELS)
    patient = build_patient(
        case,
        models,
        progress=progress,
        check=check,
        findings=findings,
        anatomy=anatomy,
        after=after,
    )
    for model in models:
        if progress is not None:
            progress(f"solving {model}")
        try:
            prediction = predict_patient(patient, model)
        except (ContactError, SolverError) as error:
            if failed is None:
                raise
            _log.warning("model %s: %s", model, error)
            failed[model] = error
        else:
            yield prediction


def build_patient(
    case: Case,
    models: Sequence[str],
    *,
    progress: Progress | None = None,
    check: bool = True,
    findings: Iterable[Finding] = (),
    anatomy: Anatomy | None = None,
    after: Postoperative | None = None,
) -> PatientModel:
    """The patient as models need it: muscles are placed if one of them has muscles."""
    wanted = any(model.startswith("M") for model in models)
    if not wanted:
        case = replace(case, muscles=None)
    elif case.muscles is None:
        case = replace(case, muscles=CaseMuscles())
    return build_model(
        case, progress=progress, check=check, findings=findings, anatomy=anatomy, after=after
    )
