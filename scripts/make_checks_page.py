"""Writes docs/checks.md, the page of everything that is checked: make_checks_page.py [FILE]."""

import sys
from pathlib import Path

from cmfsim.values.finding_table import FINDING_KINDS, FORMER_CODES, filled

PAGE = Path(__file__).parents[1] / "docs/checks.md"
HEAD = """# What is checked

cmfsim reports what it notices as *findings*: `cmfsim doctor` before any work, every other command
while it works. An error ends the work, a warning means that the result may be wrong, a note is for
information. Findings are printed on the terminal, listed at the top of the report, and stored in
the results as JSON. `--no-doctor` skips the checks made before the work. Errors about the face
after an operation become warnings by `verified = true` in `[postoperative]`
([Evaluation](evaluation.md#where-nothing-was-operated-on)).

This page lists every code; `…` stands for names and figures of your case.
`scripts/make_checks_page.py` writes it from the table in the package
(`cmfsim.values.finding_table`).

| code | severity | meaning | why it matters | remedy |
|---|---|---|---|---|
"""
FORMER = """
## Former codes

Results that were written with a former code are read with that of today.

| code | formerly |
|---|---|
"""


def page() -> str:
    """The text of the page."""
    rows = []
    for code, kind in sorted(FINDING_KINDS.items()):
        cells = (f"`{code}`", kind.severity, kind.meaning, kind.why, kind.fix)
        rows.append(f"| {' | '.join(_cell(cell) for cell in cells)} |")
    former: dict[str, list[str]] = {}
    for old, code in sorted(FORMER_CODES.items()):
        former.setdefault(code, []).append(f"`{old}`")
    lines = [f"| `{code}` | {', '.join(olds)} |" for code, olds in sorted(former.items())]
    return f"{HEAD}{chr(10).join(rows)}\n{FORMER}{chr(10).join(lines)}\n"


def _cell(text: str) -> str:
    """A text that a cell of a table can hold."""
    text = filled(text, {})
    for sign, escaped in (("|", "\\|"), ("<", "&lt;"), ("[", "\\["), ("*", "\\*")):
        text = text.replace(sign, escaped)
    return text


if __name__ == "__main__":
    (Path(sys.argv[1]) if len(sys.argv) > 1 else PAGE).write_text(page(), encoding="utf-8")
