"""The process in which third-party readers run: crashes, hangs and limits end in named errors."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

import cmfsim
from cmfsim.processes import child, worker
from cmfsim.processes.child import ReaderError, read_in_child
from cmfsim.processes.worker import Answer, ReadLimits

HERE = "child_tasks"
FOLDER = Path(__file__).parents[1]


def test_values_and_arrays_come_back_as_they_were_made():
    answer = read_in_child(f"{HERE}:arrays", count=5)
    assert answer.values == {"name": "five", "none": None}
    assert np.array_equal(answer.arrays["floats"], np.arange(5.0)[:, None] * np.ones(3))
    assert answer.arrays["empty"].shape == (0, 3)
    assert answer.arrays["bytes"].dtype == np.uint8


@pytest.mark.parametrize("kind", ["ImageError", "ImageInputError", "FileNotFoundError"])
def test_an_error_keeps_its_class_and_text(kind):
    expected = {"FileNotFoundError": FileNotFoundError, "ImageError": cmfsim.ImageError}
    with pytest.raises(expected.get(kind, cmfsim.ImageError), match="slice 7"):
        read_in_child(f"{HERE}:fail", kind=kind)


def test_other_errors_name_themselves():
    with pytest.raises(ReaderError, match=r"its reader failed \(slice 7"):
        read_in_child(f"{HERE}:fail", kind="ZeroDivisionError")


@pytest.mark.skipif(os.name != "posix", reason="signals are POSIX")
@pytest.mark.parametrize("name", ["SIGSEGV", "SIGABRT"])
def test_a_crash_is_an_error_and_the_next_file_is_read(name):
    with pytest.raises(ReaderError, match=name):
        read_in_child(f"{HERE}:crash", number=int(getattr(signal, name)))
    assert read_in_child(f"{HERE}:arrays", count=1).values["name"] == "five"


def test_a_reader_that_never_ends_is_stopped():
    begun = time.monotonic()
    with pytest.raises(ReaderError, match="took longer than a file"):
        read_in_child(f"{HERE}:spin", ReadLimits(seconds=1.0))
    with pytest.raises(ReaderError, match="took longer than a file"):
        read_in_child(f"{HERE}:sleep", ReadLimits(seconds=0.2))
    assert time.monotonic() - begun < 30.0


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks at processes on Linux")
def test_a_reader_that_gets_no_turn_is_waited_for(monkeypatch):
    """On a busy machine a valid file would be refused; what it may use is processor time."""
    read_in_child(f"{HERE}:arrays", count=1)
    monkeypatch.setattr(worker, "WALL_PER_CPU", 0.05)
    limits = ReadLimits(seconds=4.0)
    assert read_in_child(f"{HERE}:compute", limits, seconds=1.0).values == {"done": True}
    with pytest.raises(ReaderError, match="took longer than a file"):
        read_in_child(f"{HERE}:sleep", limits)


def test_the_start_of_libraries_is_no_part_of_the_time_of_a_file(monkeypatch):
    """Neither is one that is missing an error of its own: the task reports it."""
    monkeypatch.setenv("CMFSIM_SLOW_LIBRARY", "1")
    child._end()
    limits = ReadLimits(seconds=0.5)
    assert read_in_child(f"{HERE}:with_library", limits).values == {"read": True}


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="looks at processes on Linux")
def test_a_child_that_keeps_memory_is_replaced(monkeypatch):
    """Libraries that leak at damaged files would take all of it, file by file."""
    monkeypatch.setattr(child, "MOST_HELD", 2**29)
    assert read_in_child(f"{HERE}:keep", size=2**20).values == {"kept": 1}
    assert read_in_child(f"{HERE}:keep", size=2**20).values == {"kept": 2}
    assert read_in_child(f"{HERE}:keep", size=2**29).values == {"kept": 3}
    assert read_in_child(f"{HERE}:keep", size=2**20).values == {"kept": 1}


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="limits memory on Linux")
def test_a_reader_that_asks_for_all_memory_is_stopped():
    with pytest.raises(ReaderError, match="memory"):
        read_in_child(f"{HERE}:allocate", ReadLimits(memory=2**28), size=2**40)


def test_what_a_library_prints_does_not_get_into_answers():
    assert read_in_child(f"{HERE}:chatter").values == {"read": True}


@pytest.mark.skipif(os.name != "posix", reason="signals are POSIX")
def test_ctrl_c_ends_a_reader_that_hangs():
    threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGINT)).start()
    begun = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        read_in_child(f"{HERE}:sleep", ReadLimits(seconds=60.0))
    assert time.monotonic() - begun < 20.0
    assert read_in_child(f"{HERE}:arrays", count=1).values["name"] == "five"


def test_one_process_serves_many_files():
    read_in_child(f"{HERE}:arrays", count=1)
    process = child._children[0].pid
    assert isinstance(read_in_child(f"{HERE}:arrays", count=1), Answer)
    with pytest.raises(cmfsim.ImageError):
        read_in_child(f"{HERE}:fail", kind="ImageError")
    assert isinstance(read_in_child(f"{HERE}:arrays", count=1), Answer)
    assert child._children[0].pid == process


LIMITED = """
import resource, sys
from cmfsim.processes.child import read_in_child
which, limit = getattr(resource, sys.argv[1]), int(sys.argv[2])
resource.setrlimit(which, (limit, limit))
print(read_in_child("child_tasks:arrays", count=1).values["name"])
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits as Linux has them")
@pytest.mark.parametrize(("name", "limit"), [("RLIMIT_AS", 2**31), ("RLIMIT_CPU", 20)])
def test_limits_of_the_user_below_those_of_a_reader_hold_and_break_nothing(name, limit):
    """`ulimit -v` and `ulimit -t` broke every reader: a hard limit cannot be exceeded."""
    line = [sys.executable, "-c", LIMITED, name, str(limit)]
    done = subprocess.run(line, capture_output=True, check=False, text=True, cwd=FOLDER)
    assert (done.returncode, done.stdout) == (0, "five\n"), done.stderr
