"""cmfsim in a separate process: its arguments, its progress, and its end."""

import json
import subprocess
import sys
import tempfile
from dataclasses import dataclass

# Stages of a prediction with the share of the time that has passed when each begins, as measured
# on a head of 185 000 tets. Stages that are not listed leave the bar where it is.
STAGES = (
    ("checking", 0.02),
    ("reading", 0.10),
    ("segmenting", 0.15),
    ("measuring distances", 0.18),
    ("cutting", 0.30),
    ("finding the soft tissue", 0.35),
    ("filling the tissue", 0.40),
    ("classifying", 0.50),
    ("assembling", 0.53),
    ("placing and sampling", 0.55),
    ("solving", 0.65),
    ("writing", 0.90),
)
PREFIX = "cmfsim: "


@dataclass
class Line:
    """A line that cmfsim printed: the stage, and the progress (0 to 1) if it is known."""

    text: str
    share: float | None = None


def predict_command(case, model, *, python=None):
    """The arguments that predict a case and write a bundle for Slicer."""
    return [*_command("predict", case, model, python), "--slicer", "--no-report"]


def page_command(case, model, *, python=None):
    """The arguments that write the planning page of a case, without opening it."""
    return [*_command("plan", case, model, python), "--no-open"]


def pieces_command(case, model, *, python=None):
    """The arguments that build the model of a case, with a file for each piece of bone."""
    del model
    return [python or sys.executable, "-m", "cmfsim", "build", str(case), "--json"]


def _command(name, case, model, python):
    words = [python or sys.executable, "-m", "cmfsim", name, str(case), "--model", model]
    return [*words, "--json"]


def words_of(answer):
    """The error in words, from the output of a failed prediction."""
    errors = [f for f in answer.get("findings", []) if f["severity"] == "error"]
    found = [f"{finding['what']}. {finding['fix']}" for finding in errors]
    return "\n".join(found) or answer.get("error", {}).get("text", "stopped")


def progress_of(line):
    """The meaning of a line printed by cmfsim."""
    text = line.strip().removeprefix(PREFIX)
    share = next((part for start, part in STAGES if text.startswith(start)), None)
    return Line(text, share)


class Run:
    """A running prediction, polled by a timer: `poll` never waits."""

    def __init__(self, words):
        # Both streams go to files: a pipe that nobody reads would stop the process.
        self._out = tempfile.TemporaryFile()  # noqa: SIM115 (lives as long as the run)
        self._err = tempfile.TemporaryFile()  # noqa: SIM115 (lives as long as the run)
        self._read = 0
        self._process = subprocess.Popen(
            words, stdin=subprocess.DEVNULL, stdout=self._out, stderr=self._err
        )

    def poll(self):
        """The new lines."""
        self._err.seek(self._read)
        data = self._err.read()
        whole = data.rpartition(b"\n")[0]
        self._read += len(whole) + 1 if whole else 0
        return [progress_of(line) for line in whole.decode("utf-8", "replace").splitlines()]

    @property
    def code(self):
        """The exit code; None while it runs."""
        return self._process.poll()

    def stop(self):
        """Ends the process; earlier results stay unchanged."""
        if self._process.poll() is None:
            self._process.terminate()
            self._process.wait(timeout=30)

    def close(self):
        """Ends the process if it runs, and releases its resources."""
        self.stop()
        self._out.close()
        self._err.close()

    def answer(self):
        """The JSON output of the process; its error in words if it failed."""
        self._out.seek(0)
        lines = self._out.read().decode("utf-8", "replace").strip().splitlines()
        try:
            return json.loads(lines[-1])
        except (IndexError, ValueError):
            self._err.seek(0)
            text = self._err.read().decode("utf-8", "replace").strip()
            return {"error": {"kind": "Crash", "text": text[-2000:] or "cmfsim ended silently"}}
