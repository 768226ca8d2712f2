"""Findings: how they are made, and read from files that older builds wrote."""

import dataclasses

import pytest

import cmfsim
from cmfsim.values.finding import SEVERITIES


@pytest.mark.parametrize("severity", SEVERITIES)
def test_each_severity_has_its_constructor(severity):
    found = getattr(cmfsim.Finding, severity)("code", "what", where="here", why="so", fix="that")
    assert dataclasses.astuple(found) == (severity, "code", "what", "here", "so", "that")


def test_values_go_by_name_alone():
    with pytest.raises(TypeError):
        cmfsim.Finding("error", "code", "what")


def test_a_finding_is_read_back_from_its_plain_values():
    found = cmfsim.Finding.warning("code", "what", fix="that")
    assert cmfsim.Finding.from_values(dataclasses.asdict(found)) == found


def test_unknown_names_of_a_stored_finding_are_ignored():
    values = {"severity": "note", "code": "code", "what": "what", "fix": "that", "other": 1}
    assert cmfsim.Finding.from_values(values) == cmfsim.Finding.note("code", "what", fix="that")
