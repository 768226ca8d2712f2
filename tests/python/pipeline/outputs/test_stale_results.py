"""Results of another plan, another run or another hand are never shown as one with new ones."""

import dataclasses
import json
import os
from pathlib import Path

import numpy as np
import pytest
from folder_states import state_of

import cmfsim
import cmfsim.pipeline.building
import cmfsim.pipeline.predicting
from cmfsim.cli import main
from cmfsim.cli.study_commands import _plan_text
from cmfsim.io import finish_writing, read_parts
from cmfsim.io.meshes.mesh_files import read_mesh
from cmfsim.io.results.predictions import predictions_of, read_prediction
from cmfsim.io.results.result_files import read_evaluation
from cmfsim.pipeline.building.inputs import case_key, input_hashes
from cmfsim.pipeline.outputs.results import write_case_report, write_results
from head_case import HeadCase
from shared_values import without_drawings

pytest.importorskip("meshio")
pytest.importorskip("pyvista")
pytest.importorskip("jinja2")
pytest.importorskip("scipy")

PNG = b"\x89PNG\r\n\x1a\n"


def write_head(folder):
    head = HeadCase(rounds=2)
    head.toml = head.toml.replace("edge_length = 4.0", "edge_length = 16.0")
    after = np.asarray(head.surfaces["skin"].vertices) + [0.0, -1.0, 0.0]
    head.surfaces["after"] = cmfsim.SurfaceData(after, head.surfaces["skin"].triangles)
    head.toml += '\n[postoperative]\nskin = "after.ply"\n'
    return head.write(folder)


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    """The ellipsoids, coarse, with a face after the operation."""
    return write_head(tmp_path_factory.mktemp("head"))


@pytest.fixture(scope="module")
def prediction(case):
    return cmfsim.predict(case, model="H", check=False)


@pytest.fixture(scope="module")
def replanned(prediction):
    """The same patient with another plan."""
    scene = prediction.scene
    plan = {**scene.plan, "mandible": cmfsim.rigid_motion((0.0, 3.0, 0.0))}
    patient = dataclasses.replace(
        prediction.patient, scene=dataclasses.replace(prediction.patient.scene, plan=plan)
    )
    return cmfsim.predict_patient(patient, "H")


@pytest.fixture(autouse=True)
def no_pictures(monkeypatch):
    """They take most of the time."""
    without_drawings(monkeypatch)
    for name in ("picture_distances", "chart_errors"):
        monkeypatch.setattr(
            f"cmfsim.pipeline.outputs.results.{name}", lambda path, *_, **__: draw(path)
        )


def draw(path):
    path.write_bytes(PNG)


def as_model(prediction, model):
    return dataclasses.replace(
        prediction, model=model, summary={**prediction.summary, "model": model}
    )


def write(folder, *predictions, evaluation=None):
    return write_results(
        folder,
        predictions,
        [prediction.model for prediction in predictions],
        stage=lambda _: None,
        evaluation=None if evaluation is None else lambda: evaluation,
    )


@pytest.fixture(scope="module")
def evaluation(case, prediction):
    """The comparison of the prediction with the face after the operation."""
    found = cmfsim.evaluate(case, "H", check=False)
    assert found.predictions[0].summary["case_key"] == prediction.summary["case_key"]
    return found


@pytest.mark.parametrize("name", ["metrics.json", "report.html", "prediction.json"])
def test_files_of_another_program_stay(case, prediction, tmp_path, capsys, name):
    """`metrics.json` and `report.html` were removed as those of another plan."""
    mine = tmp_path / name
    mine.write_text('{"accuracy": 0.9}', encoding="utf-8")
    words = ["predict", str(case), "--model", "H", "-q", "--no-doctor", "-o", str(tmp_path)]
    assert main(words) == 2
    assert f"{mine}: was not written by cmfsim" in capsys.readouterr().err
    with pytest.raises(cmfsim.CaseError, match="move it, or choose another output folder"):
        prediction.save(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert mine.read_text(encoding="utf-8") == '{"accuracy": 0.9}'


def test_the_errors_of_the_old_plan_go_with_a_new_prediction(tmp_path, capsys):
    """Evaluate, change the plan, predict: the report printed the old plan's errors."""
    path = write_head(tmp_path)
    words = [str(path), "--model", "H", "-q", "--no-doctor"]
    assert main(["evaluate", *words]) == 0
    out = tmp_path / "out"
    assert "mean error of the face" in (out / "report.html").read_text("utf-8")
    text = path.read_text("utf-8")
    path.write_text(text.replace("translation = [0, -4, 1]", "translation = [0, 4, 1]"), "utf-8")
    capsys.readouterr()
    assert main(["predict", *words]) == 0
    err = capsys.readouterr().err
    assert "metrics.json" in err
    assert "run cmfsim evaluate again" in err
    names = {path.name for path in out.iterdir()}
    assert not names & {"metrics.json", "metrics.csv", "errors.png", "error-H.png"}
    page = (out / "report.html").read_text("utf-8")
    assert "mean error of the face" not in page
    assert "post-operative face, mm" not in page


def test_a_comparison_of_the_same_plan_stays(tmp_path, prediction, evaluation):
    write(tmp_path, prediction, evaluation=evaluation)
    write(tmp_path, prediction)
    assert read_evaluation(tmp_path)["case_key"] == prediction.summary["case_key"]
    assert "mean error of the face" in (tmp_path / "report.html").read_text("utf-8")
    # Of a model that was not evaluated there are no errors to show at the top.
    write(tmp_path, as_model(prediction, "H+S"))
    assert "H+S: mean error" not in (tmp_path / "report.html").read_text("utf-8")


@pytest.mark.parametrize("first", [("H",), ("H", "M")])
@pytest.mark.parametrize("second", [("H",), ("M", "H+S")])
def test_predictions_of_the_old_plan_go_wherever_they_lie(
    tmp_path, prediction, replanned, evaluation, first, second
):
    """Alone in the case's folder, or several in a folder for each."""
    write(tmp_path, *(as_model(prediction, m) for m in first), evaluation=evaluation)
    (tmp_path / "mine.png").write_bytes(PNG)
    written = write(tmp_path, *(as_model(replanned, m) for m in second))
    assert "metrics.json" in written.left_out
    found = predictions_of(tmp_path)
    assert [entry["model"] for entry in found.values()] == list(second)
    keys = {entry["case_key"] for entry in found.values()}
    assert keys == {replanned.summary["case_key"]} != {prediction.summary["case_key"]}
    there = {str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file()}
    listed = {
        f"{place.relative_to(tmp_path)}/{name}".removeprefix("./")
        for place, entry in found.items()
        for name in entry["files"]
    }
    assert there == listed | {"report.html", "mine.png"}


def test_the_library_leaves_no_results_of_another_plan_either(
    tmp_path, prediction, replanned, evaluation
):
    write(tmp_path, prediction, evaluation=evaluation)
    cmfsim.write_prediction(tmp_path, replanned)
    assert not (tmp_path / "metrics.json").exists()
    assert not (tmp_path / "report.html").exists()
    assert list(predictions_of(tmp_path)) == [tmp_path]


def test_a_mixture_is_refused_by_name(tmp_path, prediction, replanned, capsys):
    """As one that was copied together, or left by an older version."""
    cmfsim.write_prediction(tmp_path / "H", prediction)
    cmfsim.write_prediction(tmp_path / "M", as_model(replanned, "M"))
    for words in (["report", "-q"], ["view", "--screenshot", str(tmp_path / "a.png")]):
        assert main([words[0], str(tmp_path), *words[1:]]) == 2
        err = capsys.readouterr().err
        assert str(tmp_path / "H" / "prediction.json") in err
        assert str(tmp_path / "M" / "prediction.json") in err
        assert "different plans" in err
    with pytest.raises(cmfsim.CaseError, match="different plans"):
        cmfsim.report.case.case_document([prediction.summary, replanned.summary])


def test_a_comparison_of_another_plan_is_left_out_of_a_report(
    tmp_path, prediction, replanned, evaluation, capsys
):
    write(tmp_path / "old", prediction, evaluation=evaluation)
    write(tmp_path / "new", replanned)
    for name in ("metrics.json", "metrics.csv", "error-H.png", "errors.png"):
        (tmp_path / "old" / name).rename(tmp_path / "new" / name)
    assert main(["report", str(tmp_path / "new"), "-q"]) == 0
    assert "run cmfsim evaluate" in capsys.readouterr().err
    page = (tmp_path / "new" / "report.html").read_text("utf-8")
    assert "belongs to another plan" in page
    assert "mean error" not in page


def test_the_key_is_that_of_files_plan_and_options_and_not_of_the_folder(case, tmp_path):
    here = cmfsim.Case.load(case)
    key = case_key(here)
    other = cmfsim.Case.load(write_head(tmp_path))
    assert case_key(other) == key
    # What is changed in memory alone counts, but not where results go.
    mesh = dataclasses.replace(here.mesh, edge_length=15.0)
    assert case_key(dataclasses.replace(here, mesh=mesh)) != key
    assert case_key(dataclasses.replace(here, plan={})) != key
    assert case_key(dataclasses.replace(here, output=tmp_path / "other")) == key
    (tmp_path / "skin.ply").write_bytes((tmp_path / "after.ply").read_bytes())
    assert case_key(other) != key


def test_a_file_that_changes_during_the_work_is_an_error(tmp_path, monkeypatch):
    path = write_head(tmp_path)
    build = cmfsim.pipeline.predicting.model_of

    def slow_build(case, options):
        with path.open("a", encoding="utf-8") as file:
            file.write("\n# another line\n")
        return build(case, options)

    monkeypatch.setattr("cmfsim.pipeline.predicting.model_of", slow_build)
    with pytest.raises(cmfsim.CaseError, match=r"case.toml: changed while"):
        cmfsim.predict(path, model="H", check=False)


def test_tiles_pictures_and_captions_are_of_one_model(prediction, evaluation):
    """The tiles were of the first model, the pictures of the last."""
    skin = {"mean": 1.0, "p95": 2.0, "largest": 77.7}
    other = as_model(prediction, "M")
    other = dataclasses.replace(other, summary={**other.summary, "skin": skin})
    pictures = {"prediction": PNG}
    for shown, models in (("M", ("H", "M")), ("H", ("H",)), (None, ("H", "M"))):
        entries = [prediction.summary, other.summary][: len(models)]
        document = cmfsim.report.case.case_document(
            entries, shown=shown, pictures=pictures, evaluation=evaluation.as_dict()
        )
        model = shown or models[-1]
        # Beside the plan's, which is that of all models.
        of_models = [name for name in document.facts if " at the " not in name]
        assert all(name.startswith(f"{model}: ") for name in of_models)
        assert (document.facts[f"{model}: skin moves at most"] == "77.7 mm") == (model == "M")
        assert document.facts_title.startswith(f"Model {model} ")
        # Errors of another model are not this one's.
        assert ("H: mean error of the face" in document.facts) == (model == "H")
        first = next(s for s in document.sections if s.title == "Prediction")
        assert first.blocks[0].caption.endswith(f"Model {model}.")


def test_what_a_stopped_run_left_is_finished_before_it_is_read(tmp_path, prediction):
    """`report` and `view` do not take the old files for the new ones, nor refuse for ever."""
    cmfsim.write_prediction(tmp_path, prediction)
    left = tmp_path / ".writing-x"
    left.mkdir()
    names = read_prediction(tmp_path)["files"]
    for name in names:
        (tmp_path / name).rename(left / name)
    (left / "ready.json").write_text(json.dumps({"names": names, "gone": [], "old": []}))
    with pytest.raises(FileNotFoundError, match="stopped"):
        predictions_of(tmp_path / "nowhere")
    assert write_case_report(tmp_path) == "report.html"
    assert read_parts(tmp_path)["skin"]


def test_a_name_means_one_face_whatever_its_ending(tmp_path, prediction):
    """`face` is the face after the operation; `face_before` and the displacement lead there."""
    cmfsim.write_prediction(tmp_path, prediction)
    after = np.asarray(prediction.face.vertices)
    vtp = read_mesh(tmp_path / "face.vtp")
    before = read_mesh(tmp_path / "face_before.vtp")
    assert np.abs(vtp.points - after).max() < 1e-9
    assert np.abs(before.points + before.point_data["displacement"] - after).max() < 1e-9
    assert np.abs(before.points - np.asarray(prediction.face_before.vertices)).max() < 1e-9
    stl = np.asarray(cmfsim.read_surface(tmp_path / "face.stl").vertices)
    assert np.abs(np.ptp(stl, axis=0) - np.ptp(after, axis=0)).max() < 1e-3
    assert np.abs(stl.min(axis=0) - after.min(axis=0)).max() < 1e-3
    digits = prediction.summary["plan_digits"]
    assert read_prediction(tmp_path)["plan_digits"] == digits
    assert f"plan: {digits} (digits of its motions" in _plan_text(read_prediction(tmp_path))


def test_files_of_two_runs_are_told_apart_by_their_content(tmp_path, prediction, replanned):
    """However they came together: each summary knows its files."""
    cmfsim.write_prediction(tmp_path / "a", prediction)
    cmfsim.write_prediction(tmp_path / "b", replanned)
    name = "face_before.vtp"
    (tmp_path / "a" / name).replace(tmp_path / "b" / name)
    with pytest.raises(cmfsim.CaseError, match=rf"{name}: is not the file"):
        read_parts(tmp_path / "b")
    (tmp_path / "b" / name).unlink()
    with pytest.raises(FileNotFoundError, match=name):
        read_parts(tmp_path / "b")


@pytest.mark.parametrize(
    "journal",
    [
        {"names": [".."], "gone": [], "old": []},
        {"names": ["M/.."], "gone": [], "old": []},
        {"names": [], "gone": ["../case.toml"], "old": []},
        {"names": [], "gone": ["/etc/x"], "old": []},
        {"names": ["folder"], "gone": [], "old": []},
        {"names": [], "gone": ["folder"], "old": []},
        {"names": ["link"], "gone": [], "old": []},
        {"names": 3, "gone": [], "old": []},
    ],
)
@pytest.mark.parametrize("name", ["ready.json", "undo.json"])
def test_a_planted_leftover_stops_no_run_and_leads_nowhere(tmp_path, prediction, journal, name):
    """A journal with ".." ended every later run."""
    out = tmp_path / "out"
    cmfsim.write_prediction(out, prediction)
    (tmp_path / "case.toml").write_text("mine")
    (out / "folder").mkdir()
    left = out / ".writing-planted"
    (left / "folder").mkdir(parents=True)
    (left / "link").symlink_to("/etc/passwd")
    (left / name).write_text(json.dumps(journal))
    before = state_of(out)
    finish_writing(out)
    cmfsim.write_prediction(out, prediction)
    assert set(state_of(out)) == set(before)
    assert (tmp_path / "case.toml").read_text() == "mine"
    assert not left.exists()


@pytest.mark.skipif(os.name != "posix", reason="needs links")
def test_an_output_folder_that_leads_elsewhere_is_refused(tmp_path, case, prediction, capsys):
    """A case's own; one that the user names is followed, and its place is printed."""
    path = write_head(tmp_path)
    elsewhere = tmp_path.parent / f"{tmp_path.name}-elsewhere"
    elsewhere.mkdir()
    (tmp_path / "out").symlink_to(elsewhere)
    for command in ("predict", "build", "evaluate", "sensitivity"):
        assert main([command, str(path), "-q", "--no-doctor"]) == 2
        assert f"points outside the case's folder, to {elsewhere}" in capsys.readouterr().err
    assert not list(elsewhere.iterdir())
    words = ["predict", str(path), "-q", "--no-doctor", "--model", "H", "-o", str(tmp_path / "out")]
    assert main(words) == 0
    assert str(elsewhere) in capsys.readouterr().out
    # A folder of a model that leads elsewhere is none of ours.
    (tmp_path / "fresh").mkdir()
    (tmp_path / "fresh" / "M").symlink_to(elsewhere)
    with pytest.raises(cmfsim.CaseError, match="is a link"):
        write(tmp_path / "fresh", prediction, as_model(prediction, "M"))
    assert case.parent != tmp_path


def test_no_stage_is_named_twice(tmp_path, prediction, evaluation):
    stages = []
    write_results(
        Path(tmp_path), [prediction], ["H"], stage=stages.append, evaluation=lambda: evaluation
    )
    assert stages == ["writing H", "writing the comparison", "writing the report"]


def test_files_of_one_name_in_two_folders_both_count(tmp_path):
    """One replaced the other: a change of it was not noticed, nor an exchange of the two."""
    for name, content in (("pre", b"1"), ("post", b"2")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "head.ply").write_bytes(content)
    (tmp_path / "case").mkdir()
    path = tmp_path / "case" / "case.toml"
    path.write_text(
        'format = "cmfsim-case"\nversion = 1\nosteotomies = []\n'
        f"[surfaces]\nskin = {str(tmp_path / 'pre' / 'head.ply')!r}\n"
        f"[surfaces.bones]\ncranium = {str(tmp_path / 'post' / 'head.ply')!r}\n"
    )
    case = cmfsim.Case.load(path)
    before = case_key(case)
    assert len(input_hashes(case)) == 3
    keys = {before}
    for name, content in (("pre", b"3"), ("post", b"4"), ("pre", b"2"), ("post", b"1")):
        (tmp_path / name / "head.ply").write_bytes(content)
        keys.add(case_key(case))
    # The last is the first with the two exchanged.
    assert len(keys) == 5
