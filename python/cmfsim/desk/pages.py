"""The pages of the desk: the desk itself, and the landmarks as its case has them."""

from collections.abc import Mapping, Sequence
from typing import Any

from cmfsim._core import __version__
from cmfsim.desk.case_text import open_questions
from cmfsim.desk.cut_preview import procedure_choices
from cmfsim.desk.session import Session
from cmfsim.errors import CmfsimError
from cmfsim.io import Case
from cmfsim.pipeline.building.inputs import read_placed_sites
from cmfsim.planning.landmark_page import LandmarkContent, landmark_page_text
from cmfsim.planning.page.document import Document, document_text
from cmfsim.planning.server import RefusedError


def desk_text(session: Session, bones: Sequence[str]) -> str:
    """The text of the desk as it is now: the questions, or the head with its cuts and plan."""
    text = session.text()
    head = session.head
    questions = open_questions(text)
    values: dict[str, Any] = {
        "case_file": str(session.case_file),
        "questions": questions,
        "taken": session.made["set_up"].values if "set_up" in session.made else [],
        "procedures": procedure_choices(),
        "bones": list(bones),
        "cuts": {},
        "moves": {},
        "kept": [],
        "surfaces": [],
        "sites": [],
    }
    if text and not questions:
        try:
            values |= _chosen(session.case())
        except (CmfsimError, OSError) as error:
            values["error"] = str(error)
    if head is not None:
        page = head.values["page"]
        values |= {key: page[key] for key in ("surfaces", "target", "span", "sites")}
        values["sites"] = _with_placed(session, page["sites"])
    name = session.case_file.parent.name
    return document_text(
        Document(
            title=f"{name}: planning desk",
            facts=f"Everything is saved in {session.case_file}, which cmfsim predict and "
            "cmfsim plan read as well. L and R are the patient's sides.",
            footer=f"Made by cmfsim {__version__}. Served on this machine only.",
            stage="Skull and skin",
            panel="Steps",
            picture="Skull with the planes of the cuts. Arrow keys rotate, plus and minus zoom, "
            "1 to 6 choose a view.",
            made_for="",
            values=values,
            arrays={} if head is None else _surfaces(head.arrays),
            package="cmfsim.desk",
            main="desk_main.js",
            is_served=True,
        )
    )


def _surfaces(arrays: Mapping[str, Any]) -> dict[str, Any]:
    return {name: array for name, array in arrays.items() if name.startswith("surface_")}


def _chosen(case: Case) -> dict[str, Any]:
    """Cuts and moves of the case; what is more than a shift is kept until the page of the plan."""
    moves, kept = {}, []
    for name, motion in case.plan.items():
        matrix = motion.matrix
        if matrix is None or abs(matrix[:3, :3] - [[1, 0, 0], [0, 1, 0], [0, 0, 1]]).max() > 0:
            kept.append(name)
        else:
            moves[name] = [-float(matrix[1, 3]), float(matrix[2, 3]), float(matrix[0, 3])]
    cuts = {cut.procedure: dict(cut.options) for cut in case.osteotomies if cut.procedure}
    return {"cuts": cuts, "moves": moves, "kept": kept}


def _with_placed(session: Session, sites: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The sites of a page with what a person has placed or accepted in the files of the case."""
    given = read_placed_sites(session.case())
    found = []
    for site in sites:
        point, state = given.get((site["kind"], site["name"]), (None, None))
        if point is None or state is None or not state.by_person:
            found.append({**site, "placed": None})
        else:
            found.append({**site, "placed": point.tolist(), "placed_origin": state.origin})
    return found


def landmarks_text(session: Session) -> str:
    """The text of the page of landmarks, which saves into the case."""
    if session.head is None:
        raise RefusedError(409, "the head is not open yet: go back to the desk")
    page = session.head.values["page"]
    sites = _with_placed(session, page["sites"])
    values = {**page, "sites": sites, "on_desk": True}
    return landmark_page_text(LandmarkContent(values, session.head.arrays))
