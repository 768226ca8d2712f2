"""Values that tests of several files need, made once in a run of the suite, whatever process asks.

They are pickled in the folder of temporary files that the processes of pytest-xdist share, which
every run creates for itself: no value outlives the code that made it.
"""

import contextlib
import hashlib
import json
import logging
import os
import pickle
import threading
import traceback
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from importlib import import_module
from pathlib import Path
from typing import IO, Any

import pytest

import cmfsim
import phantom_case
from cmfsim.lab.virtual.demo import write_demo_case
from cmfsim.muscles import equivalent
from cmfsim.phantom.model import PhantomHead
from cmfsim.pipeline import proposing
from cmfsim.pipeline.building import inputs
from cmfsim.pipeline.building.stages import BuildOptions
from cmfsim.pipeline.predicting import build_patient
from cmfsim.processes.worker import Answer, WorkerFailedError
from cmfsim.values.musculature import MuscleSurface

try:
    import fcntl
except ImportError:  # Windows: two processes may make the same value, and either is right.
    fcntl = None

# Tet edges of the coarse patient, mm.
COARSE_EDGE = 14.0
# Muscles that a process keeps ready to be sampled: those of three heads, 50 MB each.
MOST_MUSCLES = 3 * 38


def shared(temporary: pytest.TempPathFactory, name: str, make: Callable[[Path], Any]) -> Any:
    """The value of a name; `make` is given a new folder and called if nobody has made it yet."""
    base = temporary.getbasetemp()
    folder = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    path = folder / f"shared-{name}.pickle"
    with _locked(path.with_suffix(".lock")):
        if not path.exists():
            value = make(temporary.mktemp(name))
            part = path.with_suffix(f".{os.getpid()}")
            with part.open("wb") as file:
                _Pickler(file, pickle.HIGHEST_PROTOCOL).dump(value)
            part.replace(path)
    return pickle.loads(path.read_bytes())


class _Pickler(pickle.Pickler):
    """Splines of the core, which muscles keep, travel as what they are made of."""

    def reducer_override(self, value: Any) -> Any:
        if isinstance(value, cmfsim.ThinPlateSpline):
            return cmfsim.ThinPlateSpline, (value.source, value.target, value.smoothing)
        return NotImplemented


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    """While one process is in here, others wait; a process that dies lets go."""
    with path.open("w") as file:
        if fcntl is not None:
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def coarse_demo_patient(temporary: pytest.TempPathFactory) -> cmfsim.PatientModel:
    """The patient of the embedded case on a coarse mesh, with muscles and sliding tissue."""

    def make(folder: Path) -> cmfsim.PatientModel:
        made = write_demo_case(folder, edge_length=COARSE_EDGE)
        return build_patient(made.case, ("M+S",), BuildOptions(anatomy=made.anatomy, check=False))

    return shared(temporary, "coarse-demo-patient", make)


def drawn_levels(temporary: pytest.TempPathFactory, spacing: float) -> cmfsim.Anatomy:
    """The phantom as it was drawn, as levels of a spacing in mm."""
    return shared(
        temporary, f"drawn-levels-{spacing:g}", lambda _: cmfsim.make_head().anatomy(spacing)
    )


def phantom_model(temporary: pytest.TempPathFactory) -> cmfsim.PatientModel:
    """The model of the phantom's surfaces, as `phantom_case` writes them."""

    def make(folder: Path) -> cmfsim.PatientModel:
        head, anatomy = cmfsim.make_head(), drawn_levels(temporary, 2.0)
        return cmfsim.build_model(phantom_case.surface_case(folder, head, anatomy), check=False)

    return shared(temporary, "phantom-model", make)


def remember(patch: pytest.MonkeyPatch, temporary: pytest.TempPathFactory) -> None:
    """Has slow steps of drawing and reading a head be made once in a run for equal arguments.

    They give plain values. Two seconds for a head that is drawn, four for surfaces of a head and
    their levels, seven for the landmarks found on them.
    """
    for module, name in (
        (inputs, "repair_surface"),
        (inputs, "anatomy_from_surfaces"),
        (proposing, "landmarks_from"),
    ):
        patch.setattr(module, name, _remembered(getattr(module, name), temporary))
    levels = PhantomHead._levels

    def drawn_as(parameters: cmfsim.HeadParameters, *given: Any) -> Any:
        return levels(cmfsim.make_head(parameters), *given)

    drawn = _remembered(drawn_as, temporary)
    patch.setattr(PhantomHead, "_levels", lambda head, *given: drawn(head.parameters, *given))


def _remembered(step: Callable[..., Any], temporary: pytest.TempPathFactory) -> Callable[..., Any]:
    def call(*given: Any, **named: Any) -> Any:
        digest = hashlib.sha256(pickle.dumps((given, named))).hexdigest()
        return shared(temporary, f"{step.__name__}-{digest}", lambda _: step(*given, **named))

    return call


_ready, _ready_muscles = equivalent._ready, OrderedDict[str, Any]()


def keep_muscles(patch: pytest.MonkeyPatch) -> None:
    """Has the search trees and fibres of equal muscles be found once in this process.

    They are the core's, and stay in it: more than a second for the muscles of a head.
    """

    def once(name: str, muscle: Any) -> Any:
        if not isinstance(muscle, MuscleSurface):
            return _ready(name, muscle)
        digest = hashlib.sha256(pickle.dumps((name, muscle))).hexdigest()
        found = _ready_muscles.pop(digest, None) or _ready(name, muscle)
        _ready_muscles[digest] = found
        while len(_ready_muscles) > MOST_MUSCLES:
            _ready_muscles.popitem(last=False)
        return found

    patch.setattr(equivalent, "_ready", once)


def without_drawings(patch: pytest.MonkeyPatch) -> None:
    """Has results that this process writes be without pictures, as where none is wanted."""
    patch.setattr("cmfsim.pipeline.outputs.results._pictures_of", lambda *_: iter(()))
    patch.setattr("cmfsim.pipeline.outputs.results.Painter.load", lambda _: None)


def without_pictures(patch: pytest.MonkeyPatch, folder: Path) -> None:
    """Has processes be without PyVista, by a folder: pictures take most time."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "pyvista.py").write_text("raise ImportError('left out')", encoding="utf-8")
    # This process draws, and has loaded it before.
    with contextlib.suppress(ImportError):
        import_module("pyvista")
    patch.syspath_prepend(folder)
    patch.setenv("PYTHONPATH", str(folder), prepend=os.pathsep)


def without_processes(patch: pytest.MonkeyPatch) -> None:
    """Has jobs of studies and populations be worked on in this process, which shares values.

    A process for each patient imports everything and reads every surface again: half of its time.
    For tests of what is written; cli/test_crash_safety.py and processes/ test the processes.
    """
    patch.setattr("cmfsim.processes.parallel.Worker", _Here)


class _Here:
    """Answers as a `Worker` does, and writes what the package logs where a worker would."""

    turn = threading.Lock()

    def __init__(self, *, threads: int | None = None, log: IO[bytes] | None = None) -> None:
        del threads
        self.log = _LogTo(log)

    def __enter__(self) -> "_Here":
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def ask(self, function: str, arguments: Mapping[str, Any]) -> Answer:
        """The answer of a function of the package to plain values."""
        module, name = function.split(":")
        package = logging.getLogger("cmfsim")
        with self.turn:
            package.addHandler(self.log)
            try:
                found = getattr(import_module(module), name)(**json.loads(json.dumps(arguments)))
            except cmfsim.CmfsimError:
                raise
            except Exception as error:
                kinds = [kind.__name__ for kind in type(error).__mro__]
                raise WorkerFailedError(kinds, str(error), traceback.format_exc()) from error
            finally:
                package.removeHandler(self.log)
        return found if isinstance(found, Answer) else Answer(json.loads(json.dumps(found)))

    def end(self) -> None:
        """Nothing: there is no process."""


class _LogTo(logging.Handler):
    """Writes as processes of the package do, if there is a file."""

    def __init__(self, log: IO[bytes] | None) -> None:
        super().__init__(logging.WARNING)
        self.file = log

    def emit(self, record: logging.LogRecord) -> None:
        if self.file is not None:
            self.file.write(f"cmfsim: {record.getMessage()}\n".encode())
            self.file.flush()
