"""The peak memory of this process."""

import sys
from importlib import import_module
from pathlib import Path

STATUS = Path("/proc/self/status")


def peak_memory() -> float | None:
    """The largest resident memory of this process so far, MB (10⁶ bytes); None on Windows.

    Linux hands the peak of a parent on to `ru_maxrss` of its child, and not to `VmHWM`.
    """
    if STATUS.exists():
        for line in STATUS.read_text(encoding="utf-8").splitlines():
            if line.startswith("VmHWM:"):
                return float(line.split()[1]) * 1024.0 / 1e6
    if sys.platform == "win32":
        return None
    resource = import_module("resource")
    # Bytes on macOS, KiB elsewhere.
    unit = 1.0 if sys.platform == "darwin" else 1024.0
    return float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) * unit / 1e6
