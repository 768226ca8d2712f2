"""Cohort files and the new tables of case files: what is wrong is said with its line."""

import pytest

import cmfsim

HEAD = 'format = "cmfsim-cohort"\nversion = 1\n'
CASE = """format = "cmfsim-case"
version = 1
[surfaces]
skin = "skin.ply"
[surfaces.bones]
cranium = "cranium.ply"
"""


def cohort(folder, text):
    path = folder / "cohort.toml"
    path.write_text(HEAD + text, encoding="utf-8")
    return cmfsim.Cohort.load(path)


def case(folder, text):
    path = folder / "case.toml"
    path.write_text(CASE + text, encoding="utf-8")
    return cmfsim.Case.load(path)


def test_a_cohort_names_its_cases_after_their_folders(tmp_path):
    found = cohort(tmp_path, '[[cases]]\nfile = "P1/case.toml"\n[[cases]]\nfile = "P2/case.toml"\n')
    assert list(found.cases) == ["P1", "P2"]
    assert found.cases["P2"] == tmp_path / "P2" / "case.toml"
    assert found.models == cmfsim.MODELS
    assert found.output == tmp_path / "study"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "names no case"),
        ('[[cases]]\nfile = "a/c.toml"\n[[cases]]\nfile = "a/d.toml"\n', "cohort.toml:6.*second"),
        ('models = ["X"]\n[[cases]]\nfile = "a/c.toml"\n', "cohort.toml:3.*H, M"),
        ('output = "/elsewhere"\n[[cases]]\nfile = "a/c.toml"\n', "cohort.toml:3.*below"),
        ('[[cases]]\nfile = "a/c.toml"\nnmae = "b"\n', "cohort.toml:5.*did you mean 'name'"),
    ],
)
def test_faults_of_a_cohort_are_named_with_their_line(tmp_path, text, message):
    with pytest.raises(cmfsim.CaseError, match=message):
        cohort(tmp_path, text)


def test_muscles_of_a_case(tmp_path):
    assert case(tmp_path, "").muscles is None
    found = case(tmp_path, "[muscles]\n").muscles
    assert (found.template, found.samples, found.mixing) == ("default", 64, "moduli")
    assert (found.preset, found.blur) == ("passive", 4.0)
    assert case(tmp_path, "[muscles]\nblur = 0\n").muscles.blur == 0.0
    with pytest.raises(cmfsim.CaseError, match=r":\d+: muscles.fit was removed.*delete it"):
        case(tmp_path, "[muscles]\nfit = false\n")
    found = case(tmp_path, '[muscles]\ntemplate = "atlas"\nsamples = 8\nseed = 3\n').muscles
    assert found.template == tmp_path / "atlas"
    assert (found.samples, found.seed) == (8, 3)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[muscles]\nsamples = 0\n", "case.toml:8.*from 1"),
        ("[muscles]\nsamples = 1.5\n", "case.toml:8.*whole"),
        ('[muscles]\nmixing = "modulus"\n', "case.toml:8.*did you mean 'moduli'"),
        ("[muscles]\nsmoothing = -1\n", "case.toml:8.*at least 0"),
        ("[muscles]\nblur = 31\n", "case.toml:8.*at most 30"),
        ("[postoperative]\n", "case.toml:7.*skin, image or bones"),
        ('[postoperative]\nskin = "a"\nimage = "b"\n', "case.toml:9.*together with skin"),
        ('[postoperative]\nskin = "a"\nbone = "b"\n', "case.toml:9.*did you mean 'bones'"),
    ],
)
def test_faults_of_the_new_tables_are_named_with_their_line(tmp_path, text, message):
    with pytest.raises(cmfsim.CaseError, match=message):
        case(tmp_path, text)
