"""A case becomes a predicted face, is compared with the truth, and is reported."""

import base64
import dataclasses
import hashlib
import json
import re
import sys
from html import escape
from types import SimpleNamespace

import numpy as np
import pytest

import cmfsim
import phantom_case
from cmfsim.cli import main
from cmfsim.pipeline.evaluating import check_face_after, evaluation_key
from cmfsim.report.case import case_document
from cmfsim.report.page import render_page
from cmfsim.study.cohort import _compared
from shared_values import drawn_levels, without_drawings, without_processes

pytest.importorskip("scipy")
pytest.importorskip("skimage")

COARSE = "\n[muscles]\nsamples = 16\n"


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    """The phantom from surfaces, coarse, with its own skin after the operation yet to come."""
    head = cmfsim.make_head()
    folder = tmp_path_factory.mktemp("phantom")
    path = phantom_case.surface_case(folder, head, drawn_levels(tmp_path_factory, 3.0))
    text = path.read_text(encoding="utf-8").replace("edge_length = 7.0", "edge_length = 10.0")
    path.write_text(text + COARSE, encoding="utf-8")
    return cmfsim.Case.load(path)


@pytest.fixture(scope="module")
def predictions(case):
    """The models without sliding; the patient is built once."""
    return {p.model: p for p in cmfsim.predict_models(case, ["H", "M"], check=False)}


@pytest.fixture(scope="module")
def with_truth(case, predictions):
    """The same case with the muscle model's own answer as the face after the operation."""
    folder = case.file.parent
    prediction = predictions["M"]
    cmfsim.write_surface(folder / "after.ply", prediction.skin)
    landmarks = prediction.patient.landmarks["skin"]
    before = cmfsim.Surface(prediction.skin_before.vertices, prediction.skin_before.triangles)
    motion = cmfsim.SurfaceMotion(before, prediction.skin.vertices)
    places = np.array(list(landmarks.values()))
    moved = places + motion.displacement(places)
    cmfsim.write_landmarks(folder / "after.mrk.json", dict(zip(landmarks, moved, strict=True)))
    path = folder / "truth.toml"
    more = '\n[postoperative]\nskin = "after.ply"\nlandmarks = "after.mrk.json"\n'
    path.write_text(case.file.read_text(encoding="utf-8") + more, encoding="utf-8")
    return cmfsim.Case.load(path)


def test_the_lips_follow_the_jaws_and_the_forehead_stays(predictions):
    """Maxilla 4 mm forwards, mandible 3 mm back: P axis points backwards."""
    for prediction in predictions.values():
        marks = prediction.patient.landmarks["skin"]
        skin = np.asarray(prediction.skin_before.vertices)
        moved = prediction.skin_displacements

        def at(name, marks=marks, skin=skin, moved=moved):
            return moved[np.argmin(np.linalg.norm(skin - marks[name], axis=1))]

        assert at("labiale_superius")[1] < -2.0
        assert at("pogonion")[1] > 1.5
        assert np.linalg.norm(moved[skin[:, 2] > marks["nasion"][2] + 25.0], axis=1).max() < 0.2
        assert prediction.result.summary["residual"] < 1e-12


def test_muscles_change_the_answer_and_fill_only_some_tets(predictions):
    patient = predictions["M"].patient
    assert 0.05 < np.mean(patient.fraction > 0.2) < 0.6
    lengths = np.linalg.norm(patient.fibre, axis=1)
    np.testing.assert_allclose(lengths[patient.fraction > 0.0], 1.0, atol=1e-12)
    apart = predictions["M"].skin_displacements - predictions["H"].skin_displacements
    assert 0.05 < np.linalg.norm(apart, axis=1).max() < 3.0
    assert predictions["H"].muscles is None
    assert len(predictions["M"].muscles) == 38


def test_moving_nothing_predicts_no_change(predictions):
    patient = predictions["M"].patient
    still = {name: np.eye(4) for name in patient.scene.plan}
    patient = dataclasses.replace(patient, scene=dataclasses.replace(patient.scene, plan=still))
    assert np.abs(cmfsim.predict_patient(patient, "M").skin_displacements).max() < 1e-9


def test_the_detailed_face_follows_the_skin_of_the_mesh(predictions):
    prediction = predictions["H"]
    skin, before, after = prediction.skin_before, prediction.face_before, prediction.face
    assert np.array_equal(before.triangles, after.triangles)
    # On the mesh's own nodes it is the solution; far away nothing moves.
    places = np.asarray(skin.vertices)
    assert prediction.carried(places) == pytest.approx(prediction.skin_displacements, abs=1e-9)
    assert not prediction.carried(places[:1] + [0.0, 500.0, 0.0]).any()
    # Between them it moves as the nodes next to it.
    moved = np.asarray(after.vertices) - np.asarray(before.vertices)
    near = pytest.importorskip("scipy.spatial").cKDTree(places)
    away, nearest = near.query(np.asarray(before.vertices))
    close = away < 3.0
    assert close.mean() > 0.2
    size = np.linalg.norm(moved[close] - prediction.skin_displacements[nearest[close]], axis=1)
    assert (
        np.percentile(size, 95) < 0.1 * np.linalg.norm(prediction.skin_displacements, axis=1).max()
    )


def test_without_sliding_what_would_slide_is_joined(predictions):
    patient = predictions["M"].patient
    sliding, joined = (cmfsim.model_scene(patient, m) for m in ("M+S", "M"))
    for name, segment in joined.segments.items():
        both = np.union1d(sliding.segments[name].joined, sliding.segments[name].sliding)
        np.testing.assert_array_equal(segment.joined, both)
        assert not np.size(segment.sliding)
    assert any(np.size(segment.sliding) for segment in sliding.segments.values())


def test_a_model_with_muscles_needs_them(predictions):
    bare = dataclasses.replace(predictions["M"].patient, muscles=None)
    with pytest.raises(cmfsim.CaseError, match=r"\[muscles\]"):
        cmfsim.model_scene(bare, "M+S")
    with pytest.raises(ValueError, match="use one of H, M"):
        cmfsim.model_scene(bare, "S")


def test_muscles_without_landmarks_of_the_skull_are_left_out_and_reported(predictions):
    """A model with muscles then has fat everywhere, as a homogeneous one."""
    whole = predictions["H"].patient
    scene = dataclasses.replace(whole.scene, tissue=whole.fat)
    bare = dataclasses.replace(whole, landmarks={}, muscles=None, scene=scene)
    patient = cmfsim.with_muscles(bare, cmfsim.CaseMuscles())
    assert patient.muscles is None
    assert [f.severity for f in patient.findings if f.code == "muscles-left-out"] == ["warning"]
    assert cmfsim.model_scene(patient, "M+S").tissue is patient.fat


def test_landmark_errors_move_muscles_more_than_skin(predictions):
    """The paper's 3.3: errors that move the masseter by about 2 mm change the face far less."""
    patient = predictions["M"].patient
    skull = patient.landmarks["skull"]
    (trial,) = cmfsim.landmark_trials(skull, count=1, seed=0)
    given = cmfsim.CaseMuscles(samples=16)
    same = cmfsim.with_muscles(patient, given, landmarks=dict(skull))
    np.testing.assert_array_equal(same.fraction, patient.fraction)
    changed = cmfsim.with_muscles(patient, given, landmarks=trial)
    moved = []
    for name in ("masseter_L", "masseter_R"):
        before = np.asarray(patient.muscles[name].surface.vertices)
        after = np.asarray(changed.muscles[name].surface.vertices)
        moved.append(np.linalg.norm(after - before, axis=1).mean())
    assert 1.0 < np.mean(moved) < 3.0
    again = cmfsim.predict_patient(changed, "M")
    apart = again.skin_displacements - predictions["M"].skin_displacements
    assert 0.0 < np.linalg.norm(apart, axis=1).mean() < 0.5


def test_evaluation_finds_the_model_that_made_the_truth(with_truth, predictions, monkeypatch):
    """By the predictions that are there; the command below makes its own."""
    made = "cmfsim.pipeline.evaluating.predictions_of"
    monkeypatch.setattr(made, lambda *_: iter(predictions.values()))
    found = cmfsim.evaluate(with_truth, ["H", "M"], check=False)
    mean = {name: s.mean for name, s in found.comparison.statistics.items()}
    assert mean["M"] < 1e-9 < mean["H"] < mean["no change"]
    values = found.as_dict()
    json.dumps(values, allow_nan=False)
    assert set(values["models"]["M"]["regions"]) >= {"whole", "chin", "upper lip", "nose"}
    # Another order of the models is the same question, and fewer models another one.
    assert values["key"] == evaluation_key(with_truth, ["M", "H"])
    assert values["key"] != evaluation_key(with_truth, ["H"])


def with_face(with_truth, name, skin, more=""):
    """The case with another face after the operation, and no landmarks on it."""
    folder = with_truth.file.parent
    cmfsim.write_surface(folder / f"{name}.ply", skin)
    text = with_truth.file.read_text(encoding="utf-8")
    text = text.replace('skin = "after.ply"\nlandmarks = "after.mrk.json"', f'skin = "{name}.ply"')
    path = folder / f"{name}.toml"
    path.write_text(text + more, encoding="utf-8")
    return cmfsim.Case.load(path)


@pytest.fixture
def predicted(predictions, monkeypatch):
    """Evaluations compare the prediction that is there: only the face after is another one."""
    made = "cmfsim.pipeline.evaluating.predictions_of"
    monkeypatch.setattr(made, lambda *_: iter([predictions["H"]]))


def codes(evaluation):
    return {f.code: f.severity for f in evaluation.findings if f.severity != "note"}


@pytest.mark.usefixtures("predicted")
@pytest.mark.parametrize(("far", "severity"), [(0.5, None), (1.8, "warning"), (5.0, "error")])
def test_a_face_that_differs_where_nothing_was_operated_on_is_no_comparison(
    with_truth, far, severity
):
    """Another patient's forehead lies elsewhere in the same frame."""
    skin = cmfsim.read_surface(with_truth.postoperative.skin)
    other = cmfsim.SurfaceData(skin.vertices + [0.0, -far, 0.0], skin.triangles)
    made = with_face(with_truth, f"other{far:g}", other)
    if severity == "error":
        with pytest.raises(cmfsim.CaseError, match="where nothing was operated on"):
            cmfsim.evaluate(made, ["H"], check=False)
        made, severity = with_face(with_truth, "sure", other, "verified = true\n"), "warning"
    found = codes(cmfsim.evaluate(made, ["H"], check=False))
    assert found.get("postoperative-other-face") == severity


@pytest.mark.usefixtures("predicted")
def test_a_face_beyond_every_forehead_is_no_comparison(with_truth):
    """A scan that ends below the eyes, of a patient with another face."""
    brow = with_truth.file.parent / "skin.mrk.json"
    eyes = cmfsim.read_landmarks(brow)["exocanthion_L"][2]
    skin = cmfsim.read_surface(with_truth.postoperative.skin)
    low = (skin.vertices[skin.triangles][:, :, 2] < eyes).all(axis=1)
    far = cmfsim.SurfaceData(skin.vertices + [0.0, -12.0, 0.0], skin.triangles[low])
    made = with_face(with_truth, "low", far)
    # As the process does that works on a case of a cohort.
    with pytest.raises(cmfsim.CaseError, match="more than any model moves the skin"):
        _compared(made, ["H"])


def test_one_vertex_in_a_fold_does_not_hide_a_face_of_another_patient(with_truth):
    """A coarse mesh has vertices that move further than any bone."""
    off = SimpleNamespace(
        statistics={"no change": SimpleNamespace(mean=12.0)},
        errors={"no change": np.full(100, 12.0), "H": np.full(100, 12.0)},
        models=("H",),
    )
    moved = {"H": np.where(np.arange(100) == 7, 20.0, 3.0)}
    found = {f.code for f in check_face_after(with_truth, off, None, moved)}
    assert found == {"postoperative-other-face"}


@pytest.mark.usefixtures("predicted")
def test_a_face_after_that_is_the_face_before_is_no_comparison(with_truth):
    before = cmfsim.read_surface(with_truth.surfaces.skin)
    made = with_face(with_truth, "before", before)
    assert "postoperative-unchanged" in {f.code for f in cmfsim.diagnose(made)}
    # Scanned or meshed again, only the comparison shows it.
    noise = 0.05 * np.random.default_rng(0).normal(size=before.vertices.shape)
    after = cmfsim.SurfaceData(before.vertices + noise, before.triangles)
    again = with_face(with_truth, "again", after)
    with pytest.raises(cmfsim.CaseError, match="is the face before"):
        cmfsim.evaluate(again, ["H"], check=False)


def test_evaluation_without_a_face_to_compare_with_says_so(case):
    with pytest.raises(cmfsim.CaseError, match=r"\[postoperative\]"):
        cmfsim.evaluate(case, ["H"])


def test_the_command_writes_faces_figures_and_report(with_truth, capsys, monkeypatch):
    """Without pictures, which take most of the time; test_demo.py counts those of a report."""
    pytest.importorskip("jinja2")
    monkeypatch.setitem(sys.modules, "pyvista", None)
    without_drawings(monkeypatch)
    words = ["evaluate", str(with_truth.file), "--model", "H", "--model", "M", "--no-doctor", "-q"]
    assert main(words) == 0
    out = capsys.readouterr().out
    assert "no change" in out
    folder = with_truth.output
    models = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))["models"]
    whole = {name: values["regions"]["whole"]["mean_mm"] for name, values in models.items()}
    assert whole["M"] < 1e-9 < whole["H"]
    for model in ("H", "M"):
        written = json.loads((folder / model / "prediction.json").read_text(encoding="utf-8"))
        assert all((folder / model / name).exists() for name in written["files"])
        assert cmfsim.read_result(folder / model / "prediction.npz").displacements.shape[1] == 3
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "not a medical device" in page
    assert "http:" not in re.sub(r"data:image[^\"]+", "", page)
    # The only script is that of the view, which the page's policy names by its hash.
    (script,) = re.findall(r"<script type=\"module\">(.*?)</script>", page, re.DOTALL)
    sha = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{sha}'" in page
    assert (folder / "metrics.csv").read_text(encoding="utf-8").startswith("patient,region,model")


def test_a_study_keeps_what_is_finished_and_reports_what_fails(
    with_truth, tmp_path, capsys, monkeypatch
):
    """Without pictures and processes: test_crash_safety.py has the processes of a study."""
    pytest.importorskip("jinja2")
    without_processes(monkeypatch)
    without_drawings(monkeypatch)
    cohort = tmp_path / "cohort.toml"
    cohort.write_text(
        'format = "cmfsim-cohort"\nversion = 1\nname = "two"\nnote = "in silico"\nmodels = ["H"]\n'
        f'[[cases]]\nname = "good"\nfile = "{with_truth.file}"\n'
        '[[cases]]\nname = "gone"\nfile = "nowhere/case.toml"\n',
        encoding="utf-8",
    )
    assert main(["study", str(cohort), "-q"]) == 1
    assert "in silico" in capsys.readouterr().out
    first = json.loads((tmp_path / "study" / "study.json").read_text(encoding="utf-8"))
    assert [entry["status"] for entry in first["cases"]] == ["done", "failed"]
    assert "no such file" in first["cases"][1]["error"]
    assert (tmp_path / "study" / "report.html").exists()
    assert main(["study", str(cohort), "-q"]) == 1
    again = json.loads((tmp_path / "study" / "study.json").read_text(encoding="utf-8"))
    assert [entry["status"] for entry in again["cases"]] == ["kept", "failed"]


def test_what_the_solution_notices_is_a_finding_of_the_prediction(predictions, monkeypatch):
    pytest.importorskip("jinja2")
    made = predictions["H"]
    noticed = cmfsim.Finding("inverted-tets", "3 of 9 tets are inverted", where="here")
    summary = {**made.result.summary, "findings": [dataclasses.asdict(noticed)]}
    result = dataclasses.replace(made.result, summary=summary)
    monkeypatch.setattr("cmfsim.solving.models.solved_scene", lambda *_: (result, None))
    prediction = cmfsim.predict_patient(made.patient, "H")
    assert prediction.findings == (*made.patient.findings, noticed)
    assert prediction.summary["findings"][-1] == dataclasses.asdict(noticed)
    # The report states what any of its models noticed, and what all did once: in the list of
    # findings, and what is more than a note at the top as well.
    page = render_page(case_document([made.summary, prediction.summary]))
    top, _, listed = page.partition("<main>")
    assert top.count("3 of 9 tets are inverted") == 1
    assert listed.count("3 of 9 tets are inverted") == 1
    for finding in made.patient.findings:
        assert listed.count(escape(finding.what)) == 1
