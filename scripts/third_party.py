"""Checks all third-party licences, and writes those of the wheel's parts.

`python scripts/third_party.py` writes THIRD-PARTY-NOTICES.md, which every wheel holds: each crate
that is compiled into it on any platform, METIS, and their licence texts. `--check` fails where that
file is out of date, where any crate or Python package that the project names has a licence that is
not on the list here, or where a file of METIS under the LGPL would be compiled. Both use `cargo
metadata` and read only the local sources of the crates.
"""

import argparse
import json
import re
import subprocess
import sys
import unicodedata
from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
NOTICES = "THIRD-PARTY-NOTICES.md"
# What a wheel may be made of, and what may build and test it: licences that ask for no more than
# their notice. Where a crate offers several, one of them is enough.
ALLOWED = frozenset(
    {
        "0BSD",
        "Apache-2.0",
        "Apache-2.0 WITH LLVM-exception",
        "BSD-2-Clause",
        "BSD-3-Clause",
        "BSL-1.0",
        "CC0-1.0",
        "HPND",
        "ISC",
        "MIT",
        "MIT-0",
        "MPL-2.0",
        "PSF-2.0",
        "Unicode-3.0",
        "Unlicense",
        "Zlib",
    }
)
# The wheel's crate, and how maturin builds it.
WHEEL_CRATE, WHEEL_FEATURES = "mtm-py", "mtm-core/metis"
# Where METIS is compiled, its sources, and what stands in the place of its LGPL headers.
METIS_BUILD = Path("crates/mtm-core/build.rs")
METIS_CRATE = "metis-sys"
METIS_GUARDS = Path("crates/mtm-core/metis/sorting.h")
# A header that is included on no platform: the build does not define USE_GKREGEX.
METIS_UNUSED = frozenset({"gkregex.h"})
# Python packages that the project needs or its extras name. They are installed beside the wheel
# and are not part of it; their licences are those of the versions that pyproject.toml asks for.
PYTHON: Mapping[str, str] = {
    "numpy": "BSD-3-Clause",
    "SimpleITK": "Apache-2.0",
    "scikit-image": "BSD-3-Clause",
    "scipy": "BSD-3-Clause",
    "pydicom": "MIT",
    "meshio": "MIT",
    "pyvista": "MIT",
    "tqdm": "MPL-2.0 AND MIT",
    "tomli": "MIT",
    "h5py": "BSD-3-Clause",
    "matplotlib": "PSF-2.0",
    "jinja2": "BSD-3-Clause",
    "distributed": "BSD-3-Clause",
    "scikit-fem": "BSD-3-Clause",
    "pyamg": "MIT",
    "starlette": "BSD-3-Clause",
    "uvicorn": "BSD-3-Clause",
    "playwright": "Apache-2.0",
    "slicer-core": "Apache-2.0",
    "pytest": "MIT",
    "pytest-timeout": "MIT",
    "pytest-xdist": "MIT",
    "hypothesis": "MPL-2.0",
    "nbclient": "BSD-3-Clause",
    "nbformat": "BSD-3-Clause",
    "ipykernel": "BSD-3-Clause",
    "nibabel": "MIT",
    "mkdocs-material": "MIT",
    "mkdocstrings": "ISC",
    "mkdocs-jupyter": "Apache-2.0",
    "latex2mathml": "MIT",
    "ruff": "MIT",
    "mypy": "MIT",
    "scipy-stubs": "BSD-3-Clause",
    "maturin": "MIT OR Apache-2.0",
}
INTRODUCTION = """\
The wheel of cmfsim is under MIT or Apache-2.0, as you choose. Its compiled part holds the crates
below (some on other platforms only) and the Rust standard library (MIT or Apache-2.0,
https://www.rust-lang.org). Made by `python scripts/third_party.py`; `make lint` checks that it is
up to date."""
BESIDE_THE_WHEEL = """\
Python packages that cmfsim needs or its extras name are installed beside it and are not part of the
wheel:"""
LICENCE_FILE = re.compile(r"(?i)(un)?licen[cs]e|copying|notice|copyright")
# What the LGPL's own notice says in a source file.
LESSER_GPL = re.compile(r"(?i)lesser\s+(\W+\s+)?general\s+public|GNU\s+Library\s+General")
SPDX_WORD = re.compile(r"\(|\)|[^\s()/]+|/")


def main(arguments: list[str]) -> int:
    """Writes the notices, or prints what is wrong with the licences; 1 if something is."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="write nothing, fail where it differs")
    parser.add_argument("--offline", action="store_true", help="use the local crate cache alone")
    chosen = parser.parse_args(arguments)
    metadata = cargo_metadata(offline=chosen.offline)
    crates = crates_of_wheel(metadata)
    sources = metis_sources(metadata)
    text = notices(crates, sources)
    problems = [*crate_problems(metadata), *python_problems(), *lesser_gpl_files(sources)]
    path = ROOT / NOTICES
    if not chosen.check:
        path.write_text(text, encoding="utf-8")
    elif not path.is_file() or path.read_text(encoding="utf-8") != text:
        problems.append(f"{NOTICES} is out of date: run python scripts/third_party.py")
    for problem in problems:
        print(problem)
    count = len(metadata["packages"])
    print(f"licences: {count} crates, {len(crates)} in the wheel, {len(problems) or 'no'} problems")
    return 1 if problems else 0


def cargo_metadata(*, offline: bool) -> dict[str, Any]:
    """What cargo knows of every crate of the workspace, on every platform."""
    command = ["cargo", "metadata", "--format-version", "1", "--locked"]
    command += ["--features", WHEEL_FEATURES, *(["--offline"] if offline else [])]
    done = subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.PIPE)  # noqa: S603
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def crates_of_wheel(metadata: dict[str, Any]) -> list[dict[str, Any]]:
    """The crates whose code is in the wheel, by name and version: no macros, no build tools."""
    packages = {package["id"]: package for package in metadata["packages"]}
    nodes = {node["id"]: node for node in metadata["resolve"]["nodes"]}
    (wheel,) = [p["id"] for p in metadata["packages"] if p["name"] == WHEEL_CRATE]
    found, waiting = {wheel}, [wheel]
    while waiting:
        for dependency in nodes[waiting.pop()]["deps"]:
            name = dependency["pkg"]
            compiled = any(kind["kind"] is None for kind in dependency["dep_kinds"])
            is_macro = any("proc-macro" in t["kind"] for t in packages[name]["targets"])
            if compiled and not is_macro and name not in found:
                found.add(name)
                waiting.append(name)
    outside = [packages[name] for name in found if packages[name]["source"] is not None]
    return sorted(outside, key=lambda p: (p["name"], p["version"]))


def crate_problems(metadata: dict[str, Any]) -> Iterator[str]:
    """Crates, of build and tests too, whose licence is not allowed."""
    for package in metadata["packages"]:
        licence = package["license"]
        if not licence:
            yield f"crate {package['name']} {package['version']} states no licence"
        elif not is_allowed(licence):
            yield (
                f"crate {package['name']} {package['version']} is under {licence!r}: allowed are "
                f"{', '.join(sorted(ALLOWED))}"
            )


def python_problems() -> Iterator[str]:
    """Python packages of pyproject.toml without an allowed licence in PYTHON."""
    named = python_packages()
    for name in named:
        if name not in PYTHON:
            yield f"pyproject.toml names {name}: add it and its licence to scripts/third_party.py"
        elif not is_allowed(PYTHON[name]):
            yield f"Python package {name} is under {PYTHON[name]!r}, which is not allowed"


def python_packages() -> list[str]:
    """The packages that the project or an extra of it asks for, in the order of pyproject.toml."""
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    tables = re.search(r"^dependencies = .*?^\[project\.scripts\]", text, re.DOTALL | re.MULTILINE)
    quoted = re.findall(r"^[^#\n]*", tables[0] if tables else "", re.MULTILINE)
    names = re.findall(r'"([A-Za-z][\w.-]*)', "\n".join(quoted))
    return [name for name in dict.fromkeys(names) if name != "cmfsim"]


def metis_sources(metadata: dict[str, Any]) -> Path:
    """The folder with the sources of METIS and GKlib, which the build compiles in part."""
    (crate,) = [p for p in metadata["packages"] if p["name"] == METIS_CRATE]
    return Path(crate["manifest_path"]).parent / "vendor"


def compiled_files(sources: Path) -> list[Path]:
    """The files of METIS and GKlib that the build names."""
    text = (ROOT / METIS_BUILD).read_text(encoding="utf-8")
    names = set(re.findall(r'"(\w+\.c)"', text)) - {"absent.c"}
    folders = (sources / "metis/libmetis", sources / "GKlib")
    found = [folder / name for name in sorted(names) for folder in folders]
    # graph.c is in both folders, and METIS's own is meant.
    return [path for path in found if path.is_file() and path != sources / "GKlib/graph.c"]


def lesser_gpl_files(sources: Path) -> Iterator[str]:
    """Files of METIS and GKlib under the LGPL that would get into the wheel."""
    for path in compiled_files(sources):
        if is_lesser_gpl(path):
            yield f"{path.name} of METIS is under the LGPL: the wheel may not hold it"
    guards = (ROOT / METIS_GUARDS).read_text(encoding="utf-8")
    headers = [sources / "metis/include", sources / "metis/libmetis", sources / "GKlib"]
    for path in sorted(file for folder in headers for file in folder.glob("*.h")):
        if not is_lesser_gpl(path) or path.name in METIS_UNUSED:
            continue
        guard = re.search(r"^#ifndef\s+(\w+)", path.read_text(encoding="utf-8"), re.MULTILINE)
        if guard is None or not re.search(rf"^#define {guard[1]}$", guards, re.MULTILINE):
            yield f"{path.name} of METIS is under the LGPL, and {METIS_GUARDS} does not keep it out"


def is_lesser_gpl(path: Path) -> bool:
    """Whether a source file states that it is under the LGPL."""
    return LESSER_GPL.search(path.read_text(encoding="utf-8", errors="replace")) is not None


def is_allowed(expression: str) -> bool:
    """Whether the licences of an SPDX expression can be chosen so that all of them are allowed."""
    words = SPDX_WORD.findall(expression)

    def either() -> bool:
        good = every()
        while words and words[0] in {"OR", "/"}:
            words.pop(0)
            good = every() or good
        return good

    def every() -> bool:
        good = one()
        while words and words[0] == "AND":
            words.pop(0)
            good = one() and good
        return good

    def one() -> bool:
        word = words.pop(0) if words else ""
        if word == "(":
            good = either()
            if words:
                words.pop(0)
            return good
        if words[:1] == ["WITH"]:
            word = " ".join([word, words.pop(0), words.pop(0)])
        return word in ALLOWED

    good = either()
    return good and not words


def notices(crates: list[dict[str, Any]], sources: Path) -> str:
    """The text of the file: what is in the wheel, and every licence text once."""
    found = Texts()
    rows = []
    for crate in crates:
        name = f"{crate['name']} {crate['version']}"
        rows.append(f"| {name} | {crate['license']} | {crate['repository'] or ''} |")
        own = list(licence_texts(Path(crate["manifest_path"]).parent))
        # Some crates of a family leave their licence to the repository: it is stated, not repeated.
        for text in own or [unrepeated(crate)]:
            found.add(text, name)
    for name, path in (("METIS 5.1", "metis/LICENSE"), ("GKlib", "GKlib/LICENSE.txt")):
        rows.append(f"| {name} | Apache-2.0 | https://github.com/KarypisLab |")
        found.add(clean((sources / path).read_text(encoding="utf-8")), name)
    apache = clean((ROOT / "LICENSE-APACHE").read_text(encoding="utf-8"))
    found.add(apache, "METIS 5.1 and GKlib, by reference")
    python = [f"| {name} | {PYTHON.get(name, '?')} |" for name in python_packages()]
    parts = [
        "# Third-party notices",
        INTRODUCTION,
        "| part | licence | source |\n|---|---|---|\n" + "\n".join(rows),
        BESIDE_THE_WHEEL,
        "| package | licence |\n|---|---|\n" + "\n".join(python),
    ]
    for users, text in found.by_user():
        parts.append(f"## {', '.join(users)}")
        # Four spaces: the text as it is, whatever characters it holds.
        parts.append("\n".join(f"    {line}".rstrip() for line in text.splitlines()))
    return "\n\n".join(parts) + "\n"


class Texts:
    """Licence texts, each once however its lines are broken, and who uses it."""

    def __init__(self) -> None:
        self._texts: dict[str, str] = {}
        self._users: dict[str, list[str]] = defaultdict(list)

    def add(self, text: str, user: str) -> None:
        """Takes a text of a user."""
        words = " ".join(text.split())
        self._texts.setdefault(words, text)
        if user not in self._users[words]:
            self._users[words].append(user)

    def by_user(self) -> list[tuple[list[str], str]]:
        """Users and their text, by the first of them."""
        return sorted((users, self._texts[words]) for words, users in self._users.items())


def licence_texts(folder: Path) -> Iterator[str]:
    """The licence and notice files at the top of a crate."""
    for path in sorted(folder.iterdir()):
        if path.is_file() and LICENCE_FILE.match(path.name) and path.suffix not in {".rs", ".html"}:
            yield clean(path.read_text(encoding="utf-8", errors="replace"))


def unrepeated(crate: dict[str, Any]) -> str:
    """What stands in the place of a licence text that a crate leaves to its repository."""
    authors = ", ".join(re.sub(r"\s*<[^>]*>", "", author) for author in crate["authors"])
    stated = (
        f"Copyright (c) {authors or 'the authors of ' + crate['name']}\n"
        f"Licence: {crate['license']}; its text is not in the crate, see {crate['repository']}"
    )
    if "MIT" not in crate["license"]:
        return f"{stated}\nThe text of the Apache License 2.0 is in this file."
    mit = clean((ROOT / "LICENSE-MIT").read_text(encoding="utf-8"))
    return f"{stated}\n\n{mit[mit.index('Permission is hereby granted') :]}"


def clean(text: str) -> str:
    """The text with plain line ends and without control characters."""
    lines = text.replace("\r\n", "\n").replace("\r", "\n").expandtabs().split("\n")
    kept = ("".join(c for c in line if unicodedata.category(c) != "Cc") for line in lines)
    return "\n".join(line.rstrip() for line in kept).strip("\n")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
