"""The findings that the package can make, read off its source: code, severities, texts."""

import ast
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).parents[3] / "python/cmfsim"
SEVERITIES = ("error", "warning", "note")
# The table itself and the class make no finding.
LEFT_OUT = {"finding.py", "finding_table.py"}


def constants(node: ast.expr | None, names: dict[str, str]) -> Iterator[str]:
    """The texts that an expression can be: of a choice both, of a name that of the module."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        yield node.value
    elif isinstance(node, ast.IfExp):
        yield from constants(node.body, names)
        yield from constants(node.orelse, names)
    elif isinstance(node, ast.Name) and node.id in names:
        yield names[node.id]


def text(node: ast.expr | None) -> str:
    """A text with … in place of what is filled in; empty if nothing else is known."""
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(
            text(part) if isinstance(part, ast.Constant) else "…" for part in node.values
        )
    if isinstance(node, ast.BinOp):
        return text(node.left) + text(node.right)
    return "" if node is None else "…"


def made(path: Path) -> Iterator[tuple[str, set[str], str, str, str]]:
    """Code, severities, what, why and fix of each finding that a file makes."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    names = {
        target.id: node.value.value
        for node in tree.body
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant)
        for target in node.targets
        if isinstance(target, ast.Name) and isinstance(node.value.value, str)
    }
    # Functions that pass a parameter `code` on.
    passing: dict[str, tuple[int, set[str]]] = {}
    for function in ast.walk(tree):
        if isinstance(function, ast.FunctionDef):
            given = [a.arg for a in function.args.args if a.arg not in {"self", "cls"}]
            if "code" in given:
                severities = {s for call in findings(function) for s in severities_of(call)}
                passing[function.name] = given.index("code"), severities or {"error"}
    for call in ast.walk(tree):
        if not isinstance(call, ast.Call):
            continue
        called = getattr(call.func, "id", getattr(call.func, "attr", ""))
        words = {k.arg: k.value for k in call.keywords}
        if is_finding(call):
            code = call.args[0] if call.args else words.get("code")
            what = call.args[1] if len(call.args) > 1 else words.get("what")
            for name in constants(code, names):
                severities = severities_of(call)
                yield name, severities, text(what), text(words.get("why")), text(words.get("fix"))
        elif called in passing and len(call.args) > passing[called][0]:
            place, severities = passing[called]
            for name in constants(call.args[place], names):
                yield name, severities, "", "", ""


def is_finding(call: ast.Call) -> bool:
    function = call.func
    if isinstance(function, ast.Attribute):
        return getattr(function.value, "id", "") == "Finding" and function.attr in SEVERITIES
    return isinstance(function, ast.Name) and function.id == "Finding"


def findings(tree: ast.AST) -> list[ast.Call]:
    return [n for n in ast.walk(tree) if isinstance(n, ast.Call) and is_finding(n)]


def severities_of(call: ast.Call) -> set[str]:
    if isinstance(call.func, ast.Attribute):
        return {call.func.attr}
    given = next((k.value for k in call.keywords if k.arg == "severity"), None)
    return set(constants(given, {})) or set(SEVERITIES)


def package_findings() -> dict[str, list[tuple[set[str], str, str, str]]]:
    """By code what the package makes."""
    found: dict[str, list[tuple[set[str], str, str, str]]] = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        if path.name not in LEFT_OUT:
            for code, *rest in made(path):
                found.setdefault(code, []).append(tuple(rest))
    return found
