"""The work of the desk, as it runs in a worker: the head, the plan operator, the report."""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from cmfsim.drafting import init_case
from cmfsim.errors import CaseInputError, LandmarkError
from cmfsim.io import Case
from cmfsim.pipeline.building.inputs import (
    OpenHeads,
    input_hash,
    plan_key,
    read_anatomy,
    read_case_landmarks,
    read_placed_sites,
)
from cmfsim.pipeline.building.stages import BuildKeywords, BuildOptions
from cmfsim.pipeline.outputs.landmark_page import head_content
from cmfsim.pipeline.outputs.results import write_chart_page, write_results
from cmfsim.pipeline.planning import make_planning_page
from cmfsim.pipeline.predicting import predictions_of, prepare
from cmfsim.pipeline.proposing import filled_landmarks, proposed_head, unproposed_head
from cmfsim.planning.page import page_text
from cmfsim.planning.replanning.model import PlanningModel
from cmfsim.planning.server import RefusedError, plan_of_body, solved_plan
from cmfsim.processes.worker import Answer
from cmfsim.values.finding import Finding
from cmfsim.values.prediction import Prediction
from cmfsim.values.progress import Observer

# What the line of a stage begins with, on standard error.
STAGE = "cmfsim-stage "
MODEL = "M+S"
# Exact solutions that measure the error of the page; there is no correction, because each plan is
# solved exactly as soon as it is kept.
TRIALS = 4

# The head that is open, until its plan is computed: its jaws are then separated by the landmarks.
_opened: OpenHeads = {}
# The planning model of a case file, with the case as it was then.
_held: dict[str, tuple[Case, PlanningModel]] = {}


class _Told(Observer):
    """Findings as they come, without duplicates; stages go to the parent."""

    def __init__(self) -> None:
        self.all: dict[Finding, None] = {}

    def stage(self, name: str) -> None:
        """Tells the parent what begins."""
        _stage(name)

    def found(self, findings: Sequence[Finding]) -> None:
        """Keeps findings."""
        self.all.update(dict.fromkeys(findings))

    def as_values(self) -> list[dict[str, Any]]:
        """Plain values, notes left out."""
        return [asdict(finding) for finding in self.all if finding.severity != "note"]


def _stage(name: str) -> None:
    sys.stderr.write(f"{STAGE}{name}\n")
    sys.stderr.flush()


def set_up(case_file: str) -> list[dict[str, Any]]:
    """What each file next to a case file was taken for; the case file is written."""
    draft = init_case(Path(case_file).parent, progress=_stage)
    return [taken.as_dict() for taken in draft.taken]


def open_head(case_file: str) -> Answer:
    """The content of the page of landmarks, the sites of the skull, and findings."""
    case = Case.load(case_file)
    landmarks, noticed = read_case_landmarks(case)
    _opened.clear()
    anatomy, found = read_anatomy(case, landmarks.get("skull", {}), _stage, _opened)
    _stage("finding the landmarks")
    try:
        head = proposed_head(case, anatomy, _stage)
    except LandmarkError as error:
        head = unproposed_head(anatomy, str(error))
    given = read_placed_sites(case)
    sites = filled_landmarks(head, given) if given else head.landmarks
    content = head_content(case.name, head, built_for=plan_key(case))
    told = _Told()
    told.found((*noticed, *found, *head.findings, *sites.findings))
    skull = {name: point.tolist() for name, point in sites.points.get("skull", {}).items()}
    values = {"page": content.values, "skull": skull, "findings": told.as_values()}
    return Answer(values, content.arrays)


def compute(case_file: str) -> dict[str, Any]:
    """The planning page of a case, what it was made for, and findings; its model is kept."""
    _held.clear()
    case, told = Case.load(case_file), _Told()
    asked: BuildKeywords = {"opened": _opened, "observer": told, "progress": _stage}
    made = make_planning_page(case, model=MODEL, trials=TRIALS, corrections=0, **asked)
    _held[case_file] = case, made.planning
    content = replace(made.content, values={**made.content.values, "on_desk": True})
    return {
        "text": page_text(content, case_file=case.file.name, is_served=True),
        "made_for": made.planning.patient.summary["plan_key"],
        "segments": list(made.planning.segments),
        "findings": told.as_values(),
    }


def solve(case_file: str, body: str) -> Answer:
    """The exact displacements of the skin's nodes under a plan, with a summary."""
    shift, figures = solved_plan(_held[case_file][1], _plan(case_file, body))
    return Answer(figures, {"shift": shift})


def check_plan(case_file: str, body: str) -> dict[str, Any]:
    """The motions of a plan, (4, 4) mm each, by segment."""
    return {name: matrix.tolist() for name, matrix in _plan(case_file, body).items()}


def _plan(case_file: str, body: str) -> dict[str, Any]:
    if case_file not in _held:
        raise CaseInputError("the plan operator is gone: compute it again on the desk")
    try:
        return plan_of_body(_held[case_file][1], body.encode())
    except RefusedError as error:
        raise CaseInputError(str(error)) from error


def report(case_file: str) -> dict[str, Any]:
    """Predicts the case as `cmfsim predict` does; its report and chart with hashes, findings.

    Where only the plan differs from the case of the plan operator, nothing is built again.
    """
    case, told = Case.load(case_file), _Told()
    prepare(case, report=True)
    built = None
    if case_file in _held:
        before, planning = _held[case_file]
        built = before, planning.patient

    def predicted(early: BuildKeywords) -> Iterator[Prediction]:
        early["observer"] = told
        options = BuildOptions(**early)
        return predictions_of(case, (MODEL,), options, built=built)

    written = write_results(case.output, predicted, (MODEL,), stage=_stage)
    told.found(written.findings)
    _stage("drawing the page for the chart")
    names = filter(None, (written.report, write_chart_page(case.output)))
    return {
        "files": {name: input_hash(case.output / name) for name in names},
        "findings": told.as_values(),
    }
