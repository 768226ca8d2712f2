"""`cmfsim init` on scenes of 3D Slicer: motions by the hierarchy, and questions where it is odd."""

import numpy as np
import pytest

import cmfsim
from cmfsim.drafting import init_case
from scene_text import model, pack, shift, transform, write_scene

HEAD = (model("Skin", "skin.ply"), model("Cranium", "cranium.ply"))
FORWARDS = transform("Move", shift(0, 4, 1))


def text_of(folder):
    """The case file; a comment that goes on over several lines is one."""
    return (folder / "case.toml").read_text(encoding="utf-8").replace("\n# ", " ")


def refusal(folder):
    with pytest.raises(cmfsim.CaseError) as error:
        cmfsim.Case.load(folder)
    return str(error.value)


def plan_of(folder, name):
    return np.asarray(cmfsim.Case.load(folder).plan[name].matrix)


def test_a_transform_above_a_model_is_its_motion_in_lps(tmp_path):
    """4 mm forwards is +A of Slicer's RAS and −P of the case's LPS."""
    write_scene(tmp_path, *HEAD, FORWARDS, model("Mandible", "mandible.ply", "Move"))
    draft = init_case(tmp_path)
    assert not draft.questions
    assert np.array_equal(plan_of(tmp_path, "mandible")[:3, 3], [0.0, -4.0, 1.0])
    assert "It moves the mandible 4.0 mm forwards, 1.0 mm up" in text_of(tmp_path)
    assert cmfsim.Case.load(tmp_path).surfaces.bones["mandible"].name == "mandible.ply"
    assert not [f for f in cmfsim.diagnose(tmp_path) if f.severity == "error"]


def test_backwards_is_stated_as_backwards(tmp_path):
    moved = transform("Move", shift(0, -30, 0))
    write_scene(tmp_path, *HEAD, moved, model("Mandible", "mandible.ply", "Move"))
    init_case(tmp_path)
    assert "It moves the mandible 30.0 mm backwards" in text_of(tmp_path)


def test_what_the_whole_head_lies_under_is_no_plan(tmp_path):
    """The case lies where Slicer shows the head; the plan is the rest of the chain."""
    posture = transform("Posture", shift(5, 6, 7))
    write_scene(
        tmp_path,
        posture,
        transform("Move", shift(0, 4, 1), "Posture"),
        model("Skin", "skin.ply", "Posture"),
        model("Cranium", "cranium.ply", "Posture"),
        model("Mandible", "mandible.ply", "Move"),
    )
    assert not init_case(tmp_path).questions
    case = cmfsim.Case.load(tmp_path)
    assert list(case.plan) == ["mandible"]
    assert np.allclose(plan_of(tmp_path, "mandible")[:3, 3], [0.0, -4.0, 1.0], atol=1e-12)
    there = np.asarray(cmfsim.read_surface(case.surfaces.skin).vertices)
    here = np.asarray(cmfsim.read_surface(tmp_path / "skin.ply").vertices)
    assert np.allclose(there - here, [-5.0, -6.0, 7.0], atol=1e-9)


def test_a_bundle_has_its_files_written_beside_the_case(tmp_path):
    packed = tmp_path / "packed"
    packed.mkdir()
    write_scene(packed, *HEAD, FORWARDS, model("Mandible", "mandible.ply", "Move"))
    pack(packed, tmp_path / "scene.mrb")
    draft = init_case(tmp_path)
    assert sorted(draft.files) == [
        "from_scene/cranium.ply",
        "from_scene/mandible.ply",
        "from_scene/skin.ply",
        "from_scene/skull.mrk.json",
    ]
    assert not [f for f in cmfsim.diagnose(tmp_path) if f.severity == "error"]


def test_a_cranium_that_moves_against_the_skin_is_a_question(tmp_path):
    write_scene(
        tmp_path,
        FORWARDS,
        model("Skin", "skin.ply"),
        model("Cranium", "cranium.ply", "Move"),
        model("Mandible", "mandible.ply"),
    )
    init_case(tmp_path)
    assert "plan.cranium.matrix" in refusal(tmp_path)


def test_a_registration_above_a_segment_is_a_question(tmp_path):
    named = transform("Registration 1", shift(0, 4, 1))
    write_scene(tmp_path, *HEAD, named, model("Mandible", "mandible.ply", "Registration 1"))
    init_case(tmp_path)
    assert "looks like the name of a registration" in refusal(tmp_path)
    assert "4.0 mm forwards" in refusal(tmp_path)


def test_a_transform_that_nothing_lies_under_is_a_question(tmp_path):
    """A hardened model has moved already: applying its transform again would double the plan."""
    loose = transform("Mandible move", shift(0, 4, 1))
    write_scene(tmp_path, *HEAD, loose, model("Mandible", "mandible.ply"))
    init_case(tmp_path)
    assert "was it hardened" in refusal(tmp_path)


def test_a_moved_piece_without_a_known_name_keeps_its_motion_as_a_question(tmp_path):
    write_scene(tmp_path, *HEAD, FORWARDS, model("Segment 3", "mandible.ply", "Move"))
    draft = init_case(tmp_path)
    assert [question.partition(":")[0] for question in draft.questions] == [
        "surfaces.bones.Segment_3",
        "plan.Segment_3.matrix",
    ]
    assert "  [0.0, 1.0, 0.0, -4.0]," in text_of(tmp_path)


def test_of_two_models_of_a_part_the_one_that_moves_is_taken(tmp_path):
    write_scene(
        tmp_path,
        *HEAD,
        FORWARDS,
        model("Mandible whole", "mandible.ply"),
        model("Mandible planned", "mandible.ply", "Move"),
    )
    draft = init_case(tmp_path)
    assert not draft.questions
    left = next(e for e in draft.taken if e.label.endswith("Mandible whole"))
    assert left.taken_for == "not used"


def test_a_scene_with_a_ct_and_a_moved_piece_has_the_plan_of_the_piece(tmp_path):
    """Without a skin the CT is the head; cuts are cmfsim's, which the case says."""
    pytest.importorskip("SimpleITK")
    values = np.full((30, 40, 50), -1000, dtype=np.int16)
    values[5:25, 5:35, 5:45] = 40
    cmfsim.write_image(
        cmfsim.ImageData(values, (5.0, 5.0, 5.0), (-77.0, -200.0, 1380.0)), tmp_path / "ct.nrrd"
    )
    volume = (
        '<VolumeArchetypeStorage id="sv" fileName="ct.nrrd"/>'
        '<Volume id="v" name="CT" references="storage:sv;"/>'
    )
    write_scene(tmp_path, volume, FORWARDS, model("Maxilla", "mandible.ply", "Move"))
    draft = init_case(tmp_path)
    assert not draft.questions
    case = cmfsim.Case.load(tmp_path)
    assert case.image.file.name == "ct.nrrd"
    assert [cut.procedure for cut in case.osteotomies] == ["le_fort_1"]
    assert np.array_equal(plan_of(tmp_path, "maxilla")[:3, 3], [0.0, -4.0, 1.0])
    assert "not where the scene's pieces were cut" in text_of(tmp_path)


def test_two_scenes_are_an_error_that_names_both(tmp_path):
    write_scene(tmp_path, *HEAD)
    (tmp_path / "other.mrml").write_text("<MRML></MRML>", encoding="utf-8")
    with pytest.raises(cmfsim.CaseError, match=r"other\.mrml, scene\.mrml"):
        init_case(tmp_path)
    assert init_case(tmp_path / "scene.mrml").taken


def test_a_transform_file_without_a_segment_in_its_name_is_a_question(tmp_path):
    write_scene(tmp_path, *HEAD).unlink()
    cmfsim.write_transform(tmp_path / "plan.tfm", np.eye(4), direction="to-parent")
    init_case(tmp_path)
    words = refusal(tmp_path)
    assert "plan.plan.transform" in words
    assert "Which one does it move" in words
