"""Builds a case several times and compares the files byte by byte: repeat_builds.py CASE --runs 20.

Every other run uses one thread instead of all: neither a race nor the number of threads may change
a result. The run times in build.json are ignored. Exit code 1 if a file differs.
"""

import argparse
import hashlib
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import cmfsim

# Variables that set the number of threads of the core, of numpy and of ITK.
THREADS = (
    "RAYON_NUM_THREADS",
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "ITK_GLOBAL_DEFAULT_NUMBER_OF_THREADS",
)
# What a summary has of the run, not of the head.
OF_THE_RUN = ("timings",)


def main(words: Sequence[str] | None = None) -> int:
    """The exit code; prints the digest of each file and how many runs gave it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("case", type=Path, help="case.toml, or its folder")
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--edge-length", type=float, help="mm, instead of the case's own")
    options = parser.parse_args(words)
    found: dict[str, dict[str, int]] = {}
    seconds = []
    with tempfile.TemporaryDirectory(prefix="cmfsim-repeat-") as folder:
        for run in range(options.runs):
            output = Path(folder) / f"run{run}"
            started = time.perf_counter()
            _build(options.case, output, options.edge_length, one_thread=run % 2 == 1)
            seconds.append(time.perf_counter() - started)
            for name, digest in _digests(output).items():
                counts = found.setdefault(name, {})
                counts[digest] = counts.get(digest, 0) + 1
            print(f"run {run + 1}: {seconds[-1]:.0f} s", file=sys.stderr, flush=True)
    same = all(list(counts.values()) == [options.runs] for counts in found.values())
    print("| file | digests | runs of each | SHA-256 of the first |\n| --- | ---: | --- | --- |")
    for name, counts in sorted(found.items()):
        runs = ", ".join(map(str, counts.values()))
        print(f"| {name} | {len(counts)} | {runs} | `{next(iter(counts))[:16]}` |")
    print(
        f"\n{options.runs} builds, {'all the same' if same else 'NOT the same'}; "
        f"{min(seconds):.0f} to {max(seconds):.0f} s each, {os.cpu_count()} cores; "
        f"{platform.machine()}, cmfsim {cmfsim.__version__}"
    )
    return 0 if same else 1


def _build(case: Path, output: Path, edge_length: float | None, *, one_thread: bool) -> None:
    """Nothing; the model is in a folder, built by a process of its own."""
    words = [sys.executable, "-m", "cmfsim", "build", str(case), "-o", str(output), "-q"]
    if edge_length is not None:
        words += ["--edge-length", str(edge_length)]
    threads = dict.fromkeys(THREADS, "1") if one_thread else {}
    done = subprocess.run(  # noqa: S603 (this very Python)
        words, env={**os.environ, **threads}, capture_output=True, text=True, check=False
    )
    if done.returncode:
        sys.exit(f"cmfsim build ended with exit code {done.returncode}\n{done.stderr}")


def _digests(folder: Path) -> dict[str, str]:
    digests = {}
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        data = path.read_bytes()
        if path.name == "build.json":
            summary = json.loads(data)
            for key in OF_THE_RUN:
                summary.pop(key)
            data = json.dumps(summary).encode()
        digests[path.relative_to(folder).as_posix()] = hashlib.sha256(data).hexdigest()
    return digests


if __name__ == "__main__":
    sys.exit(main())
