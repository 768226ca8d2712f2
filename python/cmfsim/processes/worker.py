"""A process that runs functions of the package: with limits, a log, and an end with its parent.

It needs no `if __name__ == "__main__"` in the user's script, as those of `multiprocessing` do. Its
standard input is a pipe from its parent that the system closes however the parent ends; the worker
then ends at once, whatever it is doing.
"""

import contextlib
import json
import math
import os
import queue
import signal
import struct
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from cmfsim import errors
from cmfsim.errors import CaseError, CaseInputError, CmfsimError

# The worker's program: it finds the same modules as its parent, and nothing else is run. Ctrl-C is
# the parent's, who ends it.
PROGRAM = (
    "import json, signal, sys; signal.signal(signal.SIGINT, signal.SIG_IGN);"
    "sys.path[:] = json.loads(sys.argv.pop());"
    "from cmfsim.processes.worker import serve; serve()"
)
# Read when numpy and the extension are loaded; with one thread sums have one order everywhere.
THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "RAYON_NUM_THREADS")
# A log that nobody reads.
SILENT = subprocess.DEVNULL
# Wall time that a request may take, in units of its processor time: on a busy machine a process
# waits, and one that sleeps for ever is found as well.
WALL_PER_CPU = 6.0
# Looks at a process that is late, and the time between them, s: it may wait for the disk just then.
LOOKS, LOOK_EVERY = 5, 0.02
# Time in which a process that has closed its pipes ends by itself, s.
ENDING = 10.0
# Lengths of answers: unsigned, 64 bits, little-endian.
LENGTH = struct.Struct("<Q")


class WorkerEndedError(CaseError):
    """A worker process ended before it answered, perhaps because it was late.

    code: Its exit code; minus the signal that ended it.
    """

    def __init__(self, code: int, late: bool = False) -> None:  # noqa: FBT001, FBT002 (pickled so)
        super().__init__(code, late)
        self.code = code
        self.late = late

    def __str__(self) -> str:
        return (
            f"a worker process died (exit code {self.code}), perhaps out of memory: run the "
            "command again, with fewer workers; what is complete is kept"
        )


class WorkerFailedError(CaseError):
    """A function raised an error that is not of the package, but of these kinds, its own first."""

    def __init__(self, kinds: list[str], text: str, trace: str) -> None:
        super().__init__(kinds, text, trace)
        self.kinds = kinds
        self.text = text
        self.trace = trace

    def __str__(self) -> str:
        return f"{self.kinds[0]} in a worker process:\n{self.trace}"


@dataclass(frozen=True)
class ReadLimits:
    """What one request may use.

    seconds: Processor time; six times as much on the clock, more on a busy machine.
    memory: Bytes beyond what the worker holds when the request begins; on Linux only.
    """

    seconds: float = 8.0
    memory: int = 4 * 2**30


@dataclass(frozen=True, eq=False)
class Answer:
    """What a function returns: plain values that JSON holds, and arrays by name."""

    values: Any
    arrays: Mapping[str, NDArray[Any]] = field(default_factory=dict)


class Worker:
    """A process that calls functions one after the other; it ends with a `with` statement.

    threads: Of the core and of numpy; those of this process by default.
    log: What the process and its libraries print is written there; default: standard error.
    """

    def __init__(self, *, threads: int | None = None, log: IO[bytes] | int | None = None) -> None:
        count = {} if threads is None else dict.fromkeys(THREADS, str(threads))
        paths = json.dumps([str(Path(path).absolute()) for path in sys.path])
        self._late = False
        self._parent = os.getpid()
        self._process = subprocess.Popen(  # noqa: S603 (this very Python, and no shell)
            [sys.executable, "-I", "-c", PROGRAM, paths],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            env={**os.environ, **count},
        )
        assert self._process.stdin is not None  # noqa: S101 (asked for, as the next)
        assert self._process.stdout is not None  # noqa: S101
        self._requests, self._answers = self._process.stdin, self._process.stdout

    def __enter__(self) -> "Worker":
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    @property
    def alive(self) -> bool:
        """Whether it can answer, in this process: a fork shares its parent's worker."""
        return self._parent == os.getpid() and self._process.poll() is None

    @property
    def pid(self) -> int:
        """The number of the process."""
        return self._process.pid

    def ask(
        self,
        function: str,
        arguments: Mapping[str, Any],
        limits: ReadLimits | None = None,
        *,
        seconds: float | None = None,
    ) -> Answer:
        """The answer of a function, "module:name", of the package that is called in the process.

        It takes arguments by name and returns an `Answer` or plain values: those that JSON holds.

        seconds: Time on the clock.
        Raises `CmfsimError`: What the function raises, with its class.
        Raises `WorkerFailedError`: It raises an error of another kind.
        Raises `WorkerEndedError`: The process crashed, or passed a limit.
        """
        most = None if limits is None else [limits.seconds, limits.memory]
        request = {"function": function, "arguments": dict(arguments), "limits": most}
        line = json.dumps(request).encode() + b"\n"
        answered = threading.Event()
        if limits is not None:
            seconds = WALL_PER_CPU * limits.seconds
        if seconds is not None:
            watch = (answered, seconds, limits is not None)
            threading.Thread(target=self._watch, args=watch, daemon=True).start()
        try:
            if not self.alive:
                raise EOFError  # noqa: TRY301 (as if it had ended just now)
            self._requests.write(line)
            self._requests.flush()
            answer = self._received()
        except (OSError, EOFError) as error:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(ENDING)
            self.end()
            code = self._process.returncode
            late = self._late or (os.name == "posix" and code == -signal.SIGXCPU)
            raise WorkerEndedError(code, late) from error
        except BaseException:
            # Ctrl-C: what is left of the answer must not become the next one.
            self.end()
            raise
        finally:
            answered.set()
        # An error of the function is a whole answer: the process goes on.
        if isinstance(answer, Exception):
            raise answer
        return answer

    def end(self) -> None:
        """Ends the process, whatever it is doing."""
        if self._parent != os.getpid():
            return
        self._process.kill()
        self._process.wait()
        for stream in (self._requests, self._answers):
            with contextlib.suppress(OSError):
                stream.close()

    def _watch(self, answered: threading.Event, seconds: float, patient: bool) -> None:  # noqa: FBT001
        """Ends the process when it is late; to the patient, one that gets no turn is not.

        The system limits the processor time of those that are waited for so patiently.
        """
        while not answered.wait(seconds):
            if not (patient and _is_running(self.pid)) and not answered.is_set():
                self._late = True
                self._process.kill()
                return

    def _received(self) -> Answer | Exception:
        stream = self._answers
        (length,) = LENGTH.unpack(_bytes(stream, LENGTH.size).tobytes())
        header = json.loads(_bytes(stream, length).tobytes())
        if "kinds" in header:
            return _error_of(**header)
        arrays = {}
        for name, (kind, shape) in header["arrays"].items():
            dtype = np.dtype(kind)
            count = dtype.itemsize * math.prod(shape)
            arrays[name] = _bytes(stream, count).view(dtype).reshape(shape)
        return Answer(header["values"], arrays)


def run_program(
    name: str, words: Sequence[str], given: bytes = b"", *, seconds: float
) -> subprocess.CompletedProcess[bytes]:
    """What another program, given some bytes, printed, and the code that it ended with.

    name, words: What a message calls it; itself and its arguments, which no shell reads.
    """
    try:
        return subprocess.run(  # noqa: S603 (words of ours, and no shell)
            list(words), input=given, capture_output=True, check=False, timeout=seconds
        )
    except OSError as error:
        raise CaseInputError(f"{name} cannot be started: {error}") from error
    except subprocess.TimeoutExpired:
        raise CaseInputError(f"{name} has not ended after {seconds:g} s, and was stopped") from None


def _error_of(kinds: list[str], text: str, trace: str) -> Exception:
    """The error of a class of the package, as it was raised in the process."""
    for kind in kinds:
        found = getattr(errors, kind, None)
        if isinstance(found, type) and issubclass(found, CmfsimError):
            return found(text)
    return WorkerFailedError(kinds, text, trace)


def _bytes(stream: Any, count: int) -> NDArray[np.uint8]:
    data = np.empty(count, np.uint8)
    if stream.readinto(data) < count:
        raise EOFError
    return data


def _is_running(pid: int) -> bool:
    """Whether a process runs or waits for its turn alone; False where the system does not tell."""
    for _ in range(LOOKS):
        try:
            with open(f"/proc/{pid}/stat", encoding="latin-1") as file:  # noqa: PTH123
                state = file.read().rpartition(")")[2].split()[0]
        except (OSError, IndexError):
            return False
        if state == "R":
            return True
        time.sleep(LOOK_EVERY)
    return False


def serve() -> None:
    """Works on requests until standard input ends; then the process ends, whatever it is doing."""
    # What a library prints must not become an answer.
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    lines: queue.SimpleQueue[bytes] = queue.SimpleQueue()

    def read() -> None:
        for line in sys.stdin.buffer:
            lines.put(line)
        os._exit(0)

    threading.Thread(target=read, daemon=True).start()
    while True:
        _work(json.loads(lines.get()), answers)


def _work(request: Mapping[str, Any], answers: BinaryIO) -> None:
    """Calls one function, and writes its answer or error."""
    module, name = request["function"].split(":")
    if request["limits"] is not None:
        _limit(*request["limits"])
    arrays = {}
    try:
        answer = getattr(import_module(module), name)(**request["arguments"])
        if not isinstance(answer, Answer):
            answer = Answer(answer)
        arrays = {name: np.ascontiguousarray(a) for name, a in answer.arrays.items()}
        shapes = {name: (a.dtype.str, a.shape) for name, a in arrays.items()}
        text = json.dumps({"values": answer.values, "arrays": shapes})
    except (Exception, SystemExit) as error:  # noqa: BLE001 (told to the one who asked)
        kinds = [kind.__name__ for kind in type(error).__mro__]
        arrays = {}
        text = json.dumps({"kinds": kinds, "text": str(error), "trace": traceback.format_exc()})
    sys.stdout.flush()
    answers.write(LENGTH.pack(len(text)) + text.encode())
    for array in arrays.values():
        if array.nbytes:
            answers.write(array.data.cast("B"))
    answers.flush()


def _limit(seconds: float, memory: int) -> None:
    """Sets the limits of one request; the system ends a process that passes them.

    They are set as far as the user's own (ulimit) allow: below theirs, theirs hold.
    """
    try:
        resource: Any = import_module("resource")
    except ModuleNotFoundError:  # Windows: the clock alone
        return
    used = resource.getrusage(resource.RUSAGE_SELF)
    spent = used.ru_utime + used.ru_stime
    limits = {resource.RLIMIT_CPU: int(spent + seconds) + 1}
    if sys.platform == "linux":
        with open("/proc/self/statm", encoding="ascii") as file:  # noqa: PTH123
            held = int(file.read().split()[0]) * resource.getpagesize()
        # Libraries that a request loads first count as well: room for them.
        limits[resource.RLIMIT_AS] = held + memory + 2 * 2**30
    for which, limit in limits.items():
        _, hard = resource.getrlimit(which)
        most = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
        resource.setrlimit(which, (most, hard))
