"""What the child process is asked to do in `test_child.py`."""

import builtins
import importlib
import os
import sys
import time

import numpy as np

from cmfsim import errors
from cmfsim.processes.worker import Answer


def arrays(count):
    rows = np.arange(float(count))[:, None] * np.ones(3)
    found = {"floats": rows, "empty": np.zeros((0, 3)), "bytes": np.zeros(3, np.uint8)}
    return Answer({"name": "five", "none": None}, found)


def fail(kind):
    raise (getattr(errors, kind, None) or getattr(builtins, kind))("slice 7 is not there")


def crash(number):
    os.kill(os.getpid(), number)
    time.sleep(5.0)


def spin():
    while True:
        pass


def sleep():
    time.sleep(600.0)


def allocate(size):
    return Answer({}, {"all": np.ones(size, np.uint8)})


# The first may take seconds to import, and the second is not there.
LIBRARIES = ("slow_library", "no_such_library")


def with_library():
    importlib.import_module("slow_library")
    return Answer({"read": True}, {})


KEPT = []


def keep(size):
    KEPT.append(np.ones(size, np.uint8))
    return Answer({"kept": len(KEPT)}, {})


def compute(seconds):
    begun = time.process_time()
    while time.process_time() - begun < seconds:
        pass
    return Answer({"done": True}, {})


def chatter():
    os.write(1, b"warning: 12\n")
    print("warning: 13")  # noqa: T201 (what libraries do)
    sys.stdout.flush()
    return Answer({"read": True}, {})
