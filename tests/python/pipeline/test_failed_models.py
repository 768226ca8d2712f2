"""Of several models one that does not solve is said; the others are written."""

import json
import sys

import numpy as np
import pytest

import cmfsim
import cmfsim.pipeline.predicting as stage
from cmfsim.cli import main
from head_case import HeadCase
from shared_values import without_drawings

pytest.importorskip("meshio")
pytest.importorskip("jinja2")


@pytest.fixture
def unsettled(monkeypatch, tmp_path):
    """A case whose contact never settles, and no pictures of it."""
    monkeypatch.setitem(sys.modules, "pyvista", None)
    without_drawings(monkeypatch)
    solve = stage.solved_patient

    def solved_patient(patient, model, tensors):
        if model.endswith("+S"):
            raise cmfsim.ContactError("contact does not settle: nodes [7] still change")
        return solve(patient, model, tensors=tensors)

    monkeypatch.setattr(stage, "solved_patient", solved_patient)
    head = HeadCase(rounds=2)
    head.toml = head.toml.replace("edge_length = 4.0", "edge_length = 16.0")
    after = np.asarray(head.surfaces["skin"].vertices) + [0.0, -1.0, 0.0]
    head.surfaces["after"] = cmfsim.SurfaceData(after, head.surfaces["skin"].triangles)
    head.toml += '\n[postoperative]\nskin = "after.ply"\n'
    return head.write(tmp_path)


def test_the_others_are_evaluated_and_the_failed_one_is_named(unsettled, capsys):
    words = ["evaluate", str(unsettled), "-q", "--no-doctor", "--model", "H", "--model", "H+S"]
    assert main(words) == 1
    assert "error: model H+S: contact does not settle" in capsys.readouterr().err
    out = unsettled.parent / "out"
    written = json.loads((out / "metrics.json").read_text(encoding="utf-8"))
    assert list(written["models"]) == ["H"]
    assert "nodes [7]" in written["failed"]["H+S"]
    assert "report.html" in written["files"]
    assert (out / "H" / "prediction.json").exists()
    assert not (out / "H+S").exists()
    # The report made anew is of the models that are there.
    (out / "report.html").unlink()
    assert main(["report", str(out), "-q", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert set(answer.pop("clinical")) == {"H"}
    assert answer == {"output": str(out), "report": "report.html"}
    assert (out / "report.html").stat().st_size > 0


def test_a_model_alone_that_fails_is_an_error(unsettled, capsys):
    assert main(["predict", str(unsettled), "-q", "--no-doctor", "--model", "H+S"]) == 1
    assert "contact does not settle" in capsys.readouterr().err
    with pytest.raises(cmfsim.ContactError):
        cmfsim.predict(cmfsim.Case.load(unsettled), model="H+S", check=False)


def test_several_models_are_not_answered_by_the_first():
    with pytest.raises(cmfsim.CaseError, match=r"predict takes one model.*predict_models"):
        cmfsim.predict("no folder is read", model=["H", "M"])


def test_an_observer_learns_of_stages_and_of_models_that_fail(unsettled):
    class Watch(cmfsim.Observer):
        def __init__(self):
            self.stages, self.models = [], []

        def stage(self, name):
            self.stages.append(name)

        def failed(self, model, error):
            self.models.append((model, type(error)))

    watch, failed = Watch(), {}
    asked = {"check": False, "observer": watch}
    found = cmfsim.predict_models(unsettled, ["H", "H+S"], **asked)
    assert [prediction.model for prediction in found] == ["H"]
    assert watch.stages[-1] == "solving H+S"
    assert watch.models == [("H+S", cmfsim.ContactError)]
    with pytest.raises(cmfsim.SolverError, match=r"model H\+S could not be solved"):
        cmfsim.predict(unsettled, model="H+S", **asked)
    # A callback is called in place of the observer's method.
    assert not list(cmfsim.predict_models(unsettled, "H+S", failed=failed, **asked))
    assert list(failed) == ["H+S"]
    assert len(watch.models) == 2
