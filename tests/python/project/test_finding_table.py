"""The table of findings, the source that makes them, and the page that lists them agree."""

import importlib.util
from pathlib import Path

from finding_codes import package_findings

from cmfsim.values.finding_table import FINDING_KINDS

ROOT = Path(__file__).parents[3]
MADE = package_findings()


def test_every_code_that_the_package_can_make_is_in_the_table():
    assert sorted(set(MADE) - set(FINDING_KINDS)) == []
    # The reading of the source misses none of some that are made in different ways.
    known = {"ct-upside-down", "surface-welded", "template-text", "template-file-missing",
             "plan-through-bone", "postoperative-other-face"}  # fmt: skip
    assert known <= set(MADE)


def test_no_code_of_the_table_is_unused():
    assert sorted(set(FINDING_KINDS) - set(MADE)) == []


def test_every_code_has_its_severities_and_texts():
    for code, kind in FINDING_KINDS.items():
        stated = set(kind.severity.split(" or "))
        for severities, *_ in MADE[code]:
            # Those of a variable are not in the source.
            assert stated <= severities or severities <= stated, code
        assert all(len(text.strip("… ")) >= 8 for text in (kind.meaning, kind.why, kind.fix)), code


def test_a_reason_or_remedy_without_figures_is_that_of_the_table():
    for code, sites in MADE.items():
        if len(sites) != 1:
            continue
        (_, _, why, fix) = sites[0]
        for text, stated in ((why, FINDING_KINDS[code].why), (fix, FINDING_KINDS[code].fix)):
            if text and "…" not in text and len(text) > 8:
                assert stated == text.strip(" ,"), code


def test_the_page_is_what_the_script_writes():
    path = ROOT / "scripts/make_checks_page.py"
    spec = importlib.util.spec_from_file_location("make_checks_page", path)
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    assert (ROOT / "docs/checks.md").read_text(encoding="utf-8") == script.page()
