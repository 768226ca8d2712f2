"""Findings: how they are made, and read from files that older builds wrote."""

import dataclasses

import pytest

import cmfsim


def test_code_and_fact_go_by_place_and_the_rest_by_name():
    found = cmfsim.Finding("code", "what", severity="note", where="here", why="so", fix="that")
    assert dataclasses.astuple(found) == ("note", "code", "what", "here", "so", "that")
    with pytest.raises(TypeError):
        cmfsim.Finding("code", "what", "here")
    with pytest.raises(ValueError, match="error, warning, note"):
        cmfsim.Finding("code", "what", severity="grave")


def test_a_finding_is_read_back_from_its_plain_values():
    found = cmfsim.Finding("code", "what", severity="warning", fix="that")
    assert cmfsim.Finding.from_values(dataclasses.asdict(found)) == found


def test_unknown_names_of_a_stored_finding_are_ignored():
    values = {"severity": "note", "code": "code", "what": "what", "fix": "that", "other": 1}
    expected = cmfsim.Finding("code", "what", severity="note", fix="that")
    assert cmfsim.Finding.from_values(values) == expected
