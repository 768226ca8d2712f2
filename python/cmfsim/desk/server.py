"""The server of the desk: its pages, and what they ask it to write and to begin."""

import hashlib
import json
import socket
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cmfsim._core import __version__
from cmfsim.bones.cuts.procedures import place_procedure, procedure_options
from cmfsim.desk.case_text import (
    answered,
    open_questions,
    read_as,
    with_keys,
    with_plan,
    with_tables,
)
from cmfsim.desk.cut_preview import cut_preview, procedure_choices
from cmfsim.desk.session import Session
from cmfsim.errors import CaseInputError, CmfsimError, LandmarkError
from cmfsim.io import Case, read_landmark_file, replace_text, write_landmarks
from cmfsim.io.files.reading_writing import toml_module
from cmfsim.pipeline.building.inputs import plan_key, read_placed_sites
from cmfsim.planning.landmark_page.page import landmark_page_text
from cmfsim.planning.page import PageContent
from cmfsim.planning.page.document import Document, document_text, shown_values
from cmfsim.planning.server import SOLVE, LocalServer, RefusedError, Reply, solved_reply
from cmfsim.values.anatomy import segment_colours
from cmfsim.values.case_parts import PROCEDURES
from cmfsim.values.checks import Floats
from cmfsim.values.motion import plan_digits, rigid_motion

JSON = "application/json"
# What people read of the state.
READ_OF_STATE = ("name", "stage", "error", "severity", "what", "fix")
MADE_BY = "planned on the desk"
# Results that are served once the desk has made them. Scripts of a page may not ask this server;
# browsers show no PDF in a sandbox.
SANDBOX = {"Content-Security-Policy": "sandbox allow-scripts allow-popups allow-downloads"}
RESULTS: Mapping[str, tuple[str, Mapping[str, str]]] = {
    "report.html": ("text/html; charset=utf-8", SANDBOX),
    "report.pdf": ("application/pdf", {}),
}
# A first plan farther than this is a wrong unit, mm: the limit of the planning page.
MOST_SHIFT = 30.0
CHANGED = (
    "the case file was changed by another tab or program since this page was opened: reload it"
)


def desk_server(session: Session, port: int | socket.socket = 0) -> LocalServer:
    """The server of a folder on the desk, which does not run yet; an error if the port is taken."""
    calls = Calls(session)
    pages: dict[str, Callable[[], Reply]] = {
        "": lambda: _html(desk_text(session, list(calls.bones()))),
        "landmarks": lambda: _html(landmarks_text(session)),
        # The report links to the file.
        **dict.fromkeys(("plan", "plan.html"), lambda: _html(_made(session)["text"])),
        "state": lambda: _json(calls.state()),
        **{name: calls.result(name) for name in RESULTS},
    }
    asked = {
        "answer": calls.answer,
        "cuts": calls.cuts,
        "compute": calls.compute,
        "save-landmarks": calls.landmarks,
        "save-plan": calls.plan,
        "report": calls.report,
        "open": calls.open,
        "cancel": calls.cancel,
    }
    values = {name: _of_values(call) for name, call in asked.items()}
    return LocalServer(pages, {**values, SOLVE: calls.solve}, port=port)


def _html(text: str) -> Reply:
    return Reply(text.encode())


def _json(values: Mapping[str, Any]) -> Reply:
    return Reply(json.dumps(values, allow_nan=False).encode(), JSON)


def _made(session: Session) -> dict[str, Any]:
    if "compute" not in session.made:
        raise RefusedError(409, "the plan operator is not computed: go back to the desk")
    values: dict[str, Any] = session.made["compute"].values
    return values


def _of_values(call: Callable[[dict[str, Any]], Mapping[str, Any]]) -> Callable[[bytes], Reply]:
    """The call of a function that takes and returns the values of a JSON object."""

    def answer(body: bytes) -> Reply:
        try:
            given = json.loads(body)
        except (ValueError, RecursionError) as error:
            raise RefusedError(400, "an object is needed as JSON") from error
        if not isinstance(given, dict):
            raise RefusedError(400, "an object is needed as JSON")
        return _json(call(given))

    return answer


class Calls:
    """What the pages of the desk ask for; whoever writes states what it has seen of the file."""

    def __init__(self, session: Session) -> None:
        self._session = session

    def state(self) -> dict[str, Any]:
        """The state of the session, with the digest of the case file."""
        values = shown_values(self._session.state(), READ_OF_STATE)
        return {**values, "seen": _digest(self._session.text())}

    def bones(self) -> dict[str, Floats]:
        """The vertices of each bone that is drawn, mm."""
        head = self._session.head
        surfaces = [] if head is None else head.values["page"]["surfaces"]
        return {
            surface["name"]: np.asarray(head.arrays[f"surface_{number}"], dtype=np.float64)
            for number, surface in enumerate(surfaces)
            if head is not None and surface["part"] != "skin"
        }

    def result(self, name: str) -> Callable[[], Reply]:
        """A function that gives a file that this desk has written."""

        def read() -> Reply:
            if name not in self._session.state()["files"]:
                raise RefusedError(404, "there is no report of this plan: make it on the page")
            data = (self._session.case().output / name).read_bytes()
            if (
                hashlib.sha256(data).hexdigest()
                != self._session.made["report"].values["files"][name]
            ):
                raise RefusedError(
                    409, f"another program has written {name} since, perhaps of another plan: make "
                    "the report again"
                )  # fmt: skip
            return Reply(data, *RESULTS[name])

        return read

    def open(self, _: dict[str, Any]) -> dict[str, Any]:
        """Opens the head once more."""
        self._session.begin()
        return self.state()

    def cancel(self, _: dict[str, Any]) -> dict[str, Any]:
        """Stops the work."""
        self._session.cancel()
        return self.state()

    def answer(self, given: dict[str, Any]) -> dict[str, Any]:
        """Writes the answer to a question of `cmfsim init` into the case file."""
        line, toml = given.get("line"), given.get("toml")
        if not isinstance(line, int) or not isinstance(toml, str):
            raise RefusedError(400, "line and toml are needed")
        with self._session.changing:
            text = self._seen(given)
            new = answered(text, line, toml)
            self._write(new)
        if not self._session.busy:
            self._session.begin()
        return self.state()

    def cuts(self, given: dict[str, Any]) -> dict[str, Any]:
        """What chosen procedures would cut; nothing is written."""
        return cut_preview(_cuts(given), self._session.points(), self.bones())

    def compute(self, given: dict[str, Any]) -> dict[str, Any]:
        """Writes cuts and first plan into the case file, and computes the plan operator."""
        cuts, moves, session = _cuts(given), _moves(given), self._session
        if session.busy:
            raise RefusedError(409, "still at work: wait, or stop it")
        points = session.points()
        for kind, options in cuts.items():
            try:
                place_procedure(kind, points, options)
            except LandmarkError as error:
                raise CaseInputError(f"{error} (on the page of landmarks)") from error
        with session.changing:
            text = self._seen(given)
            old = {s for cut in session.case().osteotomies if cut.procedure for s in cut.segments}
            new_segments = {name for kind in cuts for name in PROCEDURES[kind]}
            known = new_segments | set(self.bones()) | set(session.case().plan) - old
            if unknown := [name for name in moves if name not in known]:
                raise CaseInputError(f"{unknown[0]} is no segment of these cuts")
            gone = (old - new_segments) | set(moves)
            new = _with_cuts(text, cuts)
            new = with_plan(new, gone.__contains__, moves, MADE_BY)
            case = read_as(new, session.case_file, ("osteotomies", "plan"), text)
            made = [cut.segments for cut in case.osteotomies]
            if not made and not case.plan and not moves:
                raise CaseInputError("choose a procedure, or state a move: nothing is cut or moved")
            self._write(new)
        session.start("compute")
        return self.state()

    def landmarks(self, given: dict[str, Any]) -> dict[str, Any]:
        """Writes files of landmarks next to the case, and names them in it."""
        session = self._session
        texts: dict[str, Any] = {k: given[k] for k in ("skull", "skin") if k in given}
        if not texts or not all(isinstance(text, str) for text in texts.values()):
            raise RefusedError(400, "skull or skin is needed, as the text of a .mrk.json")
        with session.changing:
            text = self._seen(given)
            keys = {kind: json.dumps(_file_of(session.case_file, kind).name) for kind in texts}
            new = with_keys(text, "landmarks", {**keys, "automatic": '"missing"'})
            read_as(new, session.case_file, ("landmarks",), text)
            # All are read as any other file before one takes its place.
            read = {kind: self._sites(kind, markups) for kind, markups in texts.items()}
            for kind, (points, descriptions) in read.items():
                write_landmarks(
                    _file_of(session.case_file, kind), points, descriptions=descriptions
                )
            self._write(new)
        if "skull" in read and session.head is not None:
            sites = {name: point.tolist() for name, point in read["skull"][0].items()}
            session.head.values["skull"] = sites
        for kind in ("compute", "report"):
            session.made.pop(kind, None)
        return self.state()

    def _sites(self, kind: str, markups: str) -> tuple[dict[str, Floats], dict[str, str]]:
        """Points and descriptions of sites, with those of the case that the page does not show."""
        case = self._session.case()
        with tempfile.TemporaryDirectory(prefix="cmfsim-desk-") as folder:
            file = Path(folder) / "landmarks.mrk.json"
            file.write_text(markups, encoding="utf-8")
            read = read_landmark_file(file, kind=kind)
        points, descriptions = dict(read.points), dict(read.descriptions)
        before = getattr(case.landmarks, kind)
        if before is not None and self._session.head is not None:
            own = read_landmark_file(before, frame=case.landmarks.frame, kind=kind)
            shown = {s["name"] for s in self._session.head.values["page"]["sites"]}
            for name in own.points.keys() - shown:
                points[name] = own.points[name]
                descriptions[name] = own.descriptions.get(name, "")
        return points, descriptions

    def plan(self, given: dict[str, Any]) -> dict[str, Any]:
        """Writes the plan of the planning page into the case file."""
        session = self._session
        if not isinstance(given.get("motions"), list):
            raise RefusedError(400, "motions are needed")
        body = json.dumps({"motions": given["motions"]})
        checked = session.ask("check_plan", body=body).values
        plan = {name: np.array(matrix) for name, matrix in checked.items()}
        with session.changing:
            text = self._seen(given)
            if _made(session)["made_for"] != plan_key(session.case()):
                raise RefusedError(409, "cuts or landmarks have changed: compute the plan again")
            new = with_plan(text, lambda _: True, plan, MADE_BY)
            case = read_as(new, session.case_file, ("plan",), text)
            read = {name: m.matrix for name, m in case.plan.items() if m.matrix is not None}
            if case.achieved or plan_digits(read) != plan_digits(plan):
                raise CaseInputError(
                    f"{session.case_file.name}: reads as another plan, so nothing was written: "
                    "write [plan.SEGMENT] tables as `cmfsim init` does"
                )
            self._write(new)
        return self.state()

    def report(self, _: dict[str, Any]) -> dict[str, Any]:
        """Predicts the case as it is in its file, and writes its report."""
        self._session.reported = self._session.text()
        self._session.start("report")
        return self.state()

    def solve(self, body: bytes) -> Reply:
        """The exact face of a plan."""
        text = body.decode(errors="replace")
        found = self._session.ask("solve", body=text)
        return solved_reply(found.arrays["shift"], found.values)

    def _seen(self, given: Mapping[str, Any]) -> str:
        """The text of the case file, if it is the one that the page has seen."""
        text = self._session.text()
        if not text or given.get("seen") != _digest(text):
            raise RefusedError(409, CHANGED)
        return text

    def _write(self, text: str) -> None:
        replace_text(self._session.case_file, text)


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _file_of(case_file: Path, kind: str) -> Path:
    return case_file.with_name(f"{kind}_landmarks.mrk.json")


def _cuts(given: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """The options of each procedure."""
    cuts = given.get("cuts")
    if not isinstance(cuts, dict) or not all(isinstance(o, dict) for o in cuts.values()):
        raise RefusedError(400, "cuts are needed, with the options of each procedure")
    for kind in cuts:
        procedure_options(kind)
    return cuts


def _moves(given: Mapping[str, Any]) -> dict[str, Floats]:
    """The first plan: by segment, mm forwards, up and to the patient's left."""
    moves = given.get("moves", {})
    if not isinstance(moves, dict):
        raise RefusedError(400, "moves are needed, by segment")
    plan = {}
    for name, numbers in moves.items():
        is_three = isinstance(numbers, list) and len(numbers) == 3
        if not is_three or not all(type(v) in {int, float} for v in numbers):
            raise RefusedError(400, f"{name}: three numbers are needed: forwards, up, left")
        if not all(abs(v) <= MOST_SHIFT for v in numbers):
            raise RefusedError(
                400, f"{name} moves by {numbers}: at most {MOST_SHIFT:g} mm is allowed"
            )
        plan[name] = rigid_motion((numbers[2], -numbers[0], numbers[1]))
    return plan


def _with_cuts(text: str, cuts: Mapping[str, Mapping[str, float]]) -> str:
    """The text with these procedures as its cuts; planes that the user wrote stay."""
    tables = {
        f"[[osteotomies]]  # {', '.join(PROCEDURES[kind])}, {MADE_BY}": _rows(kind, options)
        for kind, options in cuts.items()
    }
    return with_tables(text, _is_procedure, tables)


def _is_procedure(path: tuple[str, ...], own: str) -> bool:
    if path != ("osteotomies",):
        return False
    return "procedure" in toml_module().loads(own)["osteotomies"][0]


def _rows(kind: str, options: Mapping[str, float]) -> list[str]:
    defaults = procedure_options(kind)
    changed = {name: value for name, value in options.items() if value != defaults.get(name)}
    return [f'procedure = "{kind}"', *(f"{n} = {float(v)!r}" for n, v in changed.items())]


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
        "colours": segment_colours([name for made in PROCEDURES.values() for name in made]),
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
    arrays: dict[str, Any] = {}
    if head is not None:
        page = head.values["page"]
        values |= {key: page[key] for key in ("surfaces", "target", "span", "sites")}
        values["sites"] = _with_placed(session, page["sites"])
        arrays = {n: array for n, array in head.arrays.items() if n.startswith("surface_")}
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
            arrays=arrays,
            package="cmfsim.desk",
            main="desk_main.js",
            is_served=True,
        )
    )


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
    return landmark_page_text(PageContent(values, session.head.arrays))
