"""Tests a wheel as a user would: installs it into a new environment and runs the demo there.

`python scripts/try_wheel.py dist` takes the one wheel of a folder. It fails where the wheel lacks
its licence files, cannot be installed, is not what the new environment imports, or where the demo
does not end with exit code 0 and its files.
"""

import os
import subprocess
import sys
import tempfile
import venv
import zipfile
from pathlib import Path

EXTRAS = "imaging,mesh,report"
LICENCES = ("LICENSE-MIT", "LICENSE-APACHE", "THIRD-PARTY-NOTICES.md")
# What the demo writes into the folder of its case.
DEMO_FILES = ("report.html", "prediction.vtp", "prediction.stl", "prediction.json", "metrics.json")


def main(arguments: list[str]) -> int:
    """Prints what was tried; 1 with the reason where something is wrong."""
    folder = Path(arguments[0] if arguments else "dist")
    wheels = sorted(folder.glob("cmfsim-*.whl"))
    if len(wheels) != 1:
        return failed(f"{folder} holds {len(wheels)} wheels of cmfsim: one is needed")
    wheel = wheels[0].resolve()
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    for licence in LICENCES:
        if not any(".dist-info/" in name and name.endswith(f"/{licence}") for name in names):
            return failed(f"{wheel.name} does not hold {licence}")
    with tempfile.TemporaryDirectory(prefix="cmfsim-wheel-") as place:
        return tried(wheel, Path(place))


def tried(wheel: Path, place: Path) -> int:
    """Installs the wheel below `place` and runs the demo there."""
    venv.EnvBuilder(with_pip=True).create(place / "env")
    bin_folder = place / "env" / ("Scripts" if os.name == "nt" else "bin")
    python = str(bin_folder / "python")
    # Nothing of this environment or of the working folder may be found in the place of the wheel.
    clean = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "VIRTUAL_ENV"))}
    clean["CMFSIM_DATA"] = str(place / "none")

    def run(*command: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(  # noqa: S603
            command, cwd=place, env=clean, text=True, capture_output=True, check=False
        )

    print(f"installing {wheel.name}[{EXTRAS}] into a new environment", flush=True)
    done = run(python, "-m", "pip", "install", "--quiet", f"{wheel}[{EXTRAS}]")
    if done.returncode != 0:
        return failed(f"pip ended with {done.returncode}:\n{done.stderr}")
    where = run(python, "-c", "import cmfsim; print(cmfsim.__file__)").stdout.strip()
    if not Path(where).resolve().is_relative_to((place / "env").resolve()):
        return failed(f"cmfsim is imported from {where!r}, not from the new environment")
    print("running the demo", flush=True)
    done = run(str(bin_folder / "cmfsim"), "demo", str(place / "demo"), "--no-open")
    if done.returncode != 0:
        return failed(f"cmfsim demo ended with {done.returncode}:\n{done.stdout}{done.stderr}")
    found = {path.name for path in (place / "demo").rglob("*") if path.stat().st_size > 0}
    lacking = [name for name in DEMO_FILES if name not in found]
    if lacking:
        return failed(f"the demo did not write {', '.join(lacking)}")
    print(f"{wheel.name}: installed, demo done, {len(found)} files")
    return 0


def failed(reason: str) -> int:
    """Exit code 1, its reason on standard error."""
    print(reason, file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
