"""Moduli of muscles in a case file: read, refused with line and name, and stated by the doctor."""

import re

import pytest

import cmfsim
from cmfsim.doctor.evidence import gather
from cmfsim.doctor.muscles import check_muscles
from head_case import HeadCase

CODES = ("muscle-moduli", "moduli-unusual", "unknown-name", "moduli-unusual")
OWN = """
[muscles]
preset = "kim2010"
young_along = 0.2

[muscles.moduli.masseter_L]
young_along = 0.04
young_across = 0.01
poisson = 0.4
"""


def case_of(folder, tables, tissue='preset = "kim2010"'):
    head = HeadCase()
    head.replace('preset = "kim2010"', tissue)
    head.toml += tables
    return cmfsim.Case.load(head.write(folder))


def findings(folder, tables, **more):
    found = check_muscles(gather(case_of(folder, tables, **more)))
    return [f for f in found if f.code in CODES]


def test_a_case_sets_moduli_of_all_muscles_and_of_one(tmp_path):
    moduli = case_of(tmp_path, OWN).muscles.moduli
    assert moduli == cmfsim.TissueModuli(
        muscle=cmfsim.MuscleModuli(young_along=0.2),
        muscles={"masseter_L": cmfsim.MuscleModuli(0.04, 0.01, 0.4)},
    )
    (note,) = findings(tmp_path, OWN)
    assert (note.severity, note.code) == ("note", "muscle-moduli")
    assert "fat 0.003 (poisson 0.46); muscle 0.2 along and 0.79 across" in note.what
    assert re.fullmatch(r"case\.toml:\d+ muscles\.young_along", note.where)
    (note,) = findings(tmp_path, OWN.replace("young_along = 0.2\n", ""))
    assert re.search(r"case\.toml:\d+ muscles\.moduli\.masseter_L", note.where)


def test_without_moduli_they_are_the_preset_s(tmp_path):
    plain, paper = "\n[muscles]\n", '\n[muscles]\npreset = "kim2010"\n'
    assert case_of(tmp_path, plain).muscles == cmfsim.CaseMuscles()
    assert findings(tmp_path, plain, tissue="") == []
    assert findings(tmp_path, plain, tissue="young = 0.003\npoisson = 0.40") == []
    assert findings(tmp_path, paper, tissue="") == []
    assert findings(tmp_path, paper, tissue="young = 0.003\npoisson = 0.46") == []
    # The fat of one preset between the muscles of another is reported.
    (note,) = findings(tmp_path, plain)
    assert "differ from those of passive, MPa: fat 0.003 (poisson 0.46)" in note.what


@pytest.mark.parametrize(
    ("tissue", "muscles", "fat"),
    [
        ("", "", (0.003, 0.40)),
        ("", "[muscles]", (0.003, 0.40)),
        ("", '[muscles]\npreset = "kim2010"', (0.003, 0.46)),
        ('preset = "passive"', '[muscles]\npreset = "kim2010"', (0.003, 0.40)),
        ('preset = "kim2010"', "[muscles]", (0.003, 0.46)),
        ("young = 0.002\npoisson = 0.3", '[muscles]\npreset = "kim2010"', (0.002, 0.3)),
    ],
)
def test_fat_is_that_of_tissue_and_else_of_the_muscles_preset(tmp_path, tissue, muscles, fat):
    case = case_of(tmp_path, f"\n{muscles}\n", tissue=tissue)
    assert cmfsim.FatModuli.of(case.fat).constants() == fat


def test_the_fat_of_a_case_is_stated_too(tmp_path):
    (note,) = findings(tmp_path, "\n[muscles]\n", tissue="young = 0.01\npoisson = 0.4")
    assert "fat 0.01 (poisson 0.4); muscle 0.06 along" in note.what
    with pytest.raises(cmfsim.CaseError, match=r"young is 2000: must be .* at most 1000 MPa"):
        case_of(tmp_path, "", tissue="young = 2000\npoisson = 0.4")


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ("0.04", "0.0", "muscles.moduli.masseter_L.young_along is 0: must be at least 1e-06"),
        ("0.01", "2000", "young_across is 2000: must be .* at most 1000 MPa"),
        ("= 0.4\n", "= 0.5\n", "poisson is 0.5: must be above -1 and at most 0.4999"),
        ("young_across", "young_acros", "young_acros is unknown; did you mean 'young_across'"),
        ("0.04", '"soft"', "young_along holds 'soft': a number is needed"),
        ("0.2", "nan", "young_along"),
        ("0.4\n", "-0.999999999999999\n", "masseter_L have no positive definite stiffness"),
    ],
)
def test_what_no_muscle_has_is_refused_with_line_and_key(tmp_path, before, after, words):
    with pytest.raises(cmfsim.CaseError, match=words) as caught:
        case_of(tmp_path, OWN.replace(before, after))
    assert re.match(r"case\.toml:\d+: ", str(caught.value))


def test_an_unknown_muscle_is_an_error_with_the_nearest_names(tmp_path):
    (error, _) = findings(tmp_path, OWN.replace("masseter_L", "maseter_L"))
    assert (error.severity, error.code) == ("error", "unknown-name")
    assert "'maseter_L'" in error.what
    assert error.fix.startswith("use one of: masseter_L, masseter_R")
    assert "muscles.moduli.maseter_L" in error.where


def test_kilopascals_are_a_warning(tmp_path):
    found = findings(tmp_path, OWN.replace("0.2", "200.0"))
    assert [(f.severity, f.code) for f in found][1] == ("warning", "moduli-unusual")
    assert "10 kPa is 0.01" in found[1].fix
