"""Checks who may import whom: check_imports.py [FOLDER of the project].

Imports run in one direction, and each outside library is used in one place. The tables below are
the rules; a new file gets a line here that allows the least it needs.
"""

import ast
import re
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

# The files and folders at the top of crates/mtm-core/src, from the ground up, and what each may
# import. An import may only run towards the ground; lib.rs is free.
CORE: Mapping[str, frozenset[str]] = {
    name: frozenset(allowed.split())
    for name, allowed in {
        "error": "",
        "vector": "",
        "mesh": "error vector",
        "geometry": "error vector",
        "algebra": "error vector",
        "mechanics": "algebra error mesh vector",
        "boundary": "error geometry vector",
        "meshing": "error geometry mesh vector",
        "muscles": "error geometry mechanics mesh vector",
        "registration": "error geometry vector",
        "contact": "algebra boundary error geometry mesh vector",
        "statics": "algebra boundary contact error geometry mechanics mesh vector",
    }.items()
}
# Entries at the top of crates/mtm-core/src beside lib.rs: a reader holds so many in mind.
MOST_CORE_ENTRIES = 15
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
        "processes values",
        "io phantom registration surfaces",
        # The stages: none knows another.
        "bones evaluation imaging meshing muscles solving",
        "doctor pictures planning report",
        "pipeline",
        "drafting study",
        "desk lab",
        "cli",
        "__init__ __main__",
    )
)
# Pairs of entries of which one imports the other, wherever the import stands; `__init__` is free.
MOST_PYTHON_PAIRS = 137
# Files and folders in one folder of the package, and the folders that may hold more: plain values,
# one subject a file, and the modules of one page's script.
MOST_ENTRIES = 12
LARGE_FOLDERS: Mapping[str, int] = {"": 27, "values": 35, "planning/page/scripts": 35}
# Outside packages that a module may import at its top: `import cmfsim` needs numpy alone.
PYTHON_PACKAGES = frozenset({"numpy"})
# A file is called after its subject.
NAMELESS = frozenset({"utils", "util", "helpers", "helper", "common", "misc"})

COMMENT = re.compile(r"//[^\n]*|/\*.*?\*/", re.DOTALL)
TEST_MODULE = re.compile(r"^#\[cfg\(test\)\]\s*mod\s+\w+\s*\{.*", re.DOTALL | re.MULTILINE)
CRATE_PATH = re.compile(r"\b(crate|super)((?:::\w+)+)")
# A folder's mod.rs lists its files and passes their names on: neither is an import.
PASSED_ON = re.compile(r"^\s*pub(?:\([^)]*\))?\s+use\s+(?!crate|super)[^;]*;", re.MULTILINE)
CHILD = re.compile(r"^\s*(?:pub(?:\([^)]*\))?\s+)?mod\s+(\w+);", re.MULTILINE)
TYPE_NAME = re.compile(r"^(?:pub(?:\([^)]*\))? )?(?:struct|enum|trait|type) (\w+)", re.MULTILINE)
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
    yield from _check_core(root)
    yield from _doubled_types(root)


def _check_core(root: Path) -> Iterator[str]:
    """The broken rules of the files of the core among one another."""
    source = root / "crates/mtm-core/src"
    files = [path for path in sorted(source.rglob("*.rs")) if path != source / "lib.rs"]
    graph: dict[str, set[str]] = {}
    for path in files:
        name = path.relative_to(source).with_suffix("").as_posix().removesuffix("/mod")
        entry = name.split("/")[0]
        graph[name] = set()
        if entry not in CORE:
            yield f"{path.relative_to(root)}: add {entry} to CORE in scripts/check_imports.py"
            continue
        text = TEST_MODULE.sub(_blank, COMMENT.sub(_blank, path.read_text(encoding="utf-8")))
        for match in CRATE_GROUP.finditer(text):
            line = _at(path, root, text, match.start())
            yield f"{line}: write one `use {match[0][:-1]}…` per module"
        for offset, module in _core_imports(source, path, text):
            graph[name] |= {module} - {name}
            complaint = _core_complaint(entry, module.split("/")[0])
            if complaint:
                yield f"{_at(path, root, text, offset)}: {complaint}"
    entries = sorted({name.split("/")[0] for name in graph})
    if len(entries) > MOST_CORE_ENTRIES:
        yield f"crates/mtm-core/src: {len(entries)} entries, at most {MOST_CORE_ENTRIES}"
    for circle in _circles(graph):
        yield f"crates/mtm-core/src: a circle of imports: {' → '.join(circle)}"


def _doubled_types(root: Path) -> Iterator[str]:
    """The types that share a name with another one: a reader would have to guess which is meant."""
    homes: dict[str, str] = {}
    for path in sorted((root / "crates").rglob("*.rs")):
        text = COMMENT.sub(_blank, path.read_text(encoding="utf-8"))
        for match in TYPE_NAME.finditer(text):
            home = _at(path, root, text, match.start(1))
            if match[1] in homes:
                yield f"{home}: {match[1]} is defined in {homes[match[1]]} as well"
            homes[match[1]] = home


def _core_complaint(entry: str, other: str) -> str | None:
    """Why a file below `entry` may not import one below `other`."""
    if other == entry:
        return None
    if other not in CORE:
        return f"{entry} may not import {other}, which is none of the crate's"
    order = list(CORE)
    if order.index(other) > order.index(entry):
        return f"{entry} may not import {other}: it runs upwards"
    if other not in CORE[entry]:
        return f"{entry} may not import {other} (may: {', '.join(sorted(CORE[entry])) or 'none'})"
    return None


def _core_imports(source: Path, path: Path, text: str) -> Iterator[tuple[int, str]]:
    """Offset and file, below `source` without its suffix, of each import in the text of a file."""
    folder = path.parent.relative_to(source).parts
    for match in CRATE_PATH.finditer(PASSED_ON.sub(_same_length, text)):
        parts = match[2].split("::")[1:]
        if match[1] == "super":
            start = list(folder[:-1] if path.name == "mod.rs" else folder)
            while parts and parts[0] == "super":
                start, parts = start[:-1], parts[1:]
            parts = start + parts
        module = _core_file(source, parts)
        if module:
            yield match.start(), module
    if path.name == "mod.rs":
        body = PASSED_ON.sub(_same_length, text)
        for child in CHILD.findall(text):
            for match in re.finditer(rf"(?<![:\w]){child}::", body):
                yield match.start(), "/".join((*folder, child))


def _core_file(source: Path, parts: list[str]) -> str:
    """The file or folder that a path of the crate lies in; its first part where there is none."""
    for n in range(len(parts), 0, -1):
        place = source.joinpath(*parts[:n])
        if place.with_suffix(".rs").exists() or (place / "mod.rs").exists():
            return "/".join(parts[:n])
    return parts[0] if parts else ""


def _circles(graph: Mapping[str, set[str]]) -> Iterator[list[str]]:
    """One circle of imports through each file that closes one first, along the names in order."""
    done: set[str] = set()
    for start in sorted(graph):
        trail: list[str] = []
        stack = [(start, iter(sorted(graph[start])))] if start not in done else []
        while stack:
            name, others = stack[-1]
            if len(trail) < len(stack):
                trail.append(name)
            other = next(others, None)
            if other is None:
                done.add(name)
                stack.pop()
                trail.pop()
            elif other in trail:
                yield [*trail[trail.index(other) :], other]
            elif other not in done and other in graph:
                stack.append((other, iter(sorted(graph[other]))))


def check_python(root: Path) -> Iterator[str]:
    """The broken rules of the Python package."""
    package = root / "python/cmfsim"
    level = {name: number for number, row in enumerate(PYTHON) for name in row}
    files: dict[str, set[str]] = {}
    pairs: set[tuple[str, str]] = set()
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
            pairs.add((name, module))
            if level.get(module, len(PYTHON)) >= level[name]:
                yield f"{place}:{line}: {name} may not import {module}: see PYTHON"
        for line, module in _top_imports(tree):
            if module not in PYTHON_PACKAGES | {"cmfsim"} | sys.stdlib_module_names:
                yield f"{place}:{line}: import {module} inside the function that needs it"
    yield from _full_folders(package)
    among = sum(1 for name, _ in pairs if name != "__init__")
    if among > MOST_PYTHON_PAIRS:
        yield f"python/cmfsim: {among} imports between entries, at most {MOST_PYTHON_PAIRS}"
    # A folder's own `__init__` gives names of its files to others, and is left out.
    graph = {f: {g for g in found if not f.startswith(f"{g}/")} for f, found in files.items()}
    for circle in _circles(graph):
        yield f"python/cmfsim: a circle of imports: {' → '.join(circle)}"


def _full_folders(package: Path) -> Iterator[str]:
    """The folders of the package with more entries than a reader holds in mind."""
    for folder in sorted({path.parent for path in package.rglob("*") if _is_kept(path)}):
        inside = folder.relative_to(package).as_posix().removeprefix(".")
        count = len({path.stem for path in folder.iterdir() if _is_kept(path)})
        most = LARGE_FOLDERS.get(inside, MOST_ENTRIES)
        if count > most:
            place = "/".join(filter(None, ("python/cmfsim", inside)))
            yield f"{place}: {count} files and folders, at most {most}"


def _is_kept(path: Path) -> bool:
    """Whether a file or folder is one to read: neither compiled, nor a cache, nor a mark."""
    return "__pycache__" not in path.parts and path.suffix not in {".so", ".pyd", ".typed"}


def _file_of(package: Path, dotted: str) -> str:
    """The file, below the package and without its suffix, that `dotted` lies in."""
    parts = dotted.split(".")
    while len(parts) > 1:
        place = package.joinpath(*parts)
        if place.is_dir() or place.with_suffix(".py").is_file():
            break
        parts.pop()
    return "/".join(parts)


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


def _same_length(match: re.Match[str]) -> str:
    """Blanks in place of the match, so that offsets stay right."""
    return re.sub(r"[^\n]", " ", match[0])


def _at(path: Path, root: Path, text: str, offset: int) -> str:
    return f"{path.relative_to(root)}:{text.count(chr(10), 0, offset) + 1}"


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parents[1]))
