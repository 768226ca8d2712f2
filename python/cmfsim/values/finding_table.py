"""What is checked: every code of a finding with its severity, meaning, reason and remedy.

A finding takes from it what it does not state itself, and `scripts/make_checks_page.py` writes
docs/checks.md from it. Names in braces are filled in by a finding.
"""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from types import MappingProxyType

# What is filled in: a name, and how it is written.
BLANK = re.compile(r"\{(\w+)(?:!r)?(?::[^}]*)?\}")


@dataclass(frozen=True)
class FindingKind:
    """What findings of one code have in common; `meaning` is the fact, `why` its effect.

    severity: Several joined by " or " where it depends on the size.
    several: One line for several findings; empty: the worst of them stands for all.
    """

    severity: str
    meaning: str
    why: str
    fix: str
    several: str = ""


def filled(text: str, facts: Mapping[str, object]) -> str:
    """A text of the table with the facts in it, and … for those that are not given."""
    return BLANK.sub(lambda m: m[0].format_map(facts) if m[1] in facts else "…", text)


_TABLE = json.loads(
    files("cmfsim.values").joinpath("finding_table.json").read_text(encoding="utf-8")
)
# One entry for each code.
FINDING_KINDS: Mapping[str, FindingKind] = MappingProxyType(
    {code: FindingKind(**texts) for code, texts in _TABLE["kinds"].items()}
)
# Codes of results that were written earlier, and the one that each has now.
FORMER_CODES: Mapping[str, str] = MappingProxyType(_TABLE["former"])
