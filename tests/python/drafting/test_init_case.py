"""`cmfsim init`: a folder becomes a case file, and nothing unclear is decided silently."""

import json
import re

import numpy as np
import pytest

import cmfsim
import head_case
from cmfsim.cli import main
from cmfsim.doctor import examine
from cmfsim.drafting import init_case
from synthetic_head import made_head

pytest.importorskip("SimpleITK")

FORWARDS = cmfsim.rigid_motion((0.0, -4.0, 1.0))


def text_of(folder):
    return (folder / "case.toml").read_text(encoding="utf-8")


def refusal(folder):
    """What the doctor refuses the case with."""
    with pytest.raises(cmfsim.CaseError) as error:
        cmfsim.Case.load(folder)
    return str(error.value)


def vtp_without_frame(folder, name, surface, scale=1.0):
    """A surface that states neither frame nor unit."""
    moved = cmfsim.SurfaceData(np.asarray(surface.vertices) * scale, surface.triangles)
    cmfsim.write_surface(folder / f"{name}.vtp", moved)


def test_a_folder_of_surfaces_becomes_a_case_without_findings(head):
    draft = init_case(head)
    assert not draft.questions
    case = cmfsim.Case.load(head)
    assert set(case.surfaces.bones) == {"cranium", "mandible"}
    assert case.landmarks.skull.name == "skull.mrk.json"
    assert not [f for f in cmfsim.diagnose(case) if f.severity == "error"]
    taken = {entry.label: entry for entry in draft.taken}
    assert taken["skin.ply"].taken_for == "skin"
    assert taken["skull.mrk.json"].frame == "LPS"
    assert "14 of" not in taken["skull.mrk.json"].why


def test_a_case_file_is_replaced_only_by_force(head, capsys):
    init_case(head)
    before = text_of(head)
    assert main(["init", str(head), "-q"]) == 2
    assert "--force" in capsys.readouterr().err
    assert text_of(head) == before
    assert main(["init", str(head), "-q", "--force"]) == 0


def test_two_mandibles_are_a_question_that_doctor_repeats(head, capsys):
    (head / "jaw2.ply").write_bytes((head / "mandible.ply").read_bytes())
    init_case(head)
    line = next(n for n, row in enumerate(text_of(head).splitlines(), 1) if '"?"' in row and n > 4)
    assert main(["doctor", str(head)]) == 2
    words = capsys.readouterr().err
    assert f"case.toml:{line}: surfaces.bones.mandible" in words
    assert "jaw2.ply or mandible.ply" in words


def test_a_slicer_transform_is_inverted_and_stated_in_words(head):
    """Among files that Slicer saved, an ITK file is from-parent, and the case states it."""
    ply = head / "mandible.ply"
    ply.write_bytes(ply.read_bytes().replace(b"comment LPS mm\n", b"comment SPACE=LPS\n"))
    path = head / "mandible_move.tfm"
    cmfsim.write_transform(path, FORWARDS, direction="from-parent")
    without_comment(path)
    init_case(head)
    case = cmfsim.Case.load(head)
    motion = cmfsim.read_transform(
        case.plan["mandible"].transform, direction=case.plan["mandible"].direction
    )
    assert np.abs(motion - FORWARDS).max() < 1e-12
    text = text_of(head).replace("\n# ", " ")
    assert "It moves the mandible 4.0 mm forwards, 1.0 mm up" in text
    assert "4.0 mm backwards, 1.0 mm down" in text


@pytest.mark.usefixtures("no_landmarks")
def test_init_doctor_and_predict_state_one_plan_alike(head):
    """Without landmarks each stated it at a point of its own surface: three sets of numbers."""
    for name in ("skull", "skin"):
        (head / f"{name}.mrk.json").unlink()
    turned = cmfsim.rigid_motion((0.0, -4.0, 1.0), 8.0, (1.0, 0.2, 0.1), (3.0, -100.0, 1450.0))
    cmfsim.write_transform(head / "mandible.tfm", turned, direction="from-parent")
    init_case(head)
    path = head / "case.toml"
    text = path.read_text(encoding="utf-8")
    # As coarse as a mesh can be: the segment's own surface ends 0.4 mm behind the bone.
    path.write_text(
        text.replace("[output]", "[mesh]\nedge_length = 12\n\n[output]"), encoding="utf-8"
    )
    case = cmfsim.Case.load(path)
    stated = examine(case).plan["mandible"]
    assert "pitch −7.8°" in stated.text
    assert f"moves the mandible {stated.text}" in text.replace("\n# ", " ")
    solved = cmfsim.predict(case, model="H", check=False).summary["plan"]["mandible"]["clinical"]
    assert solved["text"].replace(f" [{solved['source']}]", "") == stated.text
    assert np.allclose(solved["point"], stated.point, atol=1e-9)


def without_comment(path):
    """An ITK file as other programs write it: without the comment of cmfsim."""
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    path.write_text("".join(line for line in lines if "mm, LPS" not in line), encoding="utf-8")


def test_a_transform_of_unknown_origin_is_a_question_with_both_answers(head):
    for name in ("skin", "cranium", "mandible"):
        surface = cmfsim.read_surface(head / f"{name}.ply")
        (head / f"{name}.ply").unlink()
        vtp_without_frame(head, name, surface)
    path = head / "mandible.tfm"
    cmfsim.write_transform(path, FORWARDS, direction="to-parent")
    without_comment(path)
    init_case(head)
    words = refusal(head)
    assert "plan.mandible.transform.direction" in words
    assert '"from-parent" (as 3D Slicer saves it): moves the mandible 4.0 mm backwards' in words
    assert '"to-parent" (as ITK registers it): moves the mandible 4.0 mm forwards' in words


def test_a_typed_matrix_without_a_frame_is_a_question(head):
    rows = "\n".join(" ".join(str(v) for v in row) for row in FORWARDS)
    (head / "mandible.txt").write_text(rows, encoding="utf-8")
    (head / "notes.txt").write_text("call the patient", encoding="utf-8")
    init_case(head)
    assert "plan.mandible.transform.frame" in refusal(head)
    assert "notes.txt: not used (is no transform" in text_of(head)


def test_a_stated_direction_is_kept(head):
    cmfsim.write_transform(head / "mandible.tfm", FORWARDS, direction="to-parent")
    init_case(head)
    assert cmfsim.Case.load(head).plan["mandible"].direction == "to-parent"


def test_a_transform_that_is_not_rigid_is_a_question_with_the_reason(head):
    text = (
        "#Insight Transform File V1.0\nTransform: AffineTransform_double_3_3\n"
        "Parameters: 1.2 0 0 0 1 0 0 0 1 0 0 0\nFixedParameters: 0 0 0\n"
    )
    (head / "mandible.tfm").write_text(text, encoding="utf-8")
    init_case(head)
    assert "scale" in refusal(head)


@pytest.mark.parametrize(("factor", "unit"), [(1e-3, "m"), (0.1, "cm"), (1 / 25.4, "inch")])
def test_other_units_are_a_question_that_names_the_fitting_one(head, factor, unit):
    for name in ("skin", "cranium", "mandible"):
        surface = cmfsim.read_surface(head / f"{name}.ply")
        (head / f"{name}.ply").unlink()
        vtp_without_frame(head, name, surface, factor)
    init_case(head)
    words = refusal(head)
    assert "surfaces.units" in words
    assert f'"{unit}": then it is 2' in words


def test_an_unstated_frame_is_read_off_what_states_its_own(head):
    """In RAS the head lies on the other side of the origin than its landmarks."""
    flip = np.array([-1.0, -1.0, 1.0])
    for name in ("skin", "cranium", "mandible"):
        surface = cmfsim.read_surface(head / f"{name}.ply")
        (head / f"{name}.ply").unlink()
        turned = cmfsim.SurfaceData(np.asarray(surface.vertices) * flip, surface.triangles)
        vtp_without_frame(head, name, turned)
    init_case(head)
    case = cmfsim.Case.load(head)
    assert case.surfaces.frame == "RAS"
    assert "read as RAS they are where" in text_of(head)
    skin = cmfsim.read_surface(case.surfaces.skin, frame=case.surfaces.frame)
    assert np.asarray(skin.vertices)[:, 1].mean() == pytest.approx(-100.0, abs=1.0)


def test_an_unstated_frame_of_a_head_at_the_origin_shows_by_its_jaw(tmp_path):
    """The jaw lies in front of the cranium's middle: −P in LPS."""
    for name, surface in head_case.surfaces().items():
        centred = np.asarray(surface.vertices) - [3.0, -100.0, 1500.0]
        vtp_without_frame(tmp_path, name, cmfsim.SurfaceData(centred, surface.triangles))
    init_case(tmp_path)
    assert "read as LPS mandible lies" in text_of(tmp_path)
    assert cmfsim.Case.load(tmp_path).surfaces.frame == "LPS"


def test_an_unstated_frame_that_nothing_shows_is_a_question(tmp_path):
    for name in ("skin", "cranium"):
        surface = head_case.ellipsoid(name)
        centred = np.asarray(surface.vertices) - np.asarray(surface.vertices).mean(axis=0)
        vtp_without_frame(tmp_path, name, cmfsim.SurfaceData(centred, surface.triangles))
    init_case(tmp_path)
    assert "surfaces.frame" in refusal(tmp_path)


def test_a_bone_that_is_there_twice_is_a_question(head):
    centre, axes = np.array([3.0, -125.0, 1505.0]), np.array([15.0, 10.0, 8.0])
    vertices, triangles = head_case.icosphere(2)
    piece = cmfsim.SurfaceData(vertices * axes + centre, triangles)
    cmfsim.write_surface(head / "maxilla_lefort1.ply", piece)
    init_case(head)
    words = refusal(head)
    assert "surfaces.bones.maxilla" in words
    assert "twice" in words
    assert "le_fort_1" in words


def test_a_surface_without_a_known_name_is_a_question(head):
    (head / "Segment_3.ply").write_bytes((head / "mandible.ply").read_bytes())
    init_case(head)
    assert "surfaces.bones.Segment_3" in refusal(head)


def test_an_unnamed_surface_round_all_others_is_the_skin(head):
    (head / "skin.ply").rename(head / "Segment_1.ply")
    draft = init_case(head)
    assert cmfsim.Case.load(head).surfaces.skin.name == "Segment_1.ply"
    assert any("encloses every other" in entry.why for entry in draft.taken)


def test_faces_after_the_operation_go_to_their_own_table(head):
    (head / "skin_postop.ply").write_bytes((head / "skin.ply").read_bytes())
    (head / "mandible_postop.ply").write_bytes((head / "mandible.ply").read_bytes())
    init_case(head)
    case = cmfsim.Case.load(head)
    assert case.achieved
    assert case.postoperative.skin.name == "skin_postop.ply"
    assert set(case.postoperative.bones) == {"mandible"}


def test_faces_after_in_the_other_frame_are_noticed_by_their_place(head):
    """A skin in RAS lies 200 mm away, unless its frame is stated."""
    skin = cmfsim.read_surface(head / "skin.ply")
    turned = np.asarray(skin.vertices) * [-1.0, -1.0, 1.0]
    vtp_without_frame(head, "skin_postop", cmfsim.SurfaceData(turned, skin.triangles))
    init_case(head)
    after = cmfsim.Case.load(head).postoperative
    assert after.frame == "RAS"
    assert after.aligned
    assert "0 mm apart" in text_of(head)


def test_a_face_of_another_scan_is_not_aligned(head):
    skin = cmfsim.read_surface(head / "skin.ply")
    moved = np.asarray(skin.vertices) + [0.0, 60.0, 0.0]
    cmfsim.write_surface(head / "skin_postop.ply", cmfsim.SurfaceData(moved, skin.triangles))
    init_case(head)
    assert not cmfsim.Case.load(head).postoperative.aligned


def test_a_ct_is_taken_before_its_surfaces_which_stay_as_a_comment(head):
    image(head / "ct.nrrd", -1000.0)
    init_case(head)
    case = cmfsim.Case.load(head)
    assert case.image.file.name == "ct.nrrd"
    assert '# skin = "skin.ply"' in text_of(head)


def image(path, low, shape=(40, 50, 60)):
    """A block of tissue in air, round the head of ellipsoids."""
    values = np.full(shape, low, dtype=np.int16)
    values[10:30, 10:40, 10:50] = int(low) + 1040
    origin = (-77.0, -200.0, 1380.0)
    cmfsim.write_image(cmfsim.ImageData(values, (4.0, 4.0, 4.0), origin), path)


def test_two_cts_are_a_question(tmp_path):
    image(tmp_path / "a.nrrd", -1000.0)
    image(tmp_path / "b.nrrd", -1000.0)
    init_case(tmp_path)
    words = refusal(tmp_path)
    assert "image.file" in words
    assert "a.nrrd or b.nrrd" in words


def test_a_ct_that_is_not_in_hounsfield_units_is_a_question(tmp_path):
    """Air and one tissue without any bone: no scale is clear."""
    image(tmp_path / "ct.nrrd", 0.0)
    init_case(tmp_path)
    assert "image.rescale" in refusal(tmp_path)
    assert "[1, -1024]" in refusal(tmp_path)


@pytest.mark.parametrize(
    ("slope", "smear", "stated"),
    [(1.0, 0.0, "1·value -1024, to within 10 HU"), (0.6, 0.0, "to within 40 HU"), (0.6, 300.0, "")],
)
def test_a_clear_scale_is_stated_with_its_error_and_not_asked(tmp_path, slope, smear, stated):
    """One peak of tissue leaves open whether it is fat, if there is more above it."""
    whole = made_head().image
    hu = whole.values + smear * np.random.default_rng(0).random(whole.values.shape[2])
    values = np.round(slope * (hu + 1024.0)).astype(np.int16)
    cmfsim.write_image(whole.with_values(values), tmp_path / "ct.nrrd")
    init_case(tmp_path)
    text = re.sub(r"\s*\n# +", " ", text_of(tmp_path))
    assert ("which are not HU" in text) is bool(stated)
    assert ("How do they become HU?" in text) is not stated
    assert stated in text
    if stated:
        assert cmfsim.Case.load(tmp_path).image.rescale is None


def test_without_landmarks_a_head_gets_those_that_are_found_and_muscles(head):
    for name in ("skull", "skin"):
        (head / f"{name}.mrk.json").unlink()
    init_case(head)
    case = cmfsim.Case.load(head)
    assert case.landmarks.proposed
    assert case.muscles is not None
    assert "cmfsim landmarks case.toml" in text_of(head)
    assert [f.severity for f in cmfsim.diagnose(case) if f.code == "landmarks-automatic"] == [
        "note"
    ]


def test_with_landmarks_of_the_skin_alone_muscles_wait_for_those_of_the_skull(head):
    (head / "skull.mrk.json").unlink()
    init_case(head)
    case = cmfsim.Case.load(head)
    assert case.muscles is None
    assert not case.landmarks.proposed
    assert "add an empty [muscles]" in re.sub(r"\s*\n# +", " ", text_of(head))


def test_landmarks_without_a_frame_are_read_where_the_head_is(head):
    file = head / "skull.mrk.json"
    document = json.loads(file.read_text(encoding="utf-8"))
    for markup in document["markups"]:
        del markup["coordinateSystem"]
    file.write_text(json.dumps(document), encoding="utf-8")
    init_case(head)
    assert cmfsim.Case.load(head).landmarks.frame == "LPS"


def test_a_damaged_surface_is_reported_and_left_out(head):
    whole = (head / "mandible.ply").read_bytes()
    (head / "mandible.ply").write_bytes(whole[: len(whole) // 2])
    draft = init_case(head)
    entry = next(entry for entry in draft.taken if entry.label == "mandible.ply")
    assert entry.taken_for == "not used"
    assert "cut short" in entry.why


def test_a_folder_with_nothing_is_an_error_that_lists_what_is_read(tmp_path, capsys):
    (tmp_path / "notes.txt").write_text("nothing", encoding="utf-8")
    assert main(["init", str(tmp_path), "-q"]) == 2
    assert "NRRD" in capsys.readouterr().err
    assert main(["init", str(tmp_path / "absent"), "-q"]) == 2
    assert not (tmp_path / "case.toml").exists()


def test_names_cannot_write_lines_of_the_case(head):
    """A line break in a file's name stays inside its comment and its text."""
    name = 'mandible"\n[output]\nfolder = "elsewhere'
    try:
        (head / f"{name}.ply").write_bytes((head / "mandible.ply").read_bytes())
    except OSError:
        pytest.skip("the system has no such names")
    (head / "mandible.ply").unlink()
    init_case(head)
    assert len(re.findall(r"^\[output\]", text_of(head), re.MULTILINE)) == 1
    assert cmfsim.Case.load(head).surfaces.bones["mandible"].name == f"{name}.ply"
