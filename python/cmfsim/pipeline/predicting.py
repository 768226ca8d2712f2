"""One case from its files to the predicted face, checked before it begins."""

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import TYPE_CHECKING

from cmfsim._core import MassTensors
from cmfsim.errors import CaseInputError, ContactError, SolverError
from cmfsim.io import Case, CaseOrPath, as_case, read_surface
from cmfsim.io.results.predictions import is_prediction_file
from cmfsim.pipeline.building.case_checks import cut_segments
from cmfsim.pipeline.building.case_model import model_of, replanned
from cmfsim.pipeline.building.inputs import (
    case_key,
    check_output,
    input_hashes,
    plan_key,
    plan_of_other_case,
)
from cmfsim.pipeline.building.stages import BuildKeywords, BuildOptions, build_options
from cmfsim.planning.occlusion.final_bite import final_bite
from cmfsim.planning.occlusion.rows import patient_rows
from cmfsim.processes.memory import release_freed_memory
from cmfsim.solving.models import solved_patient
from cmfsim.values.case_parts import CaseBite, CaseMuscles
from cmfsim.values.checks import check_one_of
from cmfsim.values.patient_model import PatientModel
from cmfsim.values.prediction import MODELS, Prediction
from cmfsim.values.progress import expected_stages
from cmfsim.values.skin_band import BandOptions

if TYPE_CHECKING:
    from typing_extensions import Unpack
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Need:
    """A module of an extra, and its purpose; some are optional."""

    module: str
    extra: str
    purpose: str
    is_optional: bool = False


def prepare(
    case: Case,
    is_written: Callable[[str], bool] = is_prediction_file,
    *,
    report: bool = False,
    evaluation: bool = False,
) -> None:
    """Finds before any work what would end it late.

    is_written: Whether a file of a name is written to the output folder.
    evaluation: Whether predictions are compared with the face after the operation.
    Raises `CaseError`: Packages are missing, all named in one line; and as `check_output`.
    """
    check_output(case, is_written)
    check_extras(_needs(case, report=report, evaluation=evaluation))


def check_extras(needs: Iterator[_Need] | Sequence[_Need]) -> None:
    """Refuses to begin without required modules, and warns of missing optional ones."""
    missing = [need for need in dict.fromkeys(needs) if not _is_there(need.module)]
    if not missing:
        return
    extras = ",".join(sorted({need.extra for need in missing}))
    reasons = "; ".join(dict.fromkeys(f"{need.module}: {need.purpose}" for need in missing))
    line = f"{reasons}; install with: pip install '.[{extras}]' in cmfsim's folder"
    if all(need.is_optional for need in missing):
        _log.warning("skipped: %s", line)
        return
    raise CaseInputError(f"packages are missing: {line}")


def _needs(case: Case, *, report: bool, evaluation: bool) -> Iterator[_Need]:
    after = case.postoperative
    images = [case.image, None if after is None else after.image]
    if any(image is not None for image in images):
        yield _Need("SimpleITK", "imaging", "reads images")
    yield _Need("scipy", "imaging", "computes on the grid of the tissue")
    yield _Need("skimage", "imaging", "makes surfaces from the grid")
    for path in _surface_files(case):
        yield _Need("meshio", "mesh", "reads surfaces and meshes")
        if path.lower().endswith(".vtk"):
            yield _Need("vtkmodules", "mesh", "reads legacy VTK")
    if report:
        yield _Need("jinja2", "report", "writes the report (or use --no-report)")
        yield _Need("pyvista", "mesh", "draws 3-D pictures", is_optional=True)
    if evaluation:
        yield _Need("scipy", "report", "tests the differences between models")
        yield _Need("matplotlib", "report", "draws the chart of errors", is_optional=not report)


def _surface_files(case: Case) -> Iterator[str]:
    if case.surfaces is not None:
        yield from map(str, (case.surfaces.skin, *case.surfaces.bones.values()))
    if case.postoperative is not None:
        after = case.postoperative
        yield from map(str, (path for path in (after.skin, *after.bones.values()) if path))
    for motion in case.plan.values():
        yield from map(str, (path for path in (motion.surface, motion.moved_surface) if path))
    seam = None if isinstance(case.lips.seam, str) else case.lips.seam
    yield from map(str, (path for path in (case.mesh.file, seam) if path))


def _is_there(module: str) -> bool:
    """Whether a module can be found; it is not loaded."""
    try:
        return find_spec(module) is not None
    except (ImportError, ValueError):  # its package is missing; it was put out of reach
        return False


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
    if not isinstance(model, str):
        raise CaseInputError(
            f"model is {model!r}: predict takes one model, such as 'M+S'; predict_models takes "
            "several and yields a prediction for each"
        )
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
    case: Case,
    models: Sequence[str],
    options: BuildOptions,
    *,
    band: BandOptions | None = None,
    built: tuple[Case, PatientModel] | None = None,
) -> Iterator[Prediction]:
    """The predictions of several models for one case, as `predict_models` makes them.

    built: A case, perhaps of another plan, and its patient, used if nothing else has changed.
    """
    if band is not None:
        # Before a case is built for a minute.
        band.check(models)
    patient = None if built is None else _replanned(*built, case, options)
    patient = patient or build_patient(case, models, options)
    if patient.muscles is not None:
        options.observer.muscles(patient.muscles, patient.segments)
    options.observer.built(patient)
    # Solvers need more at once than any stage of the build.
    release_freed_memory()
    known = set(patient.findings)
    # By tissue: models of the same tissue differ in their conditions alone.
    kept: dict[str, MassTensors] = {}
    for number, model in enumerate(models):
        options.observer.stage(f"solving {model}")
        tissue = model[0]
        try:
            if band is None:
                solved = solved_patient(patient, model, tensors=kept.pop(tissue, None))
                prediction = solved.prediction
                if any(later.startswith(tissue) for later in models[number + 1 :]):
                    kept[tissue] = solved.solver.tensors
                del solved
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
    """Models by name, each once, in order; `CaseError` for none or another, with the one meant."""
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


def _replanned(
    before: Case, patient: PatientModel, case: Case, options: BuildOptions
) -> PatientModel | None:
    """The patient under the plan of a case; None if not only the plan differs."""
    hashes = input_hashes(case)
    # As they were when it was built, but for the case file, in which the plan stands.
    own = {case.file.name: hashes[case.file.name]}
    key = case_key(replace(before, plan=case.plan), {**patient.summary["inputs"], **own})
    # Where tissue slides and is cleft follows from which segments are cut or moved.
    others = (before.plan.keys() ^ case.plan.keys()) - {*cut_segments(case)}
    if case_key(case, hashes) != key or others or case.achieved:
        return None
    model = replanned(patient, before, case, options)
    options.observer.found(model.findings)
    summary = {**model.summary, "inputs": hashes, "inputs_key": key}
    return replace(model, summary=summary)


def build_patient(
    case: CaseOrPath, models: Sequence[str], options: BuildOptions | None = None
) -> PatientModel:
    """The patient as models need it, with muscles if one has; `CaseError` if a file has changed."""
    case, options = as_case(case), options or BuildOptions()
    # Before the files are read: the key must be that of what is built.
    hashes = input_hashes(case)
    key, about = case_key(case, hashes), plan_key(case)
    strange = plan_of_other_case(case, about)
    options.observer.found(strange)
    patient = model_of(case_for_models(case, models), options)
    options.observer.found(patient.findings)
    for name, found in patient.summary["inputs"].items():
        if hashes.get(name, found) != found:
            raise CaseInputError(
                f"{name}: changed while the case was running; run the case again when no other "
                "program writes to this file"
            )
    if case.bite is not None:
        patient = _with_bite(patient, case.bite, options)
    patient = patient.with_findings(strange)
    return replace(patient, summary={**patient.summary, "inputs_key": key, "plan_key": about})


def _with_bite(patient: PatientModel, scans: CaseBite, options: BuildOptions) -> PatientModel:
    """The patient with the bite of the case's scans: the motion into it, and three of its teeth."""
    options.observer.stage("finding the final bite")
    upper, lower = patient_rows(patient)
    bite = final_bite(upper, lower, read_surface(scans.upper), read_surface(scans.lower))
    options.observer.found(bite.findings)
    places = [getattr(lower.arch, name).tolist() for name in ("tip", "left", "right")]
    target = {**bite.as_dict(), "upper": upper.segment, "lower": lower.segment, "places": places}
    patient = patient.with_findings(bite.findings)
    return replace(patient, summary={**patient.summary, "target_bite": target})
