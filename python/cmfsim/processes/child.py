"""Third-party readers in a process of their own: a file that crashes or hangs one ends in an error.

Readers written in C++ (ITK, VTK, HDF5) trust what a header says, and a damaged file can take the
process down or keep it busy for ever. They run in one child process per process, which is started
when it is first needed, kept for the next file, and replaced after a crash. A request has limits on
processor time and memory; Ctrl-C ends it at once, and the child ends with its parent.
"""

import atexit
import contextlib
import json
import os
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import IO, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from cmfsim import errors

# The child's program: it finds the same modules as its parent, and nothing else is run.
PROGRAM = (
    "import json, sys; sys.path[:] = json.loads(sys.stdin.buffer.readline());"
    "from cmfsim.processes.child import serve; serve()"
)
# Wall time that a request may take, in units of its processor time: on a busy machine a process
# waits, and one that sleeps for ever is found as well.
WALL_PER_CPU = 6.0
# Processor time in which a task's libraries start, s, and the sign that they have.
START = 60.0
READY = b"+"
# Looks at a process that is late, and the time between them, s: it may wait for the disk just then.
LOOKS, LOOK_EVERY = 5, 0.02
# A child that holds more than this between two files is replaced, bytes.
MOST_HELD = 2**30
# Lengths of answers: unsigned, 64 bits, little-endian.
LENGTH = struct.Struct("<Q")
# Python's own errors that mean the same in the parent; those of the package do as well.
PLAIN_ERRORS: Mapping[str, type[Exception]] = {
    kind.__name__: kind
    for kind in (FileNotFoundError, IsADirectoryError, PermissionError, OSError, ValueError)
}


class ReaderError(RuntimeError):
    """Why the child gave no answer: it crashed, or passed its limits."""


@dataclass(frozen=True)
class ReadLimits:
    """What one request may use.

    Attributes
    ----------
    seconds : float
        Processor time; six times as much on the clock, more where others keep the processor busy.
    memory : int
        Bytes beyond what the child holds when the request begins; on Linux only.
    """

    seconds: float = 8.0
    memory: int = 4 * 2**30

    @classmethod
    def of_bytes(cls, size: int) -> "ReadLimits":
        """Limits for a file of a size in bytes: 8 s and 4 GiB, more where it is large."""
        # The slowest reader here takes 10 MB a second; the greediest, text, 60 bytes per byte.
        return cls(8.0 + size / 5e6, 4 * 2**30 + 64 * size)


@dataclass(frozen=True, eq=False)
class Answer:
    """What a task returns: plain values that JSON holds, and arrays by name."""

    values: Mapping[str, Any]
    arrays: Mapping[str, NDArray[Any]]


def read_in_child(task: str, limits: ReadLimits | None = None, /, **arguments: Any) -> Answer:
    """The answer of a function of the package that is called in the child process.

    Parameters
    ----------
    task : str
        "module:function" within cmfsim; the function takes the arguments by name and returns an
        `Answer`. The module's `LIBRARIES` are imported before its time begins.
    limits : ReadLimits, optional
    **arguments
        Plain values that JSON holds; paths as text, absolute.

    Returns
    -------
    Answer

    Raises
    ------
    ReaderError
        The child crashed, or passed a limit. The text is a clause without the file's name.
    CmfsimError, ValueError, OSError
        What the function raises, with its class.
    """
    with _LOCK:
        return _the_child().answer(task, limits or ReadLimits(), arguments)


class _Child:
    """The child process, as its parent sees it."""

    def __init__(self) -> None:
        if not sys.executable:
            message = "cannot be read here: this Python cannot start another (sys.executable)"
            raise ReaderError(message)
        self.parent = os.getpid()
        self.process = subprocess.Popen(  # noqa: S603 (this very Python, and no shell)
            [sys.executable, "-I", "-c", PROGRAM],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        self._send([os.path.abspath(p) for p in sys.path])  # noqa: PTH100 ("" is the folder here)

    @property
    def alive(self) -> bool:
        """Whether it can answer, in this process: a fork shares its parent's child."""
        return self.parent == os.getpid() and self.process.poll() is None

    def answer(self, task: str, limits: ReadLimits, arguments: Mapping[str, Any]) -> Answer:
        request = {"task": task, "arguments": dict(arguments)}
        try:
            # What the task's libraries take to start is no part of what the file may use.
            with self._watched(START):
                self._send({**request, "seconds": limits.seconds, "memory": limits.memory})
                _exactly(self._answers(), len(READY))
            with self._watched(limits.seconds):
                answer = self._receive()
        except BaseException:
            # Ctrl-C: what is left of the answer must not become the next one.
            self.end()
            raise
        # An error of the task is a whole answer: the process goes on to the next file, unless its
        # libraries did not give memory back, as GDCM after damaged files.
        if _held_by(self.process.pid) > MOST_HELD:
            self.end()
        if isinstance(answer, Exception):
            raise answer
        return answer

    @contextlib.contextmanager
    def _watched(self, seconds: float) -> Iterator[None]:
        """Ends the process when it is late; the error then tells why there was no answer."""
        late, done = threading.Event(), threading.Event()

        def watch() -> None:
            while not done.wait(WALL_PER_CPU * seconds):
                # One that is ready to run and gets no turn is not late: the system limits its
                # processor time.
                if not _is_running(self.process.pid) and not done.is_set():
                    late.set()
                    self.process.kill()
                    return

        threading.Thread(target=watch, daemon=True).start()
        try:
            yield
        except (EOFError, BrokenPipeError, ConnectionResetError) as error:
            raise ReaderError(self._reason(late=late.is_set())) from error
        finally:
            done.set()

    def end(self) -> None:
        """Stops the process; another is started when one is needed."""
        self.process.kill()
        for stream in (self.process.stdin, self.process.stdout):
            if stream is not None:
                with contextlib.suppress(OSError):
                    stream.close()
        self.process.wait()

    def _reason(self, *, late: bool) -> str:
        code = self.process.wait()
        self.end()
        if late or (os.name == "posix" and code == -signal.SIGXCPU):
            return "reading it took longer than a file of this size should need"
        if code < 0:
            return f"its reader crashed ({signal.Signals(-code).name})"
        return f"its reader ended with exit code {code}"

    def _send(self, message: Any) -> None:
        stream = self.process.stdin
        if stream is None:
            raise EOFError
        stream.write(json.dumps(message).encode() + b"\n")
        stream.flush()

    def _answers(self) -> IO[bytes]:
        if self.process.stdout is None:
            raise EOFError
        return self.process.stdout

    def _receive(self) -> Answer | Exception:
        stream = self._answers()
        (length,) = LENGTH.unpack(_exactly(stream, LENGTH.size))
        header = json.loads(_exactly(stream, length))
        if "error" in header:
            return _error_of(header["error"], header["text"])
        arrays = {}
        for name, (dtype, shape) in header["arrays"].items():
            array = np.empty(shape, dtype=dtype)
            _fill(stream, array)
            arrays[name] = array
        return Answer(header["values"], arrays)


def _error_of(kind: str, text: str) -> Exception:
    """The error of a class that the package or Python names, as it was raised in the child."""
    if kind == "MemoryError":
        return ReaderError("reading it needed more memory than a file of this size should need")
    found = PLAIN_ERRORS.get(kind) or getattr(errors, kind, None)
    if isinstance(found, type) and issubclass(found, Exception):
        return found(text)
    return ReaderError(f"its reader failed ({text or kind})")


def _exactly(stream: Any, count: int) -> bytes:
    data = stream.read(count)
    if len(data) < count:
        raise EOFError
    return bytes(data)


def _fill(stream: Any, array: NDArray[Any]) -> None:
    if not array.nbytes:
        return
    view = memoryview(array.data).cast("B")
    done = 0
    while done < len(view):
        count = stream.readinto(view[done:])
        if not count:
            raise EOFError
        done += count


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


def _held_by(pid: int) -> int:
    """Bytes of memory that a process holds; 0 where the system does not tell."""
    try:
        with open(f"/proc/{pid}/statm", encoding="ascii") as file:  # noqa: PTH123
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, IndexError, ValueError, AttributeError):
        return 0


_LOCK = threading.RLock()
_children: list[_Child] = []


def _the_child() -> _Child:
    if _children and not _children[0].alive:
        left = _children.pop()
        if left.parent == os.getpid():
            left.end()
    if not _children:
        _children.append(_Child())
    return _children[0]


@atexit.register
def _end() -> None:
    if _children and _children[0].parent == os.getpid():
        _children.pop().end()


def serve() -> None:
    """Nothing; answers requests from standard input until it ends. The child's main function."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    requests = sys.stdin.buffer
    # What libraries print must not get into the answers.
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    for line in requests:
        request = json.loads(line)
        module, _, function = request["task"].partition(":")
        _limit(START, request["memory"])
        # One that is missing is the task's to report.
        with contextlib.suppress(ImportError):
            for name in (module, *getattr(import_module(module), "LIBRARIES", ())):
                import_module(name)
        answers.write(READY)
        answers.flush()
        _limit(request["seconds"], request["memory"])
        try:
            task: Callable[..., Answer] = getattr(import_module(module), function)
            answer = task(**request["arguments"])
        except Exception as error:  # noqa: BLE001 (its class and text go to the parent)
            names = [k.__name__ for k in type(error).__mro__]
            kind = next((n for n in names if n in PLAIN_ERRORS or hasattr(errors, n)), names[0])
            kind = "MemoryError" if isinstance(error, MemoryError) else kind
            _write(answers, {"error": kind, "text": str(error)}, {})
        else:
            arrays = {name: np.ascontiguousarray(a) for name, a in answer.arrays.items()}
            shapes = {name: (a.dtype.str, a.shape) for name, a in arrays.items()}
            _write(answers, {"values": answer.values, "arrays": shapes}, arrays)


def _write(stream: BinaryIO, header: Any, arrays: Mapping[str, NDArray[Any]]) -> None:
    text = json.dumps(header).encode()
    stream.write(LENGTH.pack(len(text)))
    stream.write(text)
    for array in arrays.values():
        if array.nbytes:
            stream.write(array.data.cast("B"))
    stream.flush()


def _limit(seconds: float, memory: int) -> None:
    """Sets the limits of one request; the system ends a process that passes them."""
    try:
        resource: Any = import_module("resource")
    except ModuleNotFoundError:  # Windows: the clock alone
        return
    used = resource.getrusage(resource.RUSAGE_SELF)
    spent = used.ru_utime + used.ru_stime
    _set_limit(resource, resource.RLIMIT_CPU, int(spent + seconds) + 1)
    if sys.platform == "linux":
        with open("/proc/self/statm", encoding="ascii") as file:  # noqa: PTH123
            held = int(file.read().split()[0]) * resource.getpagesize()
        # Libraries that a request loads first count as well: room for them.
        _set_limit(resource, resource.RLIMIT_AS, held + memory + 2 * 2**30)


def _set_limit(resource: Any, which: int, limit: int) -> None:
    """Sets a limit as far as the user's own (ulimit) allows: below theirs, theirs holds."""
    _, hard = resource.getrlimit(which)
    resource.setrlimit(which, (limit if hard == resource.RLIM_INFINITY else min(limit, hard), hard))
