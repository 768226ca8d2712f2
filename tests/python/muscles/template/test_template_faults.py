"""Faults in the files of a muscle template are found, each with its place."""

import shutil

import numpy as np
import pytest

import cmfsim


def edited(folder, old, new):
    """Changes the text of the template; the old text must be there."""
    path = folder / "template.toml"
    text = path.read_text("utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), "utf-8")
    return text[: text.index(old)].count("\n") + 1


def the_finding(folder, code):
    """The one finding of a code."""
    (found,) = [f for f in cmfsim.check_template(folder) if f.code == code]
    assert found.fix
    return found


def test_a_sound_folder_has_no_errors(folder):
    assert [f for f in cmfsim.check_template(folder) if f.severity == "error"] == []


@pytest.mark.parametrize(
    ("old", "new", "code", "text"),
    [
        ('kind = "strap"', 'knid = "strap"', "template-unusable", "did you mean 'kind'"),
        ('kind = "strap"', 'kind = "rope"', "template-unusable", "strap, fan, ring, sheet"),
        ('side = "L"', 'side = "left"', "template-unusable", "'left'"),
        ("boxes = 2", "boxes = 0", "template-unusable", "at least 1"),
        ("boxes = 2", "boxes = 1.5", "template-unusable", "whole number"),
        ("boxes = 2", "boxes = 65", "template-unusable", "at most 64"),
        ("licence =", "license =", "template-unusable", "did you mean 'licence'"),
        ("version = 1", "version = 2", "template-unusable", "reads 1"),
        ('"cmfsim-template"', '"cmfsim-case"', "template-unusable", "'cmfsim-template'"),
        ('"skull.ply"', '"../skull.ply"', "template-unusable", "inside the template's folder"),
        ('"skull.ply"', '"/skull.ply"', "template-unusable", "inside the template's folder"),
        ('"skull.ply"', '"C:skull.ply"', "template-unusable", "inside the template's folder"),
        ('"skull.ply"', '"none.ply"', "file-missing", "no such file"),
        ('"muscle-masseter_L.ply"', '"gone.ply"', "file-missing", "no such file"),
        ('"course-masseter_L.mrk.json"', '"no.json"', "file-missing", "no such file"),
        ('"X1"', "7", "template-unusable", "list of texts"),
    ],
)
def test_faults_in_the_text_are_found_with_their_line(folder, old, new, code, text):
    line = edited(folder, old, new)
    # A key in place of another is unknown, and the other is missing.
    wrong = [f for f in cmfsim.check_template(folder) if f.code == code]
    (found,) = [f for f in wrong if text in f.what]
    assert found.severity == "error"
    assert found.where.startswith(f"template.toml:{line}")
    with pytest.raises((cmfsim.CaseError, FileNotFoundError), match="template"):
        cmfsim.MuscleTemplate.load(folder)


def test_a_missing_licence_is_found(folder):
    path = folder / "template.toml"
    lines = path.read_text("utf-8").splitlines()
    path.write_text("\n".join(x for x in lines if not x.startswith("licence")), "utf-8")
    assert "licence" in the_finding(folder, "template-unusable").what


def test_all_faults_are_found_at_once_and_loading_says_how_many(folder):
    edited(folder, 'name = "masseter_L"', 'nmae = "masseter_L"')
    edited(folder, '"muscle-masseter_R.ply"', '"gone.ply"')
    (folder / "skull.ply").write_bytes(b"no surface")
    codes = [f.code for f in cmfsim.check_template(folder)]
    assert sorted(codes) == ["file-missing", "template-unusable", "template-unusable"]
    with pytest.raises(cmfsim.CaseError, match="2 more"):
        cmfsim.MuscleTemplate.load(folder)


def test_a_link_out_of_the_folder_is_refused(folder, tmp_path):
    shutil.move(folder / "skull.ply", tmp_path / "outside.ply")
    try:
        (folder / "skull.ply").symlink_to(tmp_path / "outside.ply")
    except OSError:
        pytest.skip("this system makes no links")
    assert "inside the template's folder" in the_finding(folder, "template-unusable").what


def test_text_that_is_no_toml_is_one_finding(folder):
    (folder / "template.toml").write_text("name = [", "utf-8")
    assert "not TOML" in the_finding(folder, "template-unusable").what


def test_a_landmark_twice_is_found(folder):
    path = folder / "skull.mrk.json"
    path.write_text(path.read_text("utf-8").replace('"glabella"', '"nasion"'), "utf-8")
    assert "'nasion'" in the_finding(folder, "template-unusable").what


def test_names_of_no_template_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="built in: default"):
        cmfsim.MuscleTemplate.load("nobody")
    with pytest.raises(FileNotFoundError, match=r"template\.toml"):
        cmfsim.MuscleTemplate.load(tmp_path)


def test_broken_archives_are_refused(small, tmp_path):
    path = tmp_path / "t.npz"
    small.save(path)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(cmfsim.CaseError, match=r"t\.npz"):
        cmfsim.MuscleTemplate.load(path)
    path.write_bytes(data)
    with np.load(path) as archive:
        members = dict(archive)
    for name, value in (
        ("vertices", members["vertices"][:, :-1]),
        ("vertices", members["vertices"].T),
        ("triangle_steps", members["triangle_steps"] + 1),
        ("triangle_steps", members["triangle_steps"][:-1]),
        ("landmarks", members["landmarks"][:-1]),
        ("landmarks", members["landmarks"] * np.nan),
        ("template", np.array(str(members["template"]).replace('"vertices": 8', '"vertices": -8'))),
        ("template", np.array(str(members["template"]).replace('"strap"', '"rope"'))),
    ):
        np.savez(path, **{**members, name: value})
        with pytest.raises(cmfsim.CmfsimError):
            cmfsim.MuscleTemplate.load(path)


@pytest.mark.parametrize("boxes", ["1000000", "1e6", "0", "true", '"2"', "9" * 300])
def test_an_archive_that_asks_for_too_many_boxes_is_refused(small, tmp_path, boxes):
    """Only a folder's template was limited: 100 000 boxes ended the interpreter."""
    path = tmp_path / "t.npz"
    small.save(path)
    with np.load(path) as archive:
        members = dict(archive)
    text = str(members["template"])
    assert text.count('"boxes": 2') >= 1
    members["template"] = np.array(text.replace('"boxes": 2', f'"boxes": {boxes}'))
    np.savez(path, **members)
    with pytest.raises(cmfsim.CaseError, match=r"t\.npz.*boxes of masseter_L.* 1 to 64"):
        cmfsim.MuscleTemplate.load(path)
    findings = cmfsim.check_template(path)
    assert any(f.severity == "error" and "boxes of masseter_L" in f.what for f in findings)
