"""The findings that the package can make, read off its source."""

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

PACKAGE = Path(__file__).parents[3] / "python/cmfsim"


@dataclass(frozen=True)
class Site:
    """One place that makes a finding: what it states itself, as expressions by name."""

    place: str
    code: str
    given: dict[str, ast.expr]

    def text(self, name: str) -> str | None:
        """A given text; None unless it is a constant."""
        node = self.given.get(name)
        return node.value if isinstance(node, ast.Constant) else None

    @property
    def severities(self) -> set[str]:
        """Those that the site can state; those of a variable are unknown."""
        return set(constants(self.given.get("severity"), {}))

    @property
    def facts(self) -> set[str]:
        """The names of what it fills in."""
        node = self.given.get("facts")
        return {key.value for key in node.keys} if isinstance(node, ast.Dict) else set()


def constants(node: ast.expr | None, names: dict[str, str]) -> Iterator[str]:
    """The texts that an expression can be: of a choice both, of a name that of the module."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        yield node.value
    elif isinstance(node, ast.IfExp):
        yield from constants(node.body, names)
        yield from constants(node.orelse, names)
    elif isinstance(node, ast.Name) and node.id in names:
        yield names[node.id]


def module_texts(tree: ast.Module) -> dict[str, str]:
    """The texts that a module gives names to."""
    return {
        target.id: node.value.value
        for node in tree.body
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant)
        for target in node.targets
        if isinstance(target, ast.Name) and isinstance(node.value.value, str)
    }


def package_findings() -> list[Site]:
    """Every place of the package that makes a finding."""
    trees = {path: ast.parse(path.read_text(encoding="utf-8")) for path in PACKAGE.rglob("*.py")}
    names = {name: text for tree in trees.values() for name, text in module_texts(tree).items()}
    sites = []
    for path, tree in trees.items():
        for call in ast.walk(tree):
            if isinstance(call, ast.Call) and getattr(call.func, "id", "") == "Finding":
                given = {k.arg: k.value for k in call.keywords}
                given |= dict(zip(("code", "what"), call.args, strict=False))
                codes = list(constants(given["code"], names))
                assert codes, f"{path}:{call.lineno}: the code is not in the source"
                place = f"{path.relative_to(PACKAGE)}:{call.lineno}"
                sites += [Site(place, code, given) for code in codes]
    return sites
