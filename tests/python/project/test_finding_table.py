"""The table of findings, the source that makes them, and the page that lists them agree."""

import importlib.util
from pathlib import Path

import pytest
from finding_codes import package_findings

from cmfsim import Finding
from cmfsim.values.finding_table import BLANK, FINDING_KINDS, FORMER_CODES

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def sites():
    """Every place that makes a finding; reading the source takes seconds."""
    return package_findings()


def test_the_package_makes_the_codes_of_the_table_and_no_others(sites):
    made = {site.code for site in sites}
    assert set(FINDING_KINDS) == made
    # The reading of the source misses none of some that are made in different ways.
    assert {"ct-flipped", "surface-inner-wall", "landmark-outside-image", "file-missing"} <= made
    assert len(sites) > 200


def test_a_site_states_a_severity_only_where_the_code_has_several(sites):
    for site in sites:
        stated = set(FINDING_KINDS[site.code].severity.split(" or "))
        assert stated <= {"error", "warning", "note"}, site.code
        # A site of two codes states the severity for both.
        if "severity" not in site.given:
            assert len(stated) == 1, site.place
        elif len({other.code for other in sites if other.place == site.place}) == 1:
            assert len(stated) > 1, site.place
            assert site.severities <= stated, site.place


def test_every_code_has_its_texts_and_no_site_repeats_them(sites):
    for code, kind in FINDING_KINDS.items():
        assert all(len(text.strip("… ")) >= 8 for text in (kind.meaning, kind.why, kind.fix)), code
    for site in sites:
        kind = FINDING_KINDS[site.code]
        for name, text in (("what", kind.meaning), ("why", kind.why), ("fix", kind.fix)):
            assert site.text(name) != text, f"{site.place}: {name}"


def test_what_a_text_of_the_table_leaves_open_is_given_by_every_site(sites):
    for site in sites:
        kind = FINDING_KINDS[site.code]
        texts = (("what", kind.meaning), ("why", kind.why), ("fix", kind.fix))
        left = [text for name, text in texts if name not in site.given]
        blanks = {name for text in left for name in BLANK.findall(text)}
        assert blanks == site.facts, site.place
        assert "…" not in "".join(left).replace('"…"', "").replace(", …)", ""), site.place


def test_a_finding_takes_from_the_table_what_it_does_not_state():
    found = Finding("unknown-name", "the plan moves 'chin'", facts={"names": "maxilla, mandible"})
    assert (found.severity, found.fix) == ("error", "use one of: maxilla, mandible")
    assert found.why == FINDING_KINDS["unknown-name"].why
    # What is not given stays open; what is given stays.
    assert Finding("unknown-name", "x").fix == "use one of: …"
    assert Finding("unknown-name", "x", fix="{names}", severity="note").fix == "{names}"
    with pytest.raises(ValueError, match="severity"):
        Finding("surface-open", "severities of this code depend on the size")


def test_results_with_former_codes_are_read_with_those_of_today():
    assert not set(FORMER_CODES) & set(FINDING_KINDS)
    assert set(FORMER_CODES.values()) <= set(FINDING_KINDS)
    stored = {"severity": "warning", "code": "ct-cut-bottom", "what": "chin cut off", "why": "w"}
    found = Finding.from_values(stored)
    assert (found.code, found.what, found.why) == ("ct-cut-off", "chin cut off", "w")


def test_the_page_is_what_the_script_writes():
    path = ROOT / "scripts/make_checks_page.py"
    spec = importlib.util.spec_from_file_location("make_checks_page", path)
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    assert (ROOT / "docs/checks.md").read_text(encoding="utf-8") == script.page()
