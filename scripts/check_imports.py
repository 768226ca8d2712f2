"""Checks who may import whom: check_imports.py [FOLDER of the project].

A case walks downhill through the files, and each outside library stays behind one of them. The
tables below are the rules; a new file gets a line here, with the least that it needs.
"""

import ast
import re
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

# What each file of crates/mtm-core/src may name of the crate. All may name `error`; lib.rs is free.
# A folder stands for its mod.rs, which may name every file beside it.
CORE: Mapping[str, frozenset[str]] = {
    name: frozenset(allowed.split())
    for name, allowed in {
        "error": "",
        "mesh": "",
        "memory": "",
        "simd": "",
        "blocks": "simd",
        "ordering": "blocks",
        "triangle": "",
        "topology": "triangle",
        "surface": "mesh topology triangle",
        "winding": "surface mesh triangle",
        "stuffing/level": "",
        "stuffing/distance": "stuffing/level",
        "stuffing/lattice": "keys",
        "stuffing/cut": "mesh stuffing/lattice stuffing/level",
        "stuffing/improve": "mesh stuffing/cut stuffing/level",
        "stuffing/parts": "mesh stuffing/cut",
        "stuffing": "mesh",
        "parting": "mesh stuffing/cut surface",
        "signed_distance": "mesh stuffing/level surface winding",
        "material": "mesh",
        "fibre/region": "surface triangle",
        "fibre/centre_line": "triangle fibre/region",
        "fibre/parts": "triangle fibre/centre_line fibre/region",
        "fibre/course": "triangle",
        "fibre": "surface triangle",
        "equivalent/aligned_box": "triangle",
        "equivalent/tet_tree": "equivalent/aligned_box triangle",
        "equivalent/border": "surface triangle",
        "equivalent/shape": "equivalent/aligned_box equivalent/border surface triangle winding",
        "equivalent/crossing": (
            "equivalent/aligned_box equivalent/shape equivalent/tet_tree mesh triangle"
        ),
        "equivalent/sequence": "triangle",
        "equivalent/packet": "equivalent/sequence equivalent/shape triangle",
        "equivalent/direction": "triangle",
        "equivalent/shares": (
            "equivalent equivalent/crossing equivalent/direction equivalent/packet "
            "equivalent/sequence equivalent/shape fibre mesh triangle"
        ),
        "equivalent/stiffness": "equivalent/shares material",
        "equivalent": "fibre material mesh surface triangle winding",
        "element": "mesh",
        "keys": "",
        "kinematics": "",
        "quadratic": "blocks element",
        "nodal_pressure": "blocks material mesh",
        "tensors": "blocks element material mesh nodal_pressure quadratic",
        "polar": "",
        "pool": "",
        "density": "kinematics material polar",
        "strain_energy": "blocks density element kinematics nodal_pressure tensors",
        "motion": "surface mesh triangle",
        "registration/spread": "triangle",
        "registration/thin_plate": "registration/spread triangle",
        "registration/rigid": "registration/spread triangle",
        "registration/nearest": "registration/spread",
        "registration/icp": (
            "motion registration/nearest registration/rigid registration/spread surface triangle"
        ),
        "registration": "",
        "boundary": "surface motion mesh",
        "restraint": "mesh",
        "contact/field": "keys mesh surface",
        "contact": "boundary mesh motion surface contact/field",
        "contact/seat": "boundary contact mesh motion surface contact/field",
        "contact/newton": "boundary contact mesh triangle contact/seat",
        "constraints": "blocks mesh",
        "cholesky/workspace": "",
        "cholesky/structure": "blocks ordering cholesky/workspace",
        "cholesky/numeric": "blocks cholesky/structure",
        "cholesky/symmetric": "simd cholesky/workspace",
        "cholesky/sweep": "simd cholesky/numeric cholesky/symmetric",
        "cholesky/dense": "cholesky/symmetric",
        "cholesky/grid": "blocks",
        "cholesky/normal": "cholesky/symmetric",
        "cholesky/reach": "cholesky/sweep cholesky/symmetric",
        "cholesky": (
            "blocks ordering cholesky/dense cholesky/normal cholesky/numeric cholesky/reach "
            "cholesky/structure cholesky/sweep cholesky/symmetric cholesky/workspace"
        ),
        "row_sums": "blocks",
        "error_estimate": "",
        "krylov": "blocks error_estimate row_sums",
        "multigrid/block_rows": "blocks",
        "multigrid/small_blocks": "simd",
        "multigrid/scaling": "multigrid/block_rows multigrid/small_blocks",
        "multigrid/scaled_matrix": (
            "error_estimate row_sums simd multigrid/block_rows multigrid/scaling "
            "multigrid/small_blocks"
        ),
        "multigrid/smoother": "simd multigrid/scaled_matrix",
        "multigrid/aggregation": "multigrid/block_rows multigrid/scaled_matrix",
        "multigrid/rigid_modes": "multigrid/aggregation",
        "multigrid/prolongator": (
            "multigrid/aggregation multigrid/block_rows multigrid/rigid_modes "
            "multigrid/scaled_matrix"
        ),
        "multigrid/galerkin": (
            "multigrid/block_rows multigrid/prolongator multigrid/rigid_modes multigrid/scaling "
            "multigrid/small_blocks"
        ),
        "multigrid/transfer": (
            "simd multigrid/prolongator multigrid/rigid_modes multigrid/scaling "
            "multigrid/small_blocks"
        ),
        "multigrid/coarsest": (
            "multigrid/block_rows multigrid/galerkin multigrid/rigid_modes multigrid/scaling"
        ),
        "multigrid": "blocks krylov row_sums",
        "relaxation": "blocks",
        "method": "contact kinematics",
        "reduction": "blocks boundary",
        "solution": "contact",
        "projected_product": "blocks constraints contact krylov mesh",
        "iterative": (
            "blocks constraints contact krylov mesh method multigrid projected_product relaxation"
        ),
        "reaction": "cholesky contact mesh",
        "frozen": "cholesky contact mesh reaction",
        "system": (
            "blocks boundary cholesky constraints contact frozen iterative mesh method reaction "
            "restraint row_sums solution"
        ),
        "equilibrium": (
            "blocks cholesky constraints contact iterative krylov mesh method multigrid "
            "reduction solution strain_energy tensors"
        ),
        "equilibrium/sliding": (
            "boundary contact equilibrium iterative mesh method reduction restraint solution "
            "strain_energy system"
        ),
        "statics": (
            "blocks boundary contact equilibrium iterative kinematics mesh method reduction "
            "restraint solution system tensors"
        ),
        "replan": "boundary contact kinematics mesh method motion reduction statics system",
    }.items()
}
# The one place, below crates/, that may name each outside crate.
CRATES: Mapping[str, str] = {
    "parry3d_f64": "mtm-core/src/geometry/surface.rs",
    "faer": "mtm-core/src/algebra/cholesky/",
    "pulp": "mtm-core/src/algebra/simd.rs",
    "libc": "mtm-core/src/algebra/memory.rs",
    "pyo3": "mtm-py/",
    "numpy": "mtm-py/",
}
# The folders and files of python/cmfsim, lowest first: each may import from the rows above its own.
# A folder is one module to the rest of the package, and its files may import one another where no
# circle comes of it.
PYTHON: tuple[frozenset[str], ...] = tuple(
    frozenset(row.split())
    for row in (
        "_core",
        "errors deferred",
        "checks extras",
        "values",
        "io registration surfaces",
        "phantom",
        # The stages: none knows another.
        "bones evaluation imaging lips meshing muscles node_kinds solving",
        "doctor pictures planning report",
        "pipeline",
        "bench study virtual",
        "cli",
        "__init__ __main__",
    )
)
# Single imports that the order forbids, with the reason why they stay.
PYTHON_EXCEPTIONS: Mapping[tuple[str, str], str] = {
    ("cli/parsing", "cmfsim"): "the version that --version prints",
    ("cli/view_command", "cmfsim"): "the public mesh that a file of tets is read as",
    ("pipeline/outputs", "study"): "writes the report of a study",
    ("values/patient_model", "surfaces"): "the skin of a model is drawn from its level",
}
# Outside packages that a module may import at its top: `import cmfsim` needs numpy alone.
PYTHON_PACKAGES = frozenset({"numpy"})
# A file is called after its subject.
NAMELESS = frozenset({"utils", "util", "helpers", "helper", "common", "misc"})

COMMENT = re.compile(r"//[^\n]*|/\*.*?\*/", re.DOTALL)
TEST_MODULE = re.compile(r"^#\[cfg\(test\)\]\s*mod\s.*", re.DOTALL | re.MULTILINE)
CRATE_PATH = re.compile(r"\b(crate|super)::(\w+)(?:::(\w+))?")
CRATE_GROUP = re.compile(r"\b(?:crate|super)::\{")


def main(root: Path) -> int:
    """Prints each broken rule; 1 if there is one."""
    problems = [*check_rust(root), *check_python(root), *check_names(root)]
    for problem in problems:
        print(problem)
    files = sum(1 for _ in _sources(root))
    print(f"import rules: {files} files, {len(problems) or 'no'} broken")
    return 1 if problems else 0


def check_rust(root: Path) -> Iterator[str]:
    """The broken rules of the crates."""
    for path in sorted((root / "crates").rglob("*.rs")):
        place = path.relative_to(root / "crates").as_posix()
        text = COMMENT.sub(_blank, path.read_text(encoding="utf-8"))
        for crate, home in CRATES.items():
            if place.startswith(home):
                continue
            for match in re.finditer(rf"\b{crate}\s*::|\buse\s+{crate}\b", text):
                yield f"{_at(path, root, text, match.start())}: {crate} belongs in crates/{home}"
        if place.startswith("mtm-core/src/") and place != "mtm-core/src/lib.rs":
            yield from _check_core_file(path, root, TEST_MODULE.sub(_blank, text))


def _check_core_file(path: Path, root: Path, text: str) -> Iterator[str]:
    source = root / "crates/mtm-core/src"
    name = path.relative_to(source).with_suffix("").as_posix().removesuffix("/mod")
    if name not in CORE:
        yield f"{path.relative_to(root)}: add it to CORE in scripts/check_imports.py"
        return
    for match in CRATE_GROUP.finditer(text):
        yield f"{_at(path, root, text, match.start())}: write one `use {match[0][:-1]}…` per module"
    for match in CRATE_PATH.finditer(text):
        module = _module(source, path, *match.groups())
        if module not in CORE[name] | {"error", name}:
            yield (
                f"{_at(path, root, text, match.start())}: {name} may not import {module} "
                f"(may: {', '.join(sorted(CORE[name] | {'error'}))})"
            )


def _module(source: Path, path: Path, start: str, first: str, second: str | None) -> str:
    """The file, as CORE names it, that `start::first::second` in the file at `path` lies in."""
    folder = "" if path.parent == source else path.parent.relative_to(source).as_posix()
    if start == "super" and path.name != "mod.rs" and folder:
        inside = (source / folder / first).with_suffix(".rs")
        return f"{folder}/{first}" if inside.exists() else folder
    if start == "crate" and second and (source / first / second).with_suffix(".rs").exists():
        return f"{first}/{second}"
    return first


def check_python(root: Path) -> Iterator[str]:
    """The broken rules of the Python package."""
    package = root / "python/cmfsim"
    level = {name: number for number, row in enumerate(PYTHON) for name in row}
    files: dict[str, set[str]] = {}
    # Packages that load their modules when these are asked for say them in the stub beside.
    for path in sorted([*package.rglob("*.py"), *package.rglob("__init__.pyi")]):
        place = path.relative_to(root)
        inside = path.relative_to(package).with_suffix("")
        name = inside.parts[0]
        if name not in level:
            yield f"{place}: add {name} to PYTHON in scripts/check_imports.py"
            continue
        file = inside.as_posix().removesuffix("/__init__")
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for line, dotted in _package_imports(tree):
            module = dotted.split(".")[0]
            files.setdefault(file, set()).add(_file_of(package, dotted))
            if module == name and len(inside.parts) > 1:
                continue
            upwards = level.get(module, len(PYTHON)) >= level[name]
            if upwards and (file, module) not in PYTHON_EXCEPTIONS:
                yield f"{place}:{line}: {name} may not import {module}: see PYTHON"
        for line, module in _top_imports(tree):
            if module not in PYTHON_PACKAGES | {"cmfsim"} | sys.stdlib_module_names:
                yield f"{place}:{line}: import {module} inside the function that needs it"
    yield from _circles(files)


def _file_of(package: Path, dotted: str) -> str:
    """The file, below the package and without its suffix, that `dotted` lies in."""
    parts = dotted.split(".")
    while len(parts) > 1:
        place = package.joinpath(*parts)
        if place.is_dir() or place.with_suffix(".py").is_file():
            break
        parts.pop()
    return "/".join(parts)


def _circles(files: Mapping[str, set[str]]) -> Iterator[str]:
    """The files that reach themselves through what they import.

    A folder's own `__init__` is left out: it gives names of its files to others.
    """
    inner = {f: {g for g in found if not f.startswith(f"{g}/")} for f, found in files.items()}
    for start in sorted(inner):
        seen: set[str] = set()
        front = set(inner[start])
        while front:
            seen |= front
            front = {name for file in front for name in inner.get(file, ())} - seen
        if start in seen:
            yield f"python/cmfsim/{start}: imports itself through other files"


def _package_imports(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Line and dotted name, below the package, of each import from it, wherever it stands.

    `cmfsim` stands for the package itself.
    """
    modules = frozenset().union(*PYTHON)
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                top, _, below = alias.name.partition(".")
                if top == "cmfsim":
                    yield node.lineno, below or "cmfsim"
        elif isinstance(node, ast.ImportFrom):
            parts = (node.module or "").split(".")
            if node.level:
                parts = ["cmfsim", *filter(None, parts)]
            if parts[0] != "cmfsim":
                continue
            for alias in node.names:
                if len(parts) > 1:
                    yield node.lineno, ".".join([*parts[1:], alias.name])
                else:
                    yield node.lineno, alias.name if alias.name in modules else "cmfsim"


def _top_imports(tree: ast.Module) -> Iterator[tuple[int, str]]:
    for node in tree.body:
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name.split(".")[0]
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield node.lineno, (node.module or "").split(".")[0]


def check_names(root: Path) -> Iterator[str]:
    """The files whose name says no subject."""
    for path in _sources(root):
        if path.stem in NAMELESS:
            yield f"{path.relative_to(root)}: name the file after its subject"


def _sources(root: Path) -> Iterator[Path]:
    for folder in ("crates", "python", "tests", "benches", "examples", "scripts", "fuzz"):
        for path in sorted((root / folder).rglob("*")):
            if path.suffix in {".rs", ".py", ".pyi"} and "target" not in path.parts:
                yield path


def _blank(match: re.Match[str]) -> str:
    """As many lines as the match, so that line numbers stay right."""
    return "\n" * match[0].count("\n")


def _at(path: Path, root: Path, text: str, offset: int) -> str:
    return f"{path.relative_to(root)}:{text.count(chr(10), 0, offset) + 1}"


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parents[1]))
