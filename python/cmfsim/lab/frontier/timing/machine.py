"""The machine on which a bench ran."""

import os
import platform
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np

from cmfsim._core import __version__


def machine(threads: int | None) -> dict[str, Any]:
    """Processor, cores and threads, versions and commit: plain values.

    Parameters
    ----------
    threads : int or None
        That processes were given; all cores if None.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {
        "processor": _processor(),
        "cores": cores,
        "threads": cores if threads is None else threads,
        "system": platform.system(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "cmfsim": __version__,
        "commit": _commit(),
    }


def _processor() -> str:
    """The name of the processor, as far as the system tells it."""
    file = Path("/proc/cpuinfo")
    if file.exists():
        for line in file.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _commit() -> str | None:
    """The commit that the source is at; None where the package is installed or there is no git."""
    git = shutil.which("git")
    source = Path(__file__).parents[3]
    if git is None or not (source / ".git").exists():
        return None
    done = subprocess.run(  # noqa: S603 (git, with our own words)
        [git, "-C", str(source), "rev-parse", "--short", "HEAD"],
        capture_output=True,
        text=True,
        check=False,
    )
    return done.stdout.strip() or None
