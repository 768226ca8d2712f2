"""`cmfsim init --cut … --move …`: a plan without editing a file."""

import numpy as np
import pytest

import cmfsim
from cmfsim import drafting
from cmfsim.cli import main
from cmfsim.drafting import init_case
from dicom_series import axial, write_series
from synthetic_head import made_head

pytest.importorskip("SimpleITK")


def test_a_typed_plan_reads_back_as_it_was_typed(head):
    moves = ["--move", "maxilla", "forwards=4", "down=1", "pitch=2", "roll=-1"]
    words = ["init", str(head), "-q", "--cut", "genioplasty", *moves, "--move", "chin", "left=2.5"]
    assert main(words) == 0
    case = cmfsim.Case.load(head)
    procedures = [cut.procedure for cut in case.osteotomies]
    assert procedures == ["genioplasty", "le_fort_1"]
    teeth = cmfsim.read_landmarks(head / "skull.mrk.json")
    stated = cmfsim.clinical_motion("maxilla", case.plan["maxilla"].matrix, landmarks=teeth)
    found = [stated.forwards, stated.up, stated.left, stated.pitch, stated.yaw, stated.roll]
    np.testing.assert_allclose(found, [4.0, -1.0, 0.0, 2.0, 0.0, -1.0], atol=1e-9)
    assert "supradentale" in stated.place
    np.testing.assert_allclose(case.plan["chin"].matrix[:3, 3], [2.5, 0.0, 0.0])
    text = (head / "case.toml").read_text(encoding="utf-8")
    assert "--move maxilla forwards=4 down=1 pitch=2 roll=-1" in text
    assert not [f for f in cmfsim.diagnose(case) if f.severity == "error"]


def test_a_cut_alone_proposes_a_plan_and_moves_nothing(head):
    init_case(head, cuts=("bsso", "bsso"))
    case = cmfsim.Case.load(head)
    assert [cut.procedure for cut in case.osteotomies] == ["bsso"]
    assert not case.plan


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--move", "maxila", "up=1"], "'maxila': use one of chin"),
        (["--move", "cranium", "up=1"], "'cranium': use one of chin"),
        (["--move", "maxilla"], "no number"),
        (["--move", "maxilla", "forward=1"], "'forward': use one of forwards"),
        (["--move", "maxilla", "up"], "WORD=NUMBER"),
        (["--move", "maxilla", "up=nan"], "WORD=NUMBER"),
        (["--move", "maxilla", "up=1", "up=2"], "has up twice"),
        (["--move", "maxilla", "up=1", "down=2"], "has up and down"),
        (["--move", "up=1"], "the segment comes first"),
        (["--move", "chin", "up=1", "--move", "chin", "left=1"], "given twice"),
        (["--cut", "le_fort_2"], "invalid choice"),
        (["--cut", "bsso", "--move", "mandible", "backwards=3"], "write --move mandible_body for"),
        (["--move", "mandible", "up=1", "--move", "mandible_body", "up=1"], "bsso cuts it into"),
    ],
)
def test_what_cannot_be_meant_is_refused_and_nothing_is_written(head, capsys, words, said):
    try:
        code = main(["init", str(head), "-q", *words])
    except SystemExit as end:
        code = end.code
    assert code == 2
    assert said in capsys.readouterr().err
    assert not (head / "case.toml").exists()


def test_a_file_and_a_typed_motion_of_one_segment_are_refused(head):
    motion = cmfsim.rigid_motion((0.0, -2.0, 0.0))
    cmfsim.write_transform(head / "maxilla.tfm", motion, direction="to-parent")
    with pytest.raises(cmfsim.CaseError, match="moves it already"):
        init_case(head, moves={"maxilla": {"up": 1.0}})


def test_a_piece_that_is_there_is_not_cut_again(head):
    (head / "mandible.ply").rename(head / "maxilla.ply")
    with pytest.raises(cmfsim.CaseError, match="le_fort_1 makes maxilla, which is there"):
        init_case(head, cuts=("le_fort_1",))


def test_a_ct_without_landmarks_turns_about_the_teeth_that_are_found_in_it(tmp_path):
    head = cmfsim.make_head()
    cmfsim.write_image(head.ct(4.0), tmp_path / "ct.nrrd")
    draft = init_case(tmp_path, moves={"maxilla": {"forwards": 4.0, "pitch": 5.0}})
    teeth = head.skull_landmarks["supradentale"]
    motion = cmfsim.Case.load(tmp_path).plan["maxilla"].matrix
    np.testing.assert_allclose(
        motion[:3, :3], cmfsim.planned_motion(teeth, turn=(5.0, 0.0, 0.0))[:3, :3], atol=1e-12
    )
    # Within what a turn of 5 degrees makes of the error of the landmark.
    moved = motion[:3, :3] @ teeth + motion[:3, 3] - teeth
    np.testing.assert_allclose(moved, [0.0, -4.0, 0.0], atol=0.3)
    assert "(supradentale) found automatically, to within" in " ".join(draft.text.split("\n# "))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["case.toml", "ct.nrrd"]


def test_a_turn_about_teeth_that_nobody_has_placed_is_refused(tmp_path, monkeypatch):
    """A translation is the same everywhere; a turn needs the place of the teeth."""
    write_series(tmp_path / "ct", axial(made_head(6.0).image))
    monkeypatch.setattr(drafting, "_found_sites", lambda *_: {})
    with pytest.raises(cmfsim.CaseError, match=r"not known yet.*it was not found in the head"):
        init_case(tmp_path, moves={"maxilla": {"pitch": 2.0}})
    init_case(tmp_path, moves={"maxilla": {"forwards": 3.0}})
    case = cmfsim.Case.load(tmp_path)
    np.testing.assert_allclose(case.plan["maxilla"].matrix[:3, 3], [0.0, -3.0, 0.0])
    assert [cut.procedure for cut in case.osteotomies] == ["le_fort_1"]


def test_a_piece_without_landmarks_turns_about_the_middle_of_its_surface(head, monkeypatch):
    for file in head.glob("*.json"):
        file.unlink()
    monkeypatch.setattr(drafting, "_found_sites", lambda *_: {})
    draft = init_case(head, moves={"mandible": {"pitch": 2.0}})
    assert "found automatically, to within" not in draft.text
    motion = cmfsim.Case.load(head).plan["mandible"].matrix
    assert np.trace(motion[:3, :3]) == pytest.approx(1.0 + 2.0 * np.cos(np.radians(2.0)))
