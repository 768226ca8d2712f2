"""The work of the desk gives what the commands give, without building a head twice."""

import json
from dataclasses import replace

import numpy as np
import pytest

import cmfsim
from cmfsim.desk import work
from cmfsim.pipeline import predicting
from cmfsim.pipeline.building.inputs import read_anatomy
from shared_values import without_drawings

pytest.importorskip("skimage")
pytest.importorskip("pyvista")


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    """A coarse CT with its plan operator, after the plan was changed on the page."""
    folder = tmp_path_factory.mktemp("desk")
    cmfsim.write_image(cmfsim.make_head().ct(3.0), folder / "ct.nrrd")
    first = {"maxilla": {"forwards": 4.0}}
    cmfsim.init_case(folder, cuts=("le_fort_1", "bsso"), moves=first)
    path = folder / "case.toml"
    text = path.read_text(encoding="utf-8").replace("[image]", "[image]\nworking_spacing = 3.0")
    path.write_text(f"{text}\n[mesh]\nedge_length = 14.0\n", encoding="utf-8")
    opened = work.open_head(str(path))
    assert len(work._opened) == 1
    work.compute(str(path))
    # The head of the plan is that of the page of cuts, and is kept no longer.
    assert not work._opened
    assert "reading the image" not in work._held[str(path)][1].patient.summary["timings"]
    skull = work._held[str(path)][1].patient.landmarks["skull"]
    np.testing.assert_array_equal(opened.values["skull"]["nasion"], skull["nasion"])
    text = path.read_text(encoding="utf-8").replace("-4.0, 0.0]", "-4.0, 1.0]")
    moved = "[plan.mandible_body]\ntranslation = [0.0, 2.5, 0.0]\n\n[plan.maxilla]"
    path.write_text(text.replace("[plan.maxilla]", moved), encoding="utf-8")
    yield path
    work._held.clear()


@pytest.fixture(scope="module")
def predicted(case):
    return cmfsim.predict(case)


def plan_of(case):
    """The plan as the page sends it: 16 numbers for each segment."""
    planning = work._held[str(case)][1]
    plan = {n: m.matrix for n, m in cmfsim.Case.load(case).plan.items()}
    return json.dumps({"motions": [m.ravel().tolist() for m in planning.whole(plan).values()]})


def test_the_exact_face_of_a_plan_is_that_of_predict(case, predicted):
    """Also of what is lifted off the bone; pages solve contact to 0.01 mm, `predict` further."""
    planning = work._held[str(case)][1]
    plan = {n: m.matrix for n, m in cmfsim.Case.load(case).plan.items()}
    shift = planning.solve(plan).skin_displacements
    np.testing.assert_allclose(shift, predicted.skin_displacements, atol=1e-3)
    sent = work.solve(str(case), plan_of(case)).arrays["shift"]
    np.testing.assert_array_equal(sent, shift)


def test_a_report_builds_nothing_again_and_is_that_of_predict(case, predicted, monkeypatch):
    built = []
    monkeypatch.setattr(predicting, "build_patient", lambda *_: built.append(1))
    without_drawings(monkeypatch)
    work.report(str(case))
    assert not built
    output = cmfsim.Case.load(case).output
    summary = json.loads((output / "prediction.json").read_text(encoding="utf-8"))
    assert summary["inputs_key"] == predicted.patient.summary["inputs_key"]
    assert summary["plan_sources"] == predicted.patient.summary["plan_sources"]
    found = {(f["code"], f["what"]) for f in summary["findings"]}
    assert found == {(f.code, f.what) for f in predicted.findings}
    after = cmfsim.read_surface(output / "prediction.stl")
    skin = predicted.skin
    closest = cmfsim.Surface(skin.vertices, skin.triangles).closest(after.vertices)[0]
    assert np.abs(closest - after.vertices).max() < 1e-4


def test_another_mesh_or_image_is_built_again(case, monkeypatch):
    """Never the results of files that are not those of the case any more."""
    built = []

    class BuiltError(Exception):
        pass

    def build(*_):
        built.append(1)
        raise BuiltError

    monkeypatch.setattr(predicting, "build_patient", build)
    text, image = case.read_text(encoding="utf-8"), case.with_name("ct.nrrd").read_bytes()
    for change in (
        lambda: case.write_text(text.replace("= 14.0", "= 13.0"), encoding="utf-8"),
        lambda: case.with_name("ct.nrrd").write_bytes(image + b"\0"),
    ):
        change()
        with pytest.raises(BuiltError):
            work.report(str(case))
        case.write_text(text, encoding="utf-8")
        case.with_name("ct.nrrd").write_bytes(image)
    assert len(built) == 2


def test_jaws_separated_by_landmarks_need_no_image_again(case):
    """With the same bits as from the image; heads of other options are opened anew."""
    known, kept, stages = cmfsim.Case.load(case), {}, []
    marks = cmfsim.make_head().skull_landmarks
    read_anatomy(known, {}, stages.append, kept)
    again, noticed = read_anatomy(known, marks, stages.append, kept)
    assert stages.count("reading the image") == 1
    assert not kept
    fresh, same = read_anatomy(known, marks, stages.append)
    assert noticed == same
    for name, level in fresh.bones.items():
        np.testing.assert_array_equal(again.bones[name].values, level.values)
    np.testing.assert_array_equal(again.skin.values, fresh.skin.values)
    np.testing.assert_array_equal(again.air.values, fresh.air.values)
    # A head of other options is opened anew: it is kept under another name.
    other = replace(known, image=replace(known.image, working_spacing=4.0))
    for one in (known, other):
        read_anatomy(one, marks, stages.append, kept)
    assert len(kept) == 2
