"""Fills the tables of docs/architecture.md and draws its picture.

They come from the import rules and from the first lines of the sources. The rules are the tables of
check_imports.py, which `make lint` holds the sources to: the page shows what the code does.
"""

import ast
import importlib.util
import re
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = Path("docs/architecture.md")
PICTURE = Path("docs/figures/architecture.svg")
# Entries that are not rooms: names that Python wants.
NOT_ROOMS = {"__init__", "__main__", "_core"}
# Of the picture, pixels.
WIDTH, ROW, BOX, GAP, LABEL = 920, 46, 34, 8, 150

MARKED = re.compile(r"(<!-- begin rooms -->\n).*(<!-- end rooms -->)", re.DOTALL)


def _rules() -> tuple[Sequence[frozenset[str]], dict[str, frozenset[str]]]:
    """Rows of the package from the ground up, and what each room of the core may import."""
    spec = importlib.util.spec_from_file_location("rules", ROOT / "scripts/check_imports.py")
    if spec is None or spec.loader is None:
        raise ImportError("scripts/check_imports.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.PYTHON, dict(module.CORE)


def _levels(core: dict[str, frozenset[str]]) -> list[list[str]]:
    """Rooms of the core, each in the lowest row that lies above all that it imports."""
    level: dict[str, int] = {}
    while len(level) < len(core):
        for name, below in core.items():
            if name not in level and below <= level.keys():
                level[name] = 1 + max((level[b] for b in below), default=-1)
    rows: list[list[str]] = [[] for _ in range(1 + max(level.values()))]
    for name, at in level.items():
        rows[at].append(name)
    return rows


def _purpose(name: str, folder: Path) -> str:
    """First sentence of a room's own documentation."""
    if folder.parts[0] == "python":
        path = folder / name / "__init__.py"
        path = path if (ROOT / path).is_file() else folder / f"{name}.py"
        text = ast.get_docstring(ast.parse((ROOT / path).read_text(encoding="utf-8"))) or ""
    else:
        path = folder / name / "mod.rs"
        path = path if (ROOT / path).is_file() else folder / f"{name}.rs"
        lines = (ROOT / path).read_text(encoding="utf-8").splitlines()
        text = "\n".join(line[3:].strip() for line in lines if line.startswith("//!"))
    first = " ".join(text.split("\n\n")[0].split())
    # Links of the crate's own documentation lead nowhere here.
    return re.sub(r"\[(`[^`]*`)\]", r"\1", first)


def _picture(groups: Sequence[tuple[str, Sequence[Iterable[str]]]]) -> str:
    """An SVG of rows of boxes, the ground at the bottom of each group."""
    shapes: list[str] = []
    y = GAP
    for title, rows in groups:
        shapes.append(f'<text x="{GAP}" y="{y + 18}" class="title">{title}</text>')
        for row in reversed(rows):
            names = sorted(row)
            width = (WIDTH - LABEL - GAP * (len(names) + 1)) / len(names)
            for k, name in enumerate(names):
                x = LABEL + GAP + k * (width + GAP)
                shapes.append(
                    f'<rect x="{x:.1f}" y="{y}" width="{width:.1f}" height="{BOX}" rx="5"/>'
                    f'<text x="{x + width / 2:.1f}" y="{y + 22}" class="room">{name}</text>'
                )
            y += ROW
        y += ROW // 2
    style = (
        "rect{fill:#eef3f7;stroke:#5b7f99}text{font:14px sans-serif;fill:#22313c}"
        ".room{text-anchor:middle}.title{font-weight:bold}"
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {y}" width="{WIDTH}" '
        f'height="{y}"><style>{style}</style><rect x="0" y="0" width="{WIDTH}" height="{y}" '
        f'style="fill:#fff;stroke:none"/>{"".join(shapes)}</svg>\n'
    )


def _table(rows: Sequence[Iterable[str]], folder: Path) -> str:
    lines = ["| room | contents |", "|---|---|"]
    lines += [f"| `{n}` | {_purpose(n, folder)} |" for row in reversed(rows) for n in sorted(row)]
    return "\n".join(lines) + "\n\n"


def page(text: str) -> tuple[str, str]:
    """The page whose text is `text` with its tables renewed, and its picture."""
    python, core = _rules()
    package = [row - NOT_ROOMS for row in python]
    package = [row for row in package if row]
    levels = _levels(core)
    tables = "\n### The package, `python/cmfsim`\n\n" + _table(package, Path("python/cmfsim"))
    tables += "### The core, `crates/mtm-core/src`\n\n"
    tables += _table(levels, Path("crates/mtm-core/src"))
    text, count = MARKED.subn(lambda found: found[1] + tables + found[2], text)
    if count != 1:
        raise ValueError(f"{PAGE} needs one pair of marks 'begin rooms' and 'end rooms'")
    return text, _picture([("python/cmfsim", package), ("mtm-core", levels)])


def main() -> int:
    """Writes both files."""
    text, picture = page((ROOT / PAGE).read_text(encoding="utf-8"))
    (ROOT / PAGE).write_text(text, encoding="utf-8")
    (ROOT / PICTURE).write_text(picture, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
