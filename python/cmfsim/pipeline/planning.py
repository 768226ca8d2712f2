"""What is planned of a case: its planning page, its splint, and its final bite."""

import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cmfsim.doctor.surgery.bone_overlap import jaw_of, joint_heads
from cmfsim.errors import CaseInputError, LandmarkInputError
from cmfsim.io import CaseOrPath, as_case, read_landmarks, read_surface, replace_text, write_plan
from cmfsim.pipeline.building.case_model import planned_head
from cmfsim.pipeline.building.stages import BuildKeywords, build_options
from cmfsim.pipeline.predicting import build_patient, named_models, prepare
from cmfsim.planning.face_planning.planning import FacePlan, FaceSearch, plan_for_face
from cmfsim.planning.face_planning.targets import PointTarget, SurfaceTarget, Target
from cmfsim.planning.occlusion.final_bite import FinalBite, final_bite
from cmfsim.planning.occlusion.rows import rigid_of, tooth_rows
from cmfsim.planning.occlusion.splint import THICKNESS, Splint, splint_between
from cmfsim.planning.page import PageContent, page_content, page_text
from cmfsim.planning.replanning.corrected import CORRECTIONS, corrected_planning
from cmfsim.planning.replanning.expected_error import TRIALS, ExpectedError, expected_error
from cmfsim.planning.replanning.model import PlanningModel, planning_model
from cmfsim.planning.replanning.plan_band import plan_band
from cmfsim.values.anatomy import JAWS, BoneSegment
from cmfsim.values.checks import Floats, as_whole, check_one_of
from cmfsim.values.landmark_sites import label_key
from cmfsim.values.motion import plan_digits
from cmfsim.values.progress import BUILDING, PLANNING
from cmfsim.values.skin_band import BandOptions
from cmfsim.values.surface_data import MovedSurface, SurfaceData

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
    as_whole("trials", trials, 1)
    as_whole("corrections", corrections, 0)
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


# The page, and the plan for a desired face that is saved next to it.
PAGE_FILE, PLAN_FILE = "plan.html", "towards.toml"
STATE = re.compile(rb'<meta name="cmfsim-made-for" content="([0-9a-f]{64})">')
# The state stands before the style and scripts.
HEAD_BYTES = 2048


def write_planning_page(
    path: str | os.PathLike[str], content: PageContent, *, case_file: str = "case.toml"
) -> int:
    """The size in bytes of a planning page, written to a file in one step.

    Raises
    ------
    CaseError
        (also `ValueError`) Numbers that are not finite.
    OSError
        The folder cannot be written to.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.write_planning_page("plan.html", content)  # doctest: +SKIP
    5550695
    """
    return replace_text(Path(path), page_text(content, case_file=case_file))


def page_state(path: str | os.PathLike[str]) -> str | None:
    """What the planning page at a path was made for (`plan_key`); None where there is no page.

    Raises `OSError`: The file is there and cannot be read.
    """
    if not Path(path).is_file():
        return None
    with Path(path).open("rb") as file:
        found = STATE.search(file.read(HEAD_BYTES))
    return None if found is None else found[1].decode()


# The jaw that an intermediate splint holds where it is planned, while the other is not moved yet.
FIRST: Mapping[str, str] = {"maxilla": "upper", "mandible": "lower"}


def make_splint(
    case: CaseOrPath,
    *,
    intermediate: str | None = None,
    thickness: float = THICKNESS,
    opening: float = 0.0,
    label: str = "",
    **options: "Unpack[BuildKeywords]",
) -> Splint:
    """The splint between the tooth rows of a case as planned; nothing is written.

    Parameters
    ----------
    case : Case, or path of its file or folder
    intermediate : str, optional
        The jaw that is operated on first, "maxilla" or "mandible": the splint holds it as planned
        against the other jaw before the operation. Without it, both are as planned.
    thickness : float, mm
        Of every wall at least, from 1.5 to 6.
    opening : float, degrees
        By which the lower jaw is opened about its joint heads, from 0 to 15, to make room.
    label : str
        Raised letters on the front.
    **options
        Those of `BuildOptions`.

    Returns
    -------
    Splint

    Raises
    ------
    CaseError
        (also `ValueError`) No tooth rows; rows that overlap or lie too close; a jaw that is to be
        operated on first and is not moved by the plan.

    Examples
    --------
    >>> import cmfsim
    >>> splint = cmfsim.make_splint("patient", intermediate="maxilla")  # doctest: +SKIP
    >>> cmfsim.write_surface("splint.stl", splint.surface)  # doctest: +SKIP
    """
    if intermediate is not None:
        check_one_of("intermediate", intermediate, tuple(FIRST))
    case = as_case(case)
    with build_options(options, {}) as asked:
        head, bones, findings = planned_head(case, asked)
        rows = tooth_rows(head.anatomy, bones.segments, head.skull, findings)
        motions = {row.arch.jaw: rigid_of(bones.motions.get(row.segment)) for row in rows}
        held = JAWS if intermediate is None else (FIRST[intermediate],)
        if all(np.array_equal(motions[jaw], np.eye(4)) for jaw in held):
            still = " and ".join(row.segment for row in rows if row.arch.jaw in held)
            raise CaseInputError(
                f"the plan does not move {still} (splint-not-moved): the splint would hold the "
                "teeth as they are; give a plan, or name the jaw that moves first"
            )
        asked.observer.stage("making the splint")
        upper, lower = (
            row.moved(motions[row.arch.jaw]) if row.arch.jaw in held else row for row in rows
        )
        hinge = _hinge(bones.segments)
        made = splint_between(
            upper, lower, hinge, thickness=thickness, opening=opening, label=label
        )
        return replace(made, first=intermediate, plan_digits=plan_digits(bones.motions))


def plan_for_bite(
    case: CaseOrPath,
    upper_scan: SurfaceData,
    lower_scan: SurfaceData,
    **options: "Unpack[BuildKeywords]",
) -> tuple[FinalBite, dict[str, Floats]]:
    """The final bite of two intraoral scans, and the plan in which the lower jaw follows into it.

    The plan is that of the case but for the segment with the lower teeth.

    Parameters
    ----------
    case : Case, or path of its file or folder
    upper_scan, lower_scan : SurfaceData
        As for `final_bite`.
    **options
        Those of `BuildOptions`.

    Returns
    -------
    FinalBite
    dict of str to (4, 4) float64, mm

    Raises
    ------
    CaseError
        (also `ValueError`) As for `final_bite`; a plan that is not rigid.

    Examples
    --------
    >>> import cmfsim
    >>> scans = [cmfsim.read_surface(f"{jaw}.stl") for jaw in ("upper", "lower")]  # doctest: +SKIP
    >>> bite, plan = cmfsim.plan_for_bite("patient", *scans)  # doctest: +SKIP
    >>> cmfsim.write_plan("bite.toml", plan)  # doctest: +SKIP
    """
    case = as_case(case)
    with build_options(options, {}) as asked:
        head, bones, findings = planned_head(case, asked)
        upper, lower = tooth_rows(head.anatomy, bones.segments, head.skull, findings)
        plan = {}
        for name, motion in bones.motions.items():
            if isinstance(motion, MovedSurface) or motion.shape != (4, 4):
                raise CaseInputError(
                    f"the plan bends {name} (bite-plan-bends): a rigid motion is needed"
                )
            plan[name] = np.asarray(motion, dtype=np.float64)
        asked.observer.stage("finding the final bite")
        bite = final_bite(upper, lower, upper_scan, lower_scan)
        asked.observer.found(bite.findings)
        plan[lower.segment] = bite.following(plan.get(upper.segment, np.eye(4)))
        return bite, plan


def _hinge(segments: Sequence[BoneSegment]) -> tuple[Floats, Floats]:
    """The joint heads of the lower jaw before the operation, left and right."""
    lower = [s.surface.vertices for s in segments if jaw_of(s.name) == "lower"]
    if not lower:
        raise CaseInputError("no segment is called mandible: the joint heads are not known")
    points = np.concatenate(lower)
    right, left = (points[index] for index in joint_heads(points))
    return left, right
