"""The planning page of a case, in one call."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cmfsim.errors import CaseInputError, LandmarkInputError
from cmfsim.io import CaseOrPath, as_case, read_landmarks, read_surface, write_plan
from cmfsim.pipeline.building.stages import BuildKeywords, build_options
from cmfsim.pipeline.outputs.planning_page import PAGE_FILE, PLAN_FILE, write_planning_page
from cmfsim.pipeline.predicting import build_patient, named_models, prepare
from cmfsim.planning.face_planning import (
    FacePlan,
    FaceSearch,
    PointTarget,
    SurfaceTarget,
    Target,
    plan_for_face,
)
from cmfsim.planning.page import PageContent, page_content
from cmfsim.planning.replanning import (
    CORRECTIONS,
    TRIALS,
    ExpectedError,
    PlanningModel,
    corrected_planning,
    expected_error,
    plan_band,
    planning_model,
)
from cmfsim.values.landmark_sites import label_key
from cmfsim.values.progress import BUILDING, PLANNING
from cmfsim.values.skin_band import BandOptions

if TYPE_CHECKING:
    from typing_extensions import Unpack

# Name on the page of the plan for a desired face.
TOWARDS = "Towards"
# Files with a desired face.
SURFACES = (".stl", ".ply", ".obj", ".vtp")
LANDMARKS = (".json", ".fcsv")
# Tolerance of a point of the face, mm.
TARGET_STD = 0.5


@dataclass(frozen=True, eq=False)
class PlanningPage:
    """A planning page that was written, and what it was made of.

    Attributes
    ----------
    path : Path
        Of the page.
    planning : PlanningModel
    content : PageContent
    errors : ExpectedError
        Of the page, away from the case's plan.
    found : FacePlan or None
        For the desired face, saved next to the page as `towards.toml`.
    """

    path: Path
    planning: PlanningModel
    content: PageContent
    errors: ExpectedError
    found: FacePlan | None

    def as_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        correction, found = self.planning.correction, self.found
        return {
            "page": str(self.path),
            "bytes": self.path.stat().st_size,
            "expected_error": self.errors.as_dict(),
            "correction": None if correction is None else correction.as_dict(),
            "towards": None if found is None else found.as_dict(),
        }


def make_planning_page(
    case: CaseOrPath,
    *,
    model: str = "M+S",
    trials: int = TRIALS,
    corrections: int = CORRECTIONS,
    towards: str | os.PathLike[str] | Sequence[Target] = (),
    keep_bite: bool = False,
    band: BandOptions | None = None,
    **options: "Unpack[BuildKeywords]",
) -> PlanningPage:
    """The planning page of a case, written to its output folder as `plan.html`.

    Parameters
    ----------
    case : Case, or path of its file or folder
    model : str
        "H", "M", "H+S" or "M+S".
    trials : int
        Plans that are solved exactly to measure the error of the page.
    corrections : int
        Plans that are solved exactly to correct the face at plans other than the case's, if tissue
        slides; 0 for none.
    towards : path, or sequence of targets
        A desired face: a surface or named skin landmarks in a file, or what `plan_for_face` takes.
        The plan that comes closest is on the page, and saved as `towards.toml`.
    keep_bite : bool
        Whether the mandible then keeps its planned position relative to the maxilla.
    band : BandOptions, optional
        How far to trust the face, on the page.
    **options
        As for `predict`.

    Raises
    ------
    CmfsimError
        (also `ValueError` where the input is at fault) What a stage cannot work with.
    OSError
        The output folder cannot be written to; the file of a desired face cannot be read.

    Examples
    --------
    >>> import cmfsim
    >>> page = cmfsim.make_planning_page("case.toml", model="M")  # doctest: +SKIP
    >>> page.path.name, page.errors.at(3.0)  # doctest: +SKIP
    ('plan.html', (0.0, 0.0))
    """
    case = as_case(case)
    # Before any work, so that an invalid option is not reported a minute later.
    for name, count, least in (("trials", trials, 1), ("corrections", corrections, 0)):
        if count < least:
            raise CaseInputError(f"{name} is {count}: a whole number of {least} or more is needed")
    prepare(case, {PAGE_FILE, PLAN_FILE}.__contains__)
    targets = _read_targets(towards) if isinstance(towards, str | os.PathLike) else towards
    models = named_models(model)
    if band is not None:
        band.check(models)
    with build_options(options, {**BUILDING, **PLANNING}) as asked:
        stage = asked.observer.stage
        patient = build_patient(case, models, asked)
        stage("computing the plan operator")
        planning = planning_model(patient, model)
        search = _search(planning, keep_bite=keep_bite and bool(targets))
        stage("solving the case's plan")
        followed = None
        if band is None:
            reference = planning.solve(planning.reference)
        else:
            # Regions and proposed landmarks: a page without a band does not load them.
            from cmfsim.pipeline.banding import predict_with_band  # noqa: PLC0415

            reference = predict_with_band(planning.patient, model, band, solver=planning.solver)
            stage("computing how far to trust the face")
            followed = plan_band(planning, reference)
        planning = corrected_planning(planning, corrections, progress=stage)
        errors = expected_error(planning, trials=trials, progress=stage)
        found = None
        if targets:
            stage("searching for the plan of the desired face")
            wish = targets(planning) if callable(targets) else targets
            found = plan_for_face(planning, wish, search)
        stage("making the page")
        variants = {} if found is None else {TOWARDS: found.plan}
        content = page_content(planning, reference, errors, variants=variants, band=followed)
        asked.observer.found(content.findings)
    case.output.mkdir(parents=True, exist_ok=True)
    write_planning_page(case.output / PAGE_FILE, content, case_file=case.file.name)
    if found is not None:
        made_for = str(patient.summary.get("plan_key", ""))
        write_plan(case.output / PLAN_FILE, found.plan, made_for=made_for)
    return PlanningPage(case.output / PAGE_FILE, planning, content, errors, found)


def _search(planning: PlanningModel, *, keep_bite: bool) -> FaceSearch:
    """The options of the search for the plan of a desired face."""
    if not keep_bite:
        return FaceSearch()
    upper = next((n for n in ("maxilla", "midface") if n in planning.segments), None)
    lower = next((n for n in ("mandible_body", "mandible") if n in planning.segments), None)
    if upper is None or lower is None:
        raise CaseInputError(
            "keeping the bite needs a maxilla and a mandible that move; segments are: "
            + ", ".join(planning.segments)
        )
    return FaceSearch(follows={lower: upper})


def _read_targets(path: str | os.PathLike[str]) -> Callable[[PlanningModel], list[Target]]:
    """A function that returns the targets in a file, once the patient is built."""
    path = Path(path)
    ending = path.suffix.lower()
    if ending in SURFACES:
        wished = read_surface(path)
        return lambda _: [SurfaceTarget(wished, std=TARGET_STD)]
    if ending not in LANDMARKS:
        known = ", ".join((*SURFACES, ".mrk.json", ".fcsv"))
        raise CaseInputError(f"{path.name}: a file with a desired face ends in {known}")
    goals = {label_key(name): place for name, place in read_landmarks(path).items()}

    def targets(planning: PlanningModel) -> list[Target]:
        own = planning.patient.landmarks.get("skin", {})
        both = [name for name in own if label_key(name) in goals]
        if not both:
            raise LandmarkInputError(
                f"{path.name}: has none of the case's skin landmarks, which are: "
                f"{', '.join(own) or 'none'}"
            )
        places = np.array([own[name] for name in both])
        there = np.array([goals[label_key(name)] for name in both])
        return [PointTarget(places, there, std=TARGET_STD)]

    return targets
