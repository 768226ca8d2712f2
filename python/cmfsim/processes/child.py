"""Third-party readers in a process of their own: a file that crashes or hangs one ends in an error.

Readers written in C++ (ITK, VTK, HDF5) trust what a header says, and a damaged file can take the
process down or keep it busy for ever. They run in one child process per process, which is started
when it is first needed, kept for the next file, and replaced after a crash.
"""

import atexit
import contextlib
import os
import signal
import sys
import threading
from collections.abc import Mapping
from importlib import import_module
from typing import Any

from cmfsim.processes import worker

# Imports the libraries of a task, in this processor time, s.
LOADED, START = "cmfsim.processes.child:load", 60.0
# A child that holds more than this between two files is replaced, bytes.
MOST_HELD = 2**30
# Python's own errors that mean the same in the parent; those of the package do as well.
PLAIN_ERRORS: Mapping[str, type[Exception]] = {
    kind.__name__: kind
    for kind in (FileNotFoundError, IsADirectoryError, PermissionError, OSError, ValueError)
}


class ReaderError(RuntimeError):
    """Why the child gave no answer: it crashed, or passed its limits."""


def read_in_child(
    task: str, limits: worker.ReadLimits | None = None, /, **arguments: Any
) -> worker.Answer:
    """The answer of a function of the package that is called in the child process.

    task: "module:function"; the `LIBRARIES` of the module are imported before its time begins.
    **arguments: Plain values that JSON holds; paths as text, absolute.
    Raises `ReaderError`: The child crashed, or passed a limit: a clause without the file's name.
    Raises `CmfsimError`, `ValueError`, `OSError`: What the function raises, with its class.
    """
    with _LOCK:
        child = _the_child()
        try:
            limits = limits or worker.ReadLimits()
            child.ask(LOADED, {"task": task}, worker.ReadLimits(START, limits.memory))
            return child.ask(task, arguments, limits)
        except worker.WorkerEndedError as error:
            raise ReaderError(_reason(error)) from error
        except worker.WorkerFailedError as error:
            raise _error_of(error) from error
        finally:
            # Libraries that do not give memory back, as GDCM after damaged files.
            if _held_by(child.pid) > MOST_HELD:
                child.end()


def load(task: str) -> None:
    """Imports the module of a task and its `LIBRARIES`."""
    module = task.partition(":")[0]
    # One that is missing is the task's to report.
    with contextlib.suppress(ImportError):
        for name in (module, *getattr(import_module(module), "LIBRARIES", ())):
            import_module(name)


def _reason(ended: worker.WorkerEndedError) -> str:
    if ended.late:
        return "reading it took longer than a file of this size should need"
    if ended.code < 0:
        return f"its reader crashed ({signal.Signals(-ended.code).name})"
    return f"its reader ended with exit code {ended.code}"


def _error_of(failed: worker.WorkerFailedError) -> Exception:
    """The error of a class that Python names, as it was raised in the child."""
    for kind in failed.kinds:
        if kind in PLAIN_ERRORS:
            return PLAIN_ERRORS[kind](failed.text)
    if "MemoryError" in failed.kinds:
        return ReaderError("reading it needed more memory than a file of this size should need")
    return ReaderError(f"its reader failed ({failed.text or failed.kinds[0]})")


def _held_by(pid: int) -> int:
    """Bytes of memory that a process holds; 0 where the system does not tell."""
    try:
        with open(f"/proc/{pid}/statm", encoding="ascii") as file:  # noqa: PTH123
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, IndexError, ValueError, AttributeError):
        return 0


_LOCK = threading.RLock()
_children: list[worker.Worker] = []


def _the_child() -> worker.Worker:
    if not (_children and _children[0].alive):
        _end()
        if not sys.executable:
            message = "cannot be read here: this Python cannot start another (sys.executable)"
            raise ReaderError(message)
        _children.append(worker.Worker(log=worker.SILENT))
    return _children[0]


@atexit.register
def _end() -> None:
    while _children:
        _children.pop().end()
