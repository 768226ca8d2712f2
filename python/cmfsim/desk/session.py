"""What the desk knows of one folder, and the work that runs for it: one at a time, in a worker."""

import contextlib
import os
import signal
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cmfsim.desk.case_text import open_questions
from cmfsim.desk.work import STAGE
from cmfsim.drafting import CASE_FILE
from cmfsim.errors import CaseInputError, CmfsimError
from cmfsim.io import Case
from cmfsim.pipeline.outputs.results import REPORT_STAGE
from cmfsim.planning.server import RefusedError
from cmfsim.processes.worker import Answer, Worker, WorkerEndedError
from cmfsim.values.motion import plan_digits
from cmfsim.values.progress import BUILDING, PLANNING, TimeLeft, expected_stages

WORK = "cmfsim.desk.work:"
# The kinds of work, in words, with the stages that are expected.
HEAD_STAGES = ("reading the image", "segmenting the head", "finding the landmarks")
KINDS: Mapping[str, tuple[str, Mapping[str, float]]] = {
    "set_up": ("Reading the files", {}),
    "open_head": ("Opening the head", {name: BUILDING[name] for name in HEAD_STAGES}),
    "compute": (
        "Computing the plan operator",
        {**BUILDING, **{n: s for n, s in PLANNING.items() if "correct" not in n}},
    ),
    "report": (
        "Predicting and writing the report",
        expected_stages("solving M+S", "writing M+S", REPORT_STAGE),
    ),
}


class Session:
    """A folder on the desk: its case file, and what was made of it since the launch.

    made: What "set_up", "open_head", "compute" and "report" gave.
    reported: The text of the case file of which the report is.
    """

    def __init__(self, folder: Path) -> None:
        self.case_file = (folder / CASE_FILE if folder.is_dir() else folder).resolve()
        self.made: dict[str, Answer] = {}
        self.reported = ""
        self.changing = threading.Lock()
        self._asking = threading.Lock()
        self._worker: Worker | None = None
        self._kind = self._stage = self._error = ""
        self._left = TimeLeft({})
        self._cancelled = False

    # The case file ----------------------------------------------------------------------------

    def text(self) -> str:
        """The text of the case file; empty where there is none."""
        try:
            return self.case_file.read_text(encoding="utf-8")
        except FileNotFoundError:
            return ""
        except UnicodeDecodeError as error:
            raise CaseInputError(f"{self.case_file.name}: is not UTF-8 ({error})") from error

    def case(self) -> Case:
        """The case as its file is now."""
        return Case.load(self.case_file)

    @property
    def head(self) -> Answer | None:
        """Surfaces, sites and findings of the head, once it is open."""
        return self.made.get("open_head")

    def points(self) -> dict[str, Any]:
        """The sites of the skull by which procedures are placed, mm."""
        if self.head is None:
            raise CaseInputError("the head is not open yet: wait until its surfaces are shown")
        return {name: np.array(point) for name, point in self.head.values["skull"].items()}

    # Work -------------------------------------------------------------------------------------

    @property
    def busy(self) -> bool:
        """Whether a work runs."""
        return bool(self._kind)

    def begin(self) -> None:
        """Goes on as far as it can without the user: sets up the case, and opens the head."""
        text = self.text()
        if not open_questions(text):
            self.start("open_head" if text else "set_up")

    def start(self, kind: str) -> None:
        """Starts a work, whose answer is kept in `made`; `RefusedError` while another one runs."""
        with self._asking:
            self._refuse_busy()
            if kind in {"compute", "report"}:
                # Until it has ended well there is none: the one before is of an earlier plan.
                self.made.pop(kind, None)
            self._kind, self._stage, self._error, self._cancelled = kind, "", "", False
        threading.Thread(target=self._run, args=(kind,), daemon=True).start()

    def _refuse_busy(self) -> None:
        if self.busy:
            raise RefusedError(409, f"still at work: {KINDS[self._kind][0].lower()}")

    def _run(self, kind: str) -> None:
        try:
            self._work(kind)
            if kind == "set_up" and not open_questions(self.text()):
                self._work("open_head")
        except WorkerEndedError as error:
            died = f"the work ended with exit code {error.code}, perhaps out of memory: try again"
            self._error = "stopped" if self._cancelled else died
        except (CmfsimError, OSError) as error:
            self._error = str(error)
        except Exception as error:  # noqa: BLE001 (shown on the page, which would wait for ever)
            self._error = f"{type(error).__name__}: {error}"
        finally:
            self._kind = ""

    def _work(self, kind: str) -> None:
        self._kind, self._left = kind, TimeLeft(KINDS[kind][1])
        worker = self._living()
        if self._cancelled:
            # Before there was anything to end.
            raise WorkerEndedError(-signal.SIGTERM)
        self.made[kind] = worker.ask(f"{WORK}{kind}", {"case_file": str(self.case_file)})

    def ask(self, function: str, **arguments: Any) -> Answer:
        """The answer of the worker to a short question, unless it is at work: `RefusedError`."""
        with self._asking:
            self._refuse_busy()
            arguments["case_file"] = str(self.case_file)
            return self._living().ask(f"{WORK}{function}", arguments)

    def _living(self) -> Worker:
        if self._worker is None or not self._worker.alive:
            # A plan operator that was in it is gone as well.
            self.made.pop("compute", None)
            if self._worker is not None:
                self._worker.end()
            read, write = os.pipe()
            self._worker = Worker(log=write)
            os.close(write)
            threading.Thread(target=self._listen, args=(read,), daemon=True).start()
        return self._worker

    def _listen(self, pipe: int) -> None:
        """Follows the stages of a worker until it ends."""
        with open(pipe, encoding="utf-8", errors="replace") as lines:
            for line in lines:
                if line.startswith(STAGE):
                    self._stage = line[len(STAGE) :].strip()
                    self._left.begin(self._stage)

    def cancel(self) -> None:
        """Stops the work that runs."""
        if self.busy:
            self._cancelled = True
            self.end()

    def end(self) -> None:
        """Ends the worker."""
        if self._worker is None:
            return
        if self.busy and self._worker.alive:
            # The thread that waits for its answer tidies up.
            with contextlib.suppress(OSError):
                os.kill(self._worker.pid, signal.SIGTERM)
        else:
            self._worker.end()

    # What the pages show ------------------------------------------------------------------------

    def work(self) -> dict[str, Any] | None:
        """The work that runs, with its stage, the share that is done, and the seconds left."""
        if not (kind := self._kind):
            return None
        words, expected = KINDS[kind]
        share, left = self._left.estimate() if expected else (None, None)
        return {"name": words, "stage": self._stage, "share": share, "left": left}

    def state(self) -> dict[str, Any]:
        """What every page asks for: the work, errors, and what there is."""
        values: dict[str, Any] = {
            "work": self.work(),
            "error": self._error,
            "is_open": self.head is not None,
            "planned": "compute" in self.made,
            "digits": "",
            "files": [],
            "findings": self._findings(),
        }
        try:
            case = self.case() if (text := self.text()) and not open_questions(text) else None
        except (CmfsimError, OSError) as error:
            return {**values, "error": str(error)}
        if case is not None:
            matrices = [m.matrix for m in case.plan.values()]
            if all(m is not None for m in matrices):
                plan = {n: m.matrix for n, m in case.plan.items() if m.matrix is not None}
                values["digits"] = plan_digits(plan)
            if text == self.reported:
                made = self.made.get("report")
                values["files"] = [] if made is None else [*made.values["files"]]
        return values

    def _findings(self) -> list[dict[str, Any]]:
        """What was noticed so far, each once."""
        parts = [answer.values for kind, answer in self.made.items() if kind != "set_up"]
        return [*{f["what"]: f for part in parts for f in part["findings"]}.values()]
