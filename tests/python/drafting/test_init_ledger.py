"""`cmfsim init` accounts for each file, segment, node and point, and reads its own case back."""

import json

import numpy as np
import pytest

import cmfsim
import head_case
import label_images
from cmfsim.drafting import init_case, written
from cmfsim.drafting.roles import name_role
from cmfsim.drafting.written import UNDECIDED
from cmfsim.io.cases.case_tables import matrix_rows
from scene_text import model, pack, shift, transform, write_scene

pytest.importorskip("SimpleITK")
FLIP = np.array([-1.0, -1.0, 1.0])


def entries(folder):
    """What init says of each thing; nothing may be left that it did not decide about."""
    draft = init_case(folder)
    assert not [entry for entry in draft.taken if entry.why == UNDECIDED]
    return {entry.label: entry for entry in draft.taken}


def bone_of(folder, name):
    surfaces = cmfsim.Case.load(folder).surfaces
    path = surfaces.skin if name == "skin" else surfaces.bones[name]
    return cmfsim.read_surface(path, units=surfaces.units, frame=surfaces.frame)


# ------------------------------------------------------------------ teeth and segments


def test_teeth_of_a_segmentation_belong_to_their_jaws(tmp_path):
    masks = label_images.masks()
    label_images.write_seg(tmp_path / "s.seg.nrrd", masks)
    taken = entries(tmp_path)
    assert taken["s.seg.nrrd / Upper Teeth"].taken_for == "part of cranium"
    assert taken["s.seg.nrrd / Lower Teeth"].taken_for == "part of mandible"
    both = masks["Mandible"] | masks["Lower Teeth"]
    volume = label_images.volume(bone_of(tmp_path, "mandible"))
    assert volume == pytest.approx(both.sum() * 64.0, rel=0.05)
    assert volume > 1.1 * masks["Mandible"].sum() * 64.0


def test_teeth_whose_jaw_the_name_does_not_say_are_asked_about(tmp_path):
    masks = label_images.masks()
    given = {n: masks[n] for n in ("Skin", "Maxilla & Upper Skull", "Mandible")}
    given["Teeth"] = masks["Upper Teeth"] | masks["Lower Teeth"]
    label_images.write_seg(tmp_path / "s.seg.nrrd", given)
    assert entries(tmp_path)["s.seg.nrrd / Teeth"].question
    with pytest.raises(cmfsim.CaseError, match="which bone do these teeth belong to"):
        cmfsim.Case.load(tmp_path)


def test_empty_segments_and_those_of_no_bone_get_a_reason(tmp_path):
    masks = label_images.masks()
    given = {n: masks[n] for n in ("Skin", "Maxilla & Upper Skull", "Mandible")}
    given |= {"Mandibular canal": masks["Mandible"], "Chin": masks["Mandible"] & False}
    label_images.write_seg(tmp_path / "s.seg.nrrd", given)
    taken = entries(tmp_path)
    assert "canal" in taken["s.seg.nrrd / Mandibular canal"].why
    assert "empty" in taken["s.seg.nrrd / Chin"].why


def test_teeth_in_a_file_of_their_own_are_added_to_the_nearer_jaw(head):
    """As models from a dental scan: the name says "Teeth" alone, their place says which."""
    vertices, triangles = head_case.icosphere(2)
    teeth = cmfsim.SurfaceData(vertices * 8.0 + [3.0, -158.0, 1448.0], triangles)
    cmfsim.write_surface(head / "Teeth.ply", teeth)
    taken = entries(head)
    assert taken["Teeth.ply"].taken_for == "part of mandible"
    before = label_images.volume(cmfsim.read_surface(head / "mandible.ply"))
    after = label_images.volume(bone_of(head, "mandible"))
    assert before + 100.0 < after < before + 4.0 / 3.0 * np.pi * 8.0**3


@pytest.mark.parametrize(
    ("name", "part"),
    [
        ("Upper Teeth", "upper teeth"),
        ("Zähne oben", "upper teeth"),
        ("tooth_36", "lower teeth"),
        ("Upper Right Central Incisor", "upper teeth"),
        ("Teeth", "teeth"),
        ("Mandible with teeth", "mandible"),
        ("Mandibular canal", "other"),
        ("Unterkiefer", "mandible"),
        ("Scha\u0308del", "cranium"),
        ("Weichteile", "skin"),
        ("proximales Segment rechts", "ramus_right"),
        ("Ramus links", "ramus_left"),
        ("mâchoire inférieure", "mandible"),
        ("maxilar inferior", "mandible"),
        ("maxillaire inférieur", "mandible"),
        ("maxillaire supérieur", "maxilla"),
        ("bovenkaak", "maxilla"),
        ("Onderkaak", "mandible"),
        ("schedel", "cranium"),
        ("huid", "skin"),
        ("branche_gauche", "ramus_left"),
        ("ramo destro", "ramus_right"),
        ("cuerpo de la mandíbula", "mandible_body"),
        ("Upper Jawbone", "maxilla"),
        ("sinus_maxillary", "other"),
    ],
)
def test_names_in_other_words_say_their_part(name, part):
    assert name_role(name).part == part


# ------------------------------------------------------------------ files, nodes and points


def test_every_file_of_a_folder_is_used_or_not_with_a_reason(head):
    for name in ("notes.txt", "front.jpg", "profile.jpg", ".hidden", "photos/a.jpg"):
        (head / name).parent.mkdir(exist_ok=True)
        (head / name).write_bytes(b"x")
    (head / "out").mkdir()
    (head / "out" / "prediction.json").write_text("{}", encoding="utf-8")
    deep = head / "a/b/c/d/e/f/g"
    deep.mkdir(parents=True)
    (deep / "jaw.stl").write_bytes(b"x")
    taken = entries(head)
    covered = {path.name for entry in taken.values() for path in entry.paths} | set(taken)
    for name in ("front.jpg", "profile.jpg", ".hidden", "a.jpg", "out", "g", "notes.txt"):
        assert name in covered, name
    assert "folders down" in next(e.why for e in taken.values() if (deep in e.paths))


def test_a_link_that_leads_out_of_the_folder_is_reported(head, tmp_path_factory):
    elsewhere = tmp_path_factory.mktemp("elsewhere") / "midface.ply"
    elsewhere.write_bytes((head / "mandible.ply").read_bytes())
    try:
        (head / "midface.ply").symlink_to(elsewhere)
    except OSError:
        pytest.skip("the system has no links")
    assert entries(head)["midface.ply"].taken_for


def test_points_that_are_not_used_or_were_never_placed_are_named(head):
    file = head / "skull.mrk.json"
    document = json.loads(file.read_text(encoding="utf-8"))
    points = document["markups"][0]["controlPoints"]
    points.append({"label": "implant_tip", "position": [0, -100, 1450]})
    points.append({"label": "gnathion", "position": [0, 0, 0], "positionStatus": "undefined"})
    file.write_text(json.dumps(document), encoding="utf-8")
    why = entries(head)["skull.mrk.json"].why
    assert "not used: implant_tip" in why
    assert "never placed: gnathion" in why


def test_every_node_of_a_scene_is_used_or_not_with_a_reason(tmp_path):
    """A plane, the plan's transform, one above the whole head, and one above what is not used."""
    plane = (
        '<MarkupsJsonStorage id="sp" fileName="plane.mrk.json"/>'
        '<MarkupsPlane id="Frankfort" name="Frankfort" references="storage:sp;"/>'
    )
    write_scene(
        tmp_path,
        transform("Posture", shift(5, 6, 7)),
        transform("Move", shift(0, 4, 1), "Posture"),
        transform("Tray", shift(1, 2, 3)),
        model("Skin", "skin.ply", "Posture"),
        model("Cranium", "cranium.ply", "Posture"),
        model("Mandible", "mandible.ply", "Move"),
        model("Splint", "splint.ply", "Tray"),
        plane,
    )
    (tmp_path / "splint.ply").write_bytes((tmp_path / "mandible.ply").read_bytes())
    (tmp_path / "plane.mrk.json").write_text("{}", encoding="utf-8")
    taken = entries(tmp_path)
    assert "MarkupsPlane" in taken["scene.mrml: Frankfort"].why
    assert "Skin, Cranium" in taken["scene.mrml: Posture"].why
    assert "Splint" in taken["scene.mrml: Tray"].why
    assert "splint" in taken["scene.mrml: Splint"].why
    assert taken["Move, Posture"].taken_for == "motion of mandible"
    assert "scene.mrml: Move" not in taken


def test_a_ct_after_the_operation_next_to_surfaces_of_it_is_not_used(head):
    (head / "skin_postop.ply").write_bytes((head / "skin.ply").read_bytes())
    values = np.full((40, 40, 40), -1000, np.int16)
    values[10:30, 10:30, 10:30] = 40
    cmfsim.write_image(cmfsim.ImageData(values, (4.0, 4.0, 4.0)), head / "ct_postop.nrrd")
    taken = entries(head)
    assert taken["ct_postop.nrrd"].taken_for == "not used"
    assert taken["skin_postop.ply"].taken_for == "skin after the operation"


# ------------------------------------------------------------------ exchanged or claimed twice


def test_two_faces_after_the_operation_are_a_question(head):
    for name in ("skin_postop.ply", "skin_6_months_after.ply"):
        (head / name).write_bytes((head / "skin.ply").read_bytes())
    taken = entries(head)
    assert taken["skin_postop.ply"].question
    with pytest.raises(cmfsim.CaseError, match=r"postoperative\.skin"):
        cmfsim.Case.load(head)


@pytest.mark.parametrize("exchanged", [True, False])
def test_rami_whose_names_say_the_wrong_side_are_a_question(head, exchanged):
    vertices, triangles = head_case.icosphere(2)
    for name, side in (("left", 1.0), ("right", -1.0)):
        x = 3.0 + side * 45.0 * (-1.0 if exchanged else 1.0)
        ramus = cmfsim.SurfaceData(vertices * [6.0, 12.0, 25.0] + [x, -100.0, 1460.0], triangles)
        cmfsim.write_surface(head / f"ramus_{name}.ply", ramus)
    (head / "mandible.ply").rename(head / "mandible_body.ply")
    taken = entries(head)
    assert taken["ramus_left.ply"].question == exchanged
    assert ("patient's right" in taken["ramus_left.ply"].why) == exchanged


def test_landmark_lists_of_two_formats_without_a_frame_are_each_read_where_the_head_is(head):
    """A `.fcsv` without a frame means RAS, a `.mrk.json` means LPS; the numbers of both are RAS."""
    case = head_case.HeadCase()
    rows = [
        f"{k},{','.join(map(str, np.array(point) * FLIP))},0,0,0,1,1,1,0,{label},,"
        for k, (label, point) in enumerate(case.skull.items())
    ]
    (head / "skull.mrk.json").unlink()
    (head / "skull.fcsv").write_text(
        "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n"
        + "\n".join(row.replace(",0,0,0,1,", ",0,0,0,1,1,", 1) for row in rows),
        encoding="utf-8",
    )
    file = head / "skin.mrk.json"
    document = json.loads(file.read_text(encoding="utf-8"))
    del document["markups"][0]["coordinateSystem"]
    for point in document["markups"][0]["controlPoints"]:
        point["position"] = (np.array(point["position"]) * FLIP).tolist()
    file.write_text(json.dumps(document), encoding="utf-8")
    entries(head)
    assert cmfsim.Case.load(head).landmarks.frame == "RAS"


# ------------------------------------------------------------------ from the scene to the case


@pytest.mark.parametrize("states", ['coordinateSystem="RAS"', ""])
@pytest.mark.parametrize("moved", ["", "Posture"])
def test_the_frame_of_a_scene_reaches_the_case(tmp_path, states, moved):
    """Slicer takes models of a scene that states no frame for RAS (vtkMRMLModelStorageNode)."""
    path = write_scene(
        tmp_path,
        transform("Posture", shift(5, 6, 7)),
        transform("Move", shift(0, 4, 1), moved),
        *(model(n, f"{n.lower()}.ply", moved) for n in ("Skin", "Cranium")),
        model("Mandible", "mandible.ply", "Move"),
    )
    for name, surface in head_case.surfaces().items():
        turned = cmfsim.SurfaceData(np.asarray(surface.vertices) * FLIP, surface.triangles)
        cmfsim.write_surface(tmp_path / f"{name}.stl", turned)
        data = (tmp_path / f"{name}.stl").read_bytes()
        (tmp_path / f"{name}.stl").write_bytes(b"made elsewhere".ljust(80) + data[80:])
        (tmp_path / f"{name}.ply").unlink()
    text = path.read_text(encoding="utf-8").replace(".ply", ".stl")
    path.write_text(text.replace("<ModelStorage", f"<ModelStorage {states}"), encoding="utf-8")
    init_case(tmp_path)
    shifted = np.array([-5.0, -6.0, 7.0]) if moved else np.zeros(3)
    for name, surface in head_case.surfaces().items():
        expected = np.asarray(surface.vertices).mean(axis=0) + shifted
        here = np.asarray(bone_of(tmp_path, name).vertices).mean(axis=0)
        assert np.abs(here - expected).max() < 1e-3
    assert cmfsim.Case.load(tmp_path).surfaces.frame == (None if moved else "RAS")
    plan = np.asarray(cmfsim.Case.load(tmp_path).plan["mandible"].matrix)
    assert np.allclose(plan[:3, 3], [0.0, -4.0, 1.0], atol=1e-9)


def test_a_file_in_another_frame_than_the_others_is_turned(head):
    """The others state LPS; a case states one frame for all, so this one gets a copy in LPS."""
    given = cmfsim.read_surface(head / "mandible.ply")
    (head / "mandible.ply").unlink()
    turned = cmfsim.SurfaceData(np.asarray(given.vertices) * FLIP, given.triangles)
    cmfsim.write_surface(head / "mandible.vtp", turned)
    taken = entries(head)
    assert taken["mandible.vtp"].frame == "RAS"
    here = np.asarray(bone_of(head, "mandible").vertices)
    assert np.abs(here - np.asarray(given.vertices)).max() < 1e-9


def test_a_face_after_the_operation_in_a_bundle_lies_where_slicer_shows_it(tmp_path):
    packed = tmp_path / "packed"
    packed.mkdir()
    write_scene(
        packed,
        transform("Back", shift(0, 60, 0)),
        model("Skin", "skin.ply"),
        model("Cranium", "cranium.ply"),
        model("Skin postop", "skin_after.ply", "Back"),
    )
    after = cmfsim.read_surface(packed / "skin.ply")
    moved = cmfsim.SurfaceData(np.asarray(after.vertices) + [0.0, 60.0, 0.0], after.triangles)
    cmfsim.write_surface(packed / "skin_after.ply", moved)
    pack(packed, tmp_path / "scene.mrb")
    init_case(tmp_path)
    found = cmfsim.Case.load(tmp_path).postoperative
    here = np.asarray(cmfsim.read_surface(found.skin).vertices)
    assert np.abs(here - np.asarray(after.vertices)).max() < 1e-9
    assert found.aligned


def test_landmarks_of_a_scene_lie_where_slicer_shows_them(tmp_path):
    """The head lies under a posture, the list under nothing: it was placed on what is shown."""
    write_scene(
        tmp_path,
        transform("Posture", shift(5, 6, 7)),
        *(model(n, f"{n.lower()}.ply", "Posture") for n in ("Skin", "Cranium", "Mandible")),
    )
    init_case(tmp_path)
    given = head_case.HeadCase().skull
    read = cmfsim.read_landmarks(cmfsim.Case.load(tmp_path).landmarks.skull)
    assert all(np.abs(read[label] - point).max() < 1e-9 for label, point in given.items())


def test_a_case_that_reads_as_something_else_than_was_shown_is_an_error(tmp_path, monkeypatch):
    """The writer of surfaces is made to turn them: no case is left."""
    label_images.write_seg(tmp_path / "s.seg.nrrd", label_images.masks())
    write = written.write_surface

    def turned(path, surface):
        write(path, cmfsim.SurfaceData(np.asarray(surface.vertices) * FLIP, surface.triangles))

    monkeypatch.setattr(written, "write_surface", turned)
    with pytest.raises(cmfsim.CaseError, match=r"skin \(from_scene/skin.ply\) lies up to"):
        init_case(tmp_path)
    assert not (tmp_path / "case.toml").exists()


def test_a_motion_that_reads_as_another_is_an_error(tmp_path, monkeypatch):
    move = transform("Move", shift(0, 4, 1))
    write_scene(
        tmp_path,
        *(model(n, f"{n.lower()}.ply") for n in ("Skin", "Cranium")),
        move,
        model("Mandible", "mandible.ply", "Move"),
    )
    rows = matrix_rows(np.eye(4))
    monkeypatch.setattr("cmfsim.drafting.draft.matrix_rows", lambda _: rows)
    with pytest.raises(cmfsim.CaseError, match="the motion of mandible is another"):
        init_case(tmp_path)


def test_a_skin_without_any_bone_is_a_question(head):
    for name in ("cranium", "mandible"):
        (head / f"{name}.ply").unlink()
    assert init_case(head).questions
    with pytest.raises(cmfsim.CaseError, match="no surface that was found is a bone"):
        cmfsim.Case.load(head)


# ------------------------------------------------------------------ label images without a CT


def test_a_label_image_with_names_becomes_skin_and_bones(tmp_path):
    """nnU-Net states the names of its labels next to them; bones are cut out of the skin."""
    masks = label_images.masks()
    label_images.write_image(tmp_path / "seg.nii.gz", label_images.labels(masks))
    names = {"background": 0, **{name: k for k, name in enumerate(masks, start=1)}}
    (tmp_path / "dataset.json").write_text(json.dumps({"labels": names}), encoding="utf-8")
    taken = entries(tmp_path)
    assert taken["seg.nii.gz / Lower Teeth"].taken_for == "part of mandible"
    assert taken["dataset.json"].taken_for == "names of labels"
    volume = label_images.volume(bone_of(tmp_path, "skin"))
    assert volume == pytest.approx(masks["Skin"].sum() * 64.0, rel=0.03)
    middle = np.asarray(bone_of(tmp_path, "mandible").vertices).mean(axis=0)
    assert np.abs(middle - [0.0, -33.0, -22.0]).max() < 4.0


def test_one_mask_per_structure_is_named_after_its_file(tmp_path):
    """As TotalSegmentator writes them, teeth and a hundred organs among them."""
    masks = label_images.masks()
    names = ("skin", "skull", "mandible", "teeth_upper", "teeth_lower")
    for name, mask in zip(names, masks.values(), strict=True):
        label_images.write_image(tmp_path / f"{name}.nii.gz", mask.astype(np.uint8))
    for organ in ("spleen", "liver", "aorta", "colon", "kidney", "trachea", "rib", "heart"):
        label_images.write_image(tmp_path / f"{organ}.nii.gz", masks["Skin"].astype(np.uint8))
    draft = init_case(tmp_path)
    taken = {entry.label: entry for entry in draft.taken}
    assert taken["skull.nii.gz"].taken_for == "cranium"
    assert taken["teeth_lower.nii.gz"].taken_for == "part of mandible"
    assert all(f"{organ}.nii.gz" in taken for organ in ("spleen", "heart"))
    assert label_images.volume(bone_of(tmp_path, "cranium")) > 0.0


@pytest.mark.usefixtures("no_landmarks")
def test_masks_lead_to_a_face_through_doctor_and_prediction(tmp_path):
    """Nothing else is needed: skin and bones are those of the masks, the teeth with their jaw."""
    masks = label_images.masks()
    names = ("skin", "skull", "mandible", "teeth_upper", "teeth_lower")
    for name, mask in zip(names, masks.values(), strict=True):
        label_images.write_image(tmp_path / f"{name}.nii.gz", mask.astype(np.uint8))
    init_case(tmp_path)
    path = tmp_path / "case.toml"
    plan = "\n[plan.mandible]\ntranslation = [0, -4, 0]\n[mesh]\nedge_length = 16.0\n"
    path.write_text(path.read_text(encoding="utf-8") + plan, encoding="utf-8")
    assert not [f for f in cmfsim.diagnose(tmp_path) if f.severity == "error"]
    prediction = cmfsim.predict(tmp_path, model="H", check=False)
    moved = prediction.skin_displacements
    chin = np.asarray(prediction.skin_before.vertices)[:, 2] < -20.0
    assert moved[chin, 1].min() < -2.0
    assert np.abs(moved).max() < 5.0


def test_a_label_image_without_names_asks_which_label_is_which(tmp_path):
    label_images.write_image(tmp_path / "seg.nii.gz", label_images.labels())
    taken = entries(tmp_path)
    assert taken["seg.nii.gz / label 1"].taken_for == "skin"
    assert taken["seg.nii.gz / label 3"].question
    with pytest.raises(cmfsim.CaseError, match="label 2"):
        cmfsim.Case.load(tmp_path)
