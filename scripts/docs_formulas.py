"""Turns the formulas of the documentation into MathML, which browsers draw without scripts.

A hook of MkDocs (mkdocs.yml): formulas are converted where the site is built, so that its pages
need neither a script nor a network.
"""

import html
import re
from typing import Any

FORMULA = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">'
    r"(?:\\\((?P<inline>.*?)\\\)|\\\[(?P<display>.*?)\\\])</(?P=tag)>",
    re.DOTALL,
)


def on_page_content(content: str, **_: Any) -> str:
    """The page with each formula as MathML."""
    return FORMULA.sub(_formula, content)


def _formula(match: re.Match[str]) -> str:
    from latex2mathml.converter import convert  # noqa: PLC0415 (of the extra `docs`)

    display = match["display"] is not None
    text = html.unescape(match["display"] if display else match["inline"]).strip()
    # The converter knows `aligned` by the name of its sibling.
    known = text.replace("{aligned}", "{split}")
    formula = str(convert(known, display="block" if display else "inline"))
    if "<mi>&</mi>" in formula:
        raise ValueError(f"formula with an environment that is not known: {text}")
    return formula
