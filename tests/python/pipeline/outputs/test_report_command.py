"""`cmfsim report` makes page and animation from the files of a prediction, with its colours."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

import cmfsim
import shared_values
from cmfsim.cli import main
from cmfsim.io.results.predictions import read_face_colours
from cmfsim.pictures import faces
from cmfsim.pipeline.outputs.results import write_results
from cmfsim.values.progress import no_progress

pytest.importorskip("jinja2")
pytest.importorskip("pyvista")
image = pytest.importorskip("PIL.Image")


@pytest.fixture
def folder(tmp_path, tmp_path_factory):
    """A coarse prediction whose skin is red on the left and green on the right."""
    patient = shared_values.coarse_demo_patient(tmp_path_factory)
    left = patient.face.vertices[:, :1] > 0.0
    colours = np.where(left, (255, 0, 0), (0, 255, 0)).astype(np.uint8)
    prediction = cmfsim.predict_patient(replace(patient, face_colours=colours), "H")
    cmfsim.write_prediction(tmp_path / "out", prediction)
    np.testing.assert_array_equal(read_face_colours(tmp_path / "out"), colours)
    return tmp_path / "out"


def test_page_and_animation_have_the_colours(folder, capsys, monkeypatch):
    monkeypatch.setattr(faces, "STEPS", 1)
    gif = folder.parent / "face.gif"
    assert main(["report", str(folder), "--animation", str(gif), "--json", "-q"]) == 0
    assert json.loads(capsys.readouterr().out)["animation"] == str(gif)
    with image.open(gif) as read:
        front = np.asarray(read.convert("RGB")).astype(int)[:400, :480]
    # The patient's left is on the right of the picture.
    red, green = (front[:, :, a] - front[:, :, 1 - a] > 60 for a in (0, 1))
    assert np.nonzero(red)[1].mean() > 280
    assert np.nonzero(green)[1].mean() < 200
    page = (folder / "report.html").read_text(encoding="utf-8")
    values = json.loads(re.search('id="page-values">(.*?)</script>', page)[1])
    shapes = {entry["name"]: entry["shape"] for entry in values["arrays"]}
    assert shapes["skin_colours"] == shapes[f"part_{len(values['parts']) - 1}"][:1]
    assert len(page) < 4e6
    assert main(["report", str(folder), "--animation", "face.avi"]) == 2
    assert "an animation is written as .gif or .mp4" in capsys.readouterr().err


def test_a_poor_bite_stands_in_summary_and_report_and_goes_with_the_plan(
    tmp_path, tmp_path_factory
):
    patient = shared_values.coarse_demo_patient(tmp_path_factory)
    apart = cmfsim.predict_patient(
        patient.with_plan({"maxilla": cmfsim.rigid_motion(translation=(0, -12, 0))}), "H"
    )
    closed = apart.replan({"maxilla": cmfsim.rigid_motion(translation=(0, -1, 0))})
    for prediction, is_poor in ((apart, True), (closed, False)):
        written = write_results(
            tmp_path / "out", [prediction], ["H"], stage=no_progress, pictures=lambda _: False
        )
        page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
        assert ("plan-bite-poor" in {finding.code for finding in written.findings}) == is_poor
        assert ("as planned, overjet is" in page) == is_poor
