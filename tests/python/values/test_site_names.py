"""Names of landmark sites: abbreviations of cephalometry, and who placed a site."""

import importlib.util
from pathlib import Path

import pytest

import cmfsim
from cmfsim.io import read_landmark_file
from cmfsim.values.landmark_sites import (
    CEPHALOMETRY,
    SKIN_LANDMARKS,
    SKIN_SITES,
    SKULL_LANDMARKS,
    is_for_measures,
    named_site,
    short_name,
    site_labels,
    site_part,
)
from cmfsim.values.proposed_landmarks import ORIGINS, SiteState, site_state

ROOT = Path(__file__).parents[3]
KINDS = {"skull": tuple(SKULL_LANDMARKS), "skin": SKIN_LANDMARKS}


@pytest.mark.parametrize("kind", KINDS)
def test_every_site_is_found_by_each_of_its_names(kind):
    for name in KINDS[kind]:
        assert named_site(name, kind) == name
        assert named_site(short_name(kind, name), kind) == name
        assert all(named_site(label, kind) == name for label in site_labels(kind, name))
    short = {short_name(kind, name) for name in KINDS[kind]}
    assert len(short) == len(KINDS[kind])


@pytest.mark.parametrize(
    ("label", "kind", "site"),
    [
        ("N", "skull", "nasion"),
        ("A", "skull", "mid_philtrum"),
        ("b", "skull", "supramentale"),
        ("LGo", "skull", "gonion_L"),
        ("Go_R", "skull", "gonion_R"),
        ("right Gonion", "skull", "gonion_R"),
        ("ROr", "skull", "suborbital_R"),
        ("Pog'", "skin", "pogonion"),
        ("REx", "skin", "exocanthion_R"),
        ("Pog'", "skull", None),
        ("Prn", "skull", None),
        ("S", "skull", None),
        ("ANS", "skull", None),
    ],
)
def test_labels_of_cephalometry_are_read(label, kind, site):
    assert named_site(label, kind) == site


@pytest.mark.parametrize("label", ["Go", "gonion", "Or", "zygomatic arch"])
def test_a_paired_site_without_its_side_is_an_error(label):
    with pytest.raises(cmfsim.LandmarkError, match="does not state its side"):
        named_site(label, "skull")


@pytest.mark.parametrize(
    ("label", "alone"),
    [("S", True), ("po left", True), ("UR1R", True), ("LGo", False), ("x", False)],
)
def test_sites_that_measures_alone_use_are_known(label, alone):
    assert is_for_measures(label) == alone
    assert not any(is_for_measures(name) for name in SKULL_LANDMARKS)


def test_the_sites_of_the_table_are_sites():
    plain = {kind: {n.removesuffix("_L") for n in names} for kind, names in KINDS.items()}
    for entry in CEPHALOMETRY:
        assert not entry.site or entry.site in plain[entry.kind], entry.name
    assert tuple(SKIN_SITES) == SKIN_LANDMARKS
    assert site_part("skull", "gonion_L") == "mandible"
    assert site_part("skull", "supraglenoid_L") == "cranium"
    assert site_part("skin", "pogonion") == "skin"


def test_the_page_lists_the_names_of_the_table():
    path = ROOT / "scripts/make_landmark_names.py"
    spec = importlib.util.spec_from_file_location("make_landmark_names", path)
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    text = (ROOT / "docs/landmarks.md").read_text(encoding="utf-8")
    assert script.with_table(text) == text


def test_a_file_is_read_with_abbreviations_only_if_its_kind_is_known(tmp_path):
    path = tmp_path / "points.mrk.json"
    cmfsim.write_landmarks(path, {"N": (1, 2, 3), "LGo": (4, 5, 6), "ANS": (7, 8, 9)})
    assert tuple(read_landmark_file(path).points) == ("N", "LGo", "ANS")
    found = read_landmark_file(path, kind="skull")
    assert tuple(found.points) == ("nasion", "gonion_L", "ANS")
    assert "'LGo' is 'gonion_L'" in found.findings[0].what
    cmfsim.write_landmarks(path, {"N": (1, 2, 3), "nasion": (4, 5, 6)})
    with pytest.raises(cmfsim.LandmarkError, match="'nasion' and 'N', which are one landmark"):
        read_landmark_file(path, kind="skull")
    cmfsim.write_landmarks(path, {"Pog": (1, 2, 3), "Pg": (4, 5, 6)})
    with pytest.raises(cmfsim.LandmarkError, match="a landmark twice, under two names"):
        read_landmark_file(path, kind="skull")
    cmfsim.write_landmarks(path, {"Go": (1, 2, 3)})
    with pytest.raises(cmfsim.LandmarkError, match=r"points\.mrk\.json: 'Go' does not state"):
        read_landmark_file(path, kind="skull")


@pytest.mark.parametrize("origin", ORIGINS)
def test_the_state_of_a_site_survives_in_its_description(origin):
    by_person = origin in {"placed", "accepted"}
    doubt = "" if by_person else "left; doubtful: or right"
    state = SiteState(origin, 0.0 if by_person else 2.5, doubt)
    assert site_state(state.description) == state
    assert state.by_person == by_person


def test_a_description_that_says_nothing_is_of_a_person():
    assert site_state("").by_person
    assert site_state("moved in Slicer").by_person
