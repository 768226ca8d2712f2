"""Templates carried to patients: exactness, mirror images, folds, landmark sets, real heads."""

import json

import numpy as np
import pytest

import cmfsim
from cmfsim.cli import main
from real_heads import data_folder, landmarks

MIRROR = np.array([-1.0, 1.0, 1.0])
OTHER_SIDE = {"L": "R", "R": "L", "both": "both"}


@pytest.fixture(scope="module")
def template():
    """The built-in template, with muscles that stand for all kinds."""
    whole = cmfsim.MuscleTemplate.load("default")
    names = ("masseter", "zygomaticus_major", "orbicularis_oculi", "depressor_anguli_oris")
    chosen = [m for m in whole.muscles if m.name[:-2] in names or m.name == "orbicularis_oris"]
    return cmfsim.MuscleTemplate(
        name="some",
        muscles=tuple(chosen),
        skull=whole.skull,
        landmarks=whole.landmarks,
        definitions=whole.definitions,
        licence=whole.licence,
        attribution=whole.attribution,
    )


@pytest.fixture(scope="module")
def patient():
    """The landmarks of another person with an asymmetric face."""
    parameters = cmfsim.HeadParameters(scale=1.05, chin_projection=4.0, asymmetry=3.0)
    return dict(cmfsim.make_head(parameters).skull_landmarks)


def mirrored_set(points):
    """Landmarks of the mirror image: places mirrored, sides exchanged."""
    return {other_name(name): MIRROR * place for name, place in points.items()}


def other_name(name):
    """The name on the other side."""
    return name[:-1] + OTHER_SIDE[name[-1]] if name[-2:] in {"_L", "_R"} else name


def test_a_template_morphed_to_itself_stays(template):
    muscles = template.morph(template.landmarks)
    for before, after in zip(template.muscles, muscles, strict=True):
        assert np.abs(after.surface.vertices - before.surface.vertices).max() < 1e-9
        assert (after.name, after.side, after.kind) == (before.name, before.side, before.kind)
    assert muscles.missing == ()
    assert dict(muscles.folds) == {}


def test_an_affine_map_carries_surfaces_courses_and_skull(template):
    a = np.array([[1.1, 0.05, 0.0], [0.0, 0.9, 0.1], [0.02, 0.0, 1.2]])
    b = np.array([3.0, -150.0, 1500.0])
    muscles = template.morph({n: a @ p + b for n, p in template.landmarks.items()})
    for before, after in zip(template.muscles, muscles, strict=True):
        assert np.abs(after.surface.vertices - (before.surface.vertices @ a.T + b)).max() < 1e-9
        for line, moved in zip(before.course, after.course, strict=True):
            assert np.abs(moved - (line @ a.T + b)).max() < 1e-9
    assert np.abs(muscles.skull.vertices - (template.skull.vertices @ a.T + b)).max() < 1e-9
    assert max(muscles.leave_one_out.distances) < 1e-9


def test_landmarks_are_met_and_smoothing_lets_go(template, patient):
    exact, smooth = template.morph(patient), template.morph(patient, smoothing=50.0)
    assert max(exact.residuals.values()) < 1e-9
    assert max(smooth.residuals.values()) > 0.1
    moved = smooth.warp(np.array([template.landmarks[n] for n in smooth.landmarks]))
    for name, place, residual in zip(
        smooth.landmarks, moved, smooth.residuals.values(), strict=True
    ):
        assert abs(np.linalg.norm(place - patient[name]) - residual) < 1e-9


def test_the_mirror_image_of_the_landmarks_gives_that_of_the_muscles(template, patient):
    muscles, other = template.morph(patient), template.morph(mirrored_set(patient))
    for muscle in muscles:
        if muscle.side == "both":
            continue  # Its own mirror image, but with other vertices.
        partner = other[other_name(muscle.name)]
        assert np.abs(muscle.surface.vertices * MIRROR - partner.surface.vertices).max() < 1e-9
        for line, mirrored in zip(muscle.course, partner.course, strict=True):
            assert np.abs(line * MIRROR - mirrored).max() < 1e-9


def test_files_of_landmarks_give_the_same_as_values(template, patient, tmp_path):
    expected = template.morph(patient)["masseter_L"].surface.vertices
    cmfsim.write_landmarks(tmp_path / "p.mrk.json", patient)
    lines = ["# CoordinateSystem = RAS", "# columns = id,x,y,z,label"]
    for number, (name, (x, y, z)) in enumerate(patient.items()):
        lines.append(f"{number},{-x!r},{-y!r},{z!r},{name}")
    (tmp_path / "p.fcsv").write_text("\n".join(lines).replace("np.float64(", ""), "utf-8")
    text = (tmp_path / "p.fcsv").read_text("utf-8").replace(")", "")
    (tmp_path / "p.fcsv").write_text(text, "utf-8")
    for name in ("p.mrk.json", "p.fcsv"):
        found = template.morph(tmp_path / name)["masseter_L"].surface.vertices
        assert np.array_equal(found, expected)


def test_four_landmarks_are_enough_and_the_others_are_named(template, patient):
    four = ("nasion", "menton", "gonion_L", "gonion_R")
    muscles = template.morph({name: patient[name] for name in four})
    assert set(muscles.landmarks) == set(four)
    assert set(muscles.missing) == set(template.landmarks) - set(four)
    assert muscles.leave_one_out is None
    found = {f.code: f.what for f in muscles.findings}
    missing = found["template-landmarks-missing"]
    assert missing.startswith("28 of the template's 32 landmarks are missing: ")
    assert missing.endswith("placed by the other 4")
    assert "4 landmarks: 5 are needed" in found["template-landmarks-few"]


@pytest.mark.parametrize(
    "spoil",
    [
        lambda p: {name: p[name] for name in ("nasion", "menton", "glabella")},
        lambda p: {name: place * [0, 1, 1] for name, place in p.items()},
        lambda p: {**p, "menton": p["pogonion"] * np.nan},
        lambda p: {**p, "menton": p["pogonion"][:2]},
        lambda p: {name: MIRROR * place for name, place in p.items()},
        lambda p: {**p, "gonion_L": p["gonion_R"], "gonion_R": p["gonion_L"]},
        lambda p: {f"site {name}": place for name, place in p.items()},
    ],
    ids=["three", "coplanar", "nan", "short", "mirrored", "swapped", "other names"],
)
def test_landmarks_that_cannot_be_meant_are_refused(template, patient, spoil):
    with pytest.raises(cmfsim.LandmarkError) as caught:
        template.morph(spoil(patient))
    assert isinstance(caught.value, ValueError)


@pytest.mark.parametrize("smoothing", [-1.0, float("nan"), "much"])
def test_smoothing_out_of_range_is_refused(template, patient, smoothing):
    with pytest.raises(cmfsim.CmfsimError, match="smoothing"):
        template.morph(patient, smoothing=smoothing)


def test_landmarks_that_cross_fold_the_muscles_and_it_is_said(template):
    points = dict(template.landmarks)
    points["occlusal_line_L"] = points["occlusal_line_L"] + [0, 60, 0]
    muscles = template.morph(points)
    assert "masseter_L" in muscles.folds
    moved = template.musculature["masseter_L"].surface.vertices
    determinants = np.linalg.det(muscles.warp.jacobian(moved))
    assert muscles.folds["masseter_L"] == (determinants <= 0.0).sum()
    (finding,) = [f for f in muscles.findings if f.code == "correspondence-folds"]
    assert finding.severity == "warning"


def test_a_displaced_landmark_disagrees_with_the_others(template, patient):
    patient = {**patient, "zygomatic_arch_L": patient["zygomatic_arch_L"] + [0, 15, 0]}
    muscles = template.morph(patient)
    assert muscles.leave_one_out.worst == "zygomatic_arch_L"
    (finding,) = [f for f in muscles.findings if f.code == "landmark-disagrees"]
    assert ": zygomatic_arch_L 1" in finding.what


def test_muscles_come_to_lie_in_another_phantom_person():
    """The true muscles of that person, known as levels, are met better than by no morph at all."""
    head = cmfsim.make_head(cmfsim.HeadParameters.random(3))
    template = cmfsim.MuscleTemplate.load("default")
    muscles = template.morph(head.skull_landmarks)
    for name in ("masseter_L", "zygomaticus_major_R", "buccinator_L", "mentalis_R"):
        before = np.asarray(template.musculature[name].surface.vertices)[::20]
        after = np.asarray(muscles[name].surface.vertices)[::20]
        stays, moved = (np.abs(head.muscles[name].level(p)).mean() for p in (before, after))
        assert moved < 1.0, name
        assert moved < stays, name


def test_morphed_muscles_are_read_back_as_a_template(template, patient, tmp_path):
    pytest.importorskip("meshio")
    muscles = template.morph(patient)
    muscles.save(tmp_path / "out", name="patient", report=muscles.summary())
    read = cmfsim.MuscleTemplate.load(tmp_path / "out")
    assert read.name == "patient"
    assert read.licence == template.licence
    assert np.array_equal(
        read.musculature["masseter_L"].surface.vertices, muscles["masseter_L"].surface.vertices
    )
    report = json.loads((tmp_path / "out" / "report.json").read_text("utf-8"))
    assert max(report["residuals"].values()) < 1e-9
    assert set(report["leave_one_out"]["distances"]) == set(template.landmarks)


# The command line.


def test_the_command_line_lists_and_checks(capsys, tmp_path):
    assert main(["template", "list", "--json"]) == 0
    (entry,) = json.loads(capsys.readouterr().out)["templates"]
    assert (entry["name"], len(entry["muscles"])) == ("default", 38)
    assert main(["template", "list"]) == 0
    assert "38 muscles, 32 landmarks" in capsys.readouterr().out
    assert main(["template", "check", str(tmp_path)]) == 2
    assert "template.toml" in capsys.readouterr().out
    assert main(["template", "check", str(tmp_path / "none")]) == 2
    assert "no such template" in capsys.readouterr().err


def test_the_command_line_morphs(capsys, tmp_path, patient):
    pytest.importorskip("meshio")
    cmfsim.write_landmarks(tmp_path / "p.mrk.json", patient)
    words = ["template", "morph", "default", str(tmp_path / "p.mrk.json"), "-q"]
    assert main([*words, "-o", str(tmp_path / "out")]) == 0
    assert "32 landmarks" in capsys.readouterr().out
    assert (tmp_path / "out" / "muscle-masseter_L.ply").is_file()
    assert (tmp_path / "out" / "report.json").is_file()
    assert main([*words, "-o", str(tmp_path / "out.npz"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["missing"] == []
    assert len(cmfsim.MuscleTemplate.load(tmp_path / "out.npz").muscles) == 38
    few = dict(list(patient.items())[:3])
    cmfsim.write_landmarks(tmp_path / "p.mrk.json", few)
    assert main([*words, "-o", str(tmp_path / "none")]) == 2
    assert not (tmp_path / "none").exists()


def test_the_command_line_draws_chosen_muscles_on_the_skull(capsys, tmp_path):
    pytest.importorskip("pyvista")
    path = tmp_path / "m.png"
    code = main(["template", "show", "default", "-o", str(path), "--only", "masseter", "-q"])
    said = capsys.readouterr()
    if "OpenGL" in said.err:
        pytest.skip(said.err)
    assert code == 0
    assert "2 muscles" in said.out
    image = pytest.importorskip("matplotlib.image").imread(path)[:, :, :3]
    # The first hue is red, the skull is pale.
    red = (image[:, :, 0] > 0.3) & (image[:, :, 1] < 0.4 * image[:, :, 0])
    heads = red[:, image.shape[1] // 3 :]
    assert heads.mean() > 0.005
    assert main(["template", "show", "default", "-o", str(path), "--only", "biceps", "-q"]) == 2
    assert "biceps" in capsys.readouterr().err


# Real anatomy.


@pytest.fixture(scope="module")
def atlas():
    """The template of BodyParts3D."""
    pytest.importorskip("meshio")
    folder = data_folder()
    return cmfsim.import_bodyparts3d(
        folder / "bodyparts3d" / "v3_obj99", folder / "atlas_head" / "skull_landmarks.mrk.json"
    )


def test_the_atlas_gives_named_closed_muscles_with_its_licence(atlas):
    assert len(atlas.muscles) == 65
    assert atlas.licence == "CC BY-SA 2.1 JP"
    assert atlas.attribution == "BodyParts3D, © The Database Center for Life Science"
    assert atlas.concepts["masseter_superficial_L"] == ("FMA49002",)
    for muscle in atlas.muscles:
        report = cmfsim.check_surface(muscle.surface, crossings=False)
        assert report.is_closed, muscle.name
        assert report.volume > 0.0, muscle.name
        assert len(report.components) == (2 if muscle.name == "orbicularis_oris" else 1)
        if muscle.side == "L":
            other = atlas.musculature[f"{muscle.name[:-1]}R"].surface
            other = cmfsim.check_surface(other, crossings=False)
            assert abs(other.volume / report.volume - 1.0) < 0.05, muscle.name
            assert report.lowest[0] > other.lowest[0]
    parts = [f for f in atlas.findings if f.code == "bodyparts3d-parts"]
    mirrored = {f.where for f in parts if "mirrored" in f.what}
    assert mirrored == {"levator_anguli_oris_R", "depressor_anguli_oris_R", "corrugator_L"}


def test_stray_geometry_of_the_medial_pterygoid_is_dropped(atlas):
    x = np.asarray(atlas.musculature["medial_pterygoid_R"].surface.vertices)[:, 0]
    assert x.max() < -10.0


def test_the_atlas_has_no_faults_but_small_ones(atlas):
    lesser = tuple(m for m in atlas.muscles if len(np.asarray(m.surface.vertices)) < 1500)
    given = {name: getattr(atlas, name) for name in atlas.__dataclass_fields__}
    chosen = cmfsim.MuscleTemplate(**{**given, "muscles": lesser})
    assert [f for f in chosen.check() if f.severity != "note"] == []


def test_files_that_are_not_the_known_ones_are_refused(tmp_path):
    folder = data_folder() / "bodyparts3d" / "v3_obj99"
    marks = landmarks("atlas_head")
    with pytest.raises(FileNotFoundError, match="get them from https"):
        cmfsim.import_bodyparts3d(tmp_path, marks)
    for place in ((0, 0), "here", (0, 0, np.inf)):
        with pytest.raises(cmfsim.LandmarkError):
            cmfsim.import_bodyparts3d(folder, {**marks, "nasion": place})
    for file in folder.glob("*.obj"):
        (tmp_path / file.name).symlink_to(file)
    changed = tmp_path / "FMA49001.obj"
    text = changed.read_text("utf-8")
    changed.unlink()
    changed.write_text(text + "# touched\n", "utf-8")
    with pytest.raises(cmfsim.CaseError, match=r"1 of .* FMA49001\.obj"):
        cmfsim.import_bodyparts3d(tmp_path, marks)


def test_muscles_of_the_atlas_lie_on_the_bones_of_a_real_patient(atlas):
    """Origins and insertions come near bone, and little muscle lies inside it."""
    pv = pytest.importorskip("pyvista")
    bone = pv.read(data_folder() / "ct_phantom" / "bone.ply")
    bone = cmfsim.Surface(np.asarray(bone.points, dtype=float), bone.regular_faces)
    muscles = atlas.morph(landmarks("ct_phantom"))
    assert dict(muscles.folds) == {}
    assert max(muscles.residuals.values()) < 1e-9
    inside = []
    for name in ("masseter_superficial", "temporalis", "zygomaticus_major", "buccinator"):
        for side in "LR":
            points = np.asarray(muscles[f"{name}_{side}"].surface.vertices)
            distance = np.linalg.norm(bone.closest(points)[0] - points, axis=1)
            assert distance.min() < 2.0, name
            inside.append((bone.winding_number(points) > 0.5).mean())
    assert np.mean(inside) < 0.35
