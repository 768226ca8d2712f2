"""A scene written by 3D Slicer's own code becomes a prediction, shown at the same place."""

import json
import shutil

import numpy as np
import pytest
from scipy.spatial import cKDTree

import cmfsim
import head_case
import in_slicer
from cmfsim.cli import main
from cmfsim.drafting import init_case
from cmfsim.io.slicer.output import write_slicer_bundle

pytest.importorskip("scipy")
pytest.importorskip("skimage")
pytest.importorskip("SimpleITK")

# Slicer's frame; half a turn about the long axis.
FLIP = np.diag([-1.0, -1.0, 1.0, 1.0])
# The whole head turned to natural posture, about a point far from the origin, RAS.
POSTURE = cmfsim.rigid_motion((3.0, -2.0, 5.0), angle=4.0, axis=(1, 0.2, 0), centre=(5, 100, 1490))
# The mandible: 4 mm forwards and 1 mm up in RAS, with a turn about a point of its own.
FORWARDS = cmfsim.rigid_motion((0.0, 4.0, 1.0), angle=3.0, axis=(1, 0, 0.1), centre=(-3, 128, 1445))
WITHIN = 1e-6
# Of the grid of the segmentation, mm.
STEP = 3.0
# Surfaces' ending and frame, and transforms' ending.
FORMATS = (
    ("vtk", "RAS", "tfm"),
    ("ply", "LPS", "txt"),
    ("stl", "RAS", "h5"),
    ("obj", "LPS", "tfm"),
)


def scene_of(*, posture=True, ending="vtp", space="LPS", transform="h5"):
    """Slicer's scene of the head of ellipsoids: the mandible under its plan, all under posture."""
    bodies = head_case.surfaces(rounds=4)
    marks = head_case.landmarks(bodies)[0]
    under = {"parent": "Natural head posture"} if posture else {}
    transforms = [
        {"name": "Natural head posture", "file": "posture", "ras": POSTURE.tolist()},
        {
            "name": "Mandible move",
            "file": "mandible_move",
            "ras": FORWARDS.tolist(),
            "centre": [-3, 128, 1445],
            **under,
        },
    ]
    models = [
        {"name": "Skin", "key": "skin", **under},
        {"name": "Cranium", "key": "cranium", **under},
        {"name": "Mandible", "key": "mandible", "parent": "Mandible move"},
    ]
    return {
        "surfaces": {name: (body.vertices, body.triangles) for name, body in bodies.items()},
        "transforms": [
            {**t, "ending": transform} for t in transforms if posture or t["file"][0] == "m"
        ],
        "models": [{**model, "ending": ending, "space": space} for model in models],
        "markups": [
            {
                "name": "Skull",
                "file": "skull",
                "ending": "mrk.json",
                "points": {label: np.asarray(p).tolist() for label, p in marks.items()},
                **under,
            }
        ],
    }


def predicted(folder):
    """The prediction of the case in a folder, coarse."""
    path = folder / "case.toml"
    text = path.read_text(encoding="utf-8").replace(
        "[muscles]", "[mesh]\nedge_length = 14\n[muscles]"
    )
    path.write_text(text, encoding="utf-8")
    case = cmfsim.Case.load(path)
    return cmfsim.predict(case, model="H", check=False)


def farthest(points, others):
    """How far points lie from the nearest of others, at most."""
    return cKDTree(others).query(points)[0].max()


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """Scenes that one run of Slicer wrote, by name: folder, and where it shows what they hold."""
    asked = {"nested": scene_of()}
    for ending, space, transform in FORMATS:
        asked[ending] = scene_of(posture=False, ending=ending, space=space, transform=transform)
    first, size = [-81.0, -204.0, 1372.0], [56, 70, 86]
    asked["segments"] = {
        "surfaces": {},
        "transforms": [],
        "models": [],
        "markups": [],
        "segments": [
            {"name": name.title(), "centre": centre, "axes": axes, "first": first, "size": size}
            | {"step": STEP}
            for name, (centre, axes) in head_case.ELLIPSOIDS.items()
        ],
    }
    folders = {name: tmp_path_factory.mktemp(name) for name in asked}
    shown = in_slicer.make_scenes({folders[name]: scene for name, scene in asked.items()})
    return {name: (folder, shown[folder]) for name, folder in folders.items()}


@pytest.fixture(scope="module")
def nested(scenes):
    """The scene with nested transforms, where Slicer shows it, and its prediction."""
    folder, shown = scenes["nested"]
    draft = init_case(folder / "scene.mrml")
    return folder, shown, draft, predicted(folder)


def test_bones_lie_where_slicer_shows_them(nested):
    """Nested transforms, rotation about a centre: the plan is what Slicer does to the mandible."""
    folder, shown, draft, prediction = nested
    assert not draft.questions
    bones = cmfsim.Case.load(folder).surfaces.bones
    plan = np.asarray(prediction.scene.plan["mandible"])
    mandible = np.asarray(cmfsim.read_surface(bones["mandible"]).vertices)
    assert farthest(mandible @ plan[:3, :3].T + plan[:3, 3], shown["Mandible.points"]) < WITHIN
    cranium = cmfsim.read_surface(bones["cranium"])
    assert farthest(cranium.vertices, shown["Cranium.points"]) < WITHIN
    assert farthest(prediction.face_before.vertices, shown["Skin.points"]) < WITHIN
    # The model's own surfaces of the bones, made of levels, move by the same motion.
    before, after = prediction.bones["mandible"]
    moved = np.asarray(before.vertices) @ plan[:3, :3].T + plan[:3, 3]
    assert np.abs(after - moved).max() < WITHIN
    still, unmoved = prediction.bones["cranium"]
    assert np.array_equal(unmoved, still.vertices)


def test_landmarks_lie_where_slicer_shows_them(nested):
    folder, shown, _, _ = nested
    marks = cmfsim.Case.load(folder).landmarks.skull
    points = cmfsim.read_landmarks(marks)
    for label, place in zip(shown["Skull.labels"], shown["Skull.places"], strict=True):
        assert np.abs(points[label] - place).max() < WITHIN


def test_the_plan_is_stated_in_words(nested):
    """Up to the head's posture of 4°, the mandible moves 4 mm forwards."""
    folder, _, draft, _ = nested
    text = (folder / "case.toml").read_text(encoding="utf-8")
    assert "mm forwards" in text
    assert "backwards" not in text
    motion = next(entry for entry in draft.taken if entry.taken_for == "motion of mandible")
    assert "forwards" in motion.why


def test_a_prediction_opens_in_slicer_at_the_same_place(nested, tmp_path):
    _, _, _, prediction = nested
    write_slicer_bundle(tmp_path / "prediction.mrb", prediction)
    shown = in_slicer.look(tmp_path / "prediction.mrb", tmp_path / "shown.npz")
    for name, (_, after) in prediction.bones.items():
        assert np.abs(shown[f"{name}.points"] - after).max() < WITHIN
    assert np.abs(shown["face predicted.points"] - prediction.face.vertices).max() < WITHIN
    assert np.abs(shown["face before.points"] - prediction.face_before.vertices).max() < WITHIN
    moved = np.asarray(prediction.face.vertices) - np.asarray(prediction.face_before.vertices)
    length = shown["face predicted.array.displacement_length_mm"]
    assert np.abs(length - np.linalg.norm(moved, axis=1)).max() < WITHIN
    assert length.max() > 0.5
    assert shown["face predicted.active"] == "displacement_length_mm"
    # Slicer's vectors are RAS as its points are: Warp by Vector goes the right way.
    vectors = shown["face predicted.array.displacement_mm"] * [-1.0, -1.0, 1.0]
    assert np.abs(vectors - moved).max() < 1e-5
    plan = np.asarray(prediction.scene.plan["mandible"])
    assert np.abs(shown["plan mandible.matrix"] - FLIP @ plan @ FLIP).max() < 1e-12


def test_a_prediction_in_slicer_is_a_case_again(nested, tmp_path):
    """The bundle of a prediction gives the plan that it was made by."""
    _, _, _, prediction = nested
    write_slicer_bundle(tmp_path / "prediction.mrb", prediction)
    init_case(tmp_path / "prediction.mrb")
    case = cmfsim.Case.load(tmp_path)
    plan = np.asarray(prediction.scene.plan["mandible"])
    assert np.abs(np.asarray(case.plan["mandible"].matrix) - plan).max() < 1e-12


@pytest.mark.parametrize("ending", [entry[0] for entry in FORMATS])
def test_formats_and_frames_give_one_plan(scenes, ending):
    """Each format of surfaces and transforms, in each frame, as Slicer writes it."""
    folder, shown = scenes[ending]
    draft = init_case(folder / "scene.mrml")
    assert not draft.questions
    case = cmfsim.Case.load(folder)
    wanted = FLIP @ FORWARDS @ FLIP
    assert np.abs(np.asarray(case.plan["mandible"].matrix) - wanted).max() < 1e-10
    surfaces = case.surfaces
    mandible = cmfsim.read_surface(surfaces.bones["mandible"], frame=surfaces.frame)
    moved = np.asarray(mandible.vertices) @ wanted[:3, :3].T + wanted[:3, 3]
    assert farthest(moved, shown["Mandible.points"]) < WITHIN


def test_a_bundle_gives_the_case_of_its_scene(nested, tmp_path):
    """`.mrb` as Slicer packs it, with its own choice of formats."""
    folder, shown, _, _ = nested
    shutil.copy(folder / "scene.mrb", tmp_path)
    draft = init_case(tmp_path)
    assert not draft.questions
    case = cmfsim.Case.load(tmp_path)
    plan = np.asarray(case.plan["mandible"].matrix)
    mandible = np.asarray(cmfsim.read_surface(case.surfaces.bones["mandible"]).vertices)
    assert farthest(mandible @ plan[:3, :3].T + plan[:3, 3], shown["Mandible.points"]) < WITHIN


def test_segments_lie_where_slicer_has_them(scenes):
    """Skin and bones of one segmentation, in layers, half a voxel and its smoothing apart."""
    folder, _ = scenes["segments"]
    draft = init_case(folder / "scene.mrml")
    assert not draft.questions
    case = cmfsim.Case.load(folder)
    found = {"skin": case.surfaces.skin, **case.surfaces.bones}
    for name, (centre, axes) in head_case.ELLIPSOIDS.items():
        vertices = np.asarray(cmfsim.read_surface(found[name]).vertices)
        middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
        assert np.abs(middle - centre).max() < 0.5 * STEP, name
        assert np.abs(np.ptp(vertices, axis=0) / 2.0 - axes).max() < STEP, name


def test_init_prints_what_it_found_as_json(nested, tmp_path, capsys):
    folder, _, _, _ = nested
    shutil.copy(folder / "scene.mrb", tmp_path)
    assert main(["init", str(tmp_path), "--json", "-q"]) == 0
    answer = json.loads(capsys.readouterr().out)
    found = {entry["taken_for"]: entry for entry in answer["found"]}
    assert found["skin"]["frame"] == "LPS"
    assert "mm forwards" in found["motion of mandible"]["why"]
    assert answer["written"] == [
        "from_scene/cranium.ply",
        "from_scene/mandible.ply",
        "from_scene/skin.ply",
        "from_scene/skull.mrk.json",
    ]
