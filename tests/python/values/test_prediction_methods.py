"""What a prediction does at a prompt: files, windows, notebooks and PyVista."""

import base64
import re
from functools import partial

import numpy as np
import pytest

import cmfsim
from cmfsim import pictures
from cmfsim.errors import CaseInputError
from cmfsim.io import read_parts
from cmfsim.pictures.canvas import write_picture
from cmfsim.pipeline.outputs import results
from shared_values import coarse_demo_patient, without_drawings


@pytest.fixture(scope="module")
def prediction(tmp_path_factory):
    return cmfsim.predict_patient(coarse_demo_patient(tmp_path_factory), "M")


def test_saved_parts_are_those_in_memory(prediction, tmp_path, monkeypatch):
    """And the folder is one that `cmfsim predict` might have written, here with one picture."""
    without_drawings(monkeypatch)
    white = partial(write_picture, image=np.full((2, 2, 3), 255, dtype=np.uint8))
    monkeypatch.setattr(results, "_pictures_of", lambda *_: iter([("plan.png", white)]))
    names = prediction.save(tmp_path / "new" / "out")
    assert {"prediction.vtp", "face.stl", "prediction.json", "plan.png"} <= set(names)
    assert sorted(names) == sorted(path.name for path in (tmp_path / "new" / "out").iterdir())
    read = read_parts(tmp_path / "new" / "out")
    assert {kind: list(of_kind) for kind, of_kind in read.items()} == {
        kind: list(of_kind) for kind, of_kind in prediction.parts.items()
    }
    for name, (_, after) in read["bones"].items():
        assert np.allclose(after, prediction.bones[name][1], atol=1e-4)


def test_blocks_of_pyvista_are_the_moved_parts(prediction):
    pytest.importorskip("pyvista", reason="needs PyVista")
    blocks = prediction.to_pyvista()
    assert np.array_equal(blocks["skin"].points, prediction.face.vertices)
    before = blocks["skin"].points - blocks["skin"]["displacement"]
    assert np.allclose(before, prediction.face_before.vertices, atol=1e-9)
    assert {"maxilla", "masseter_L"} <= set(blocks.keys())
    tissue = blocks["tissue"]
    assert tissue.n_cells == prediction.scene.n_tets
    assert np.array_equal(tissue["force"], prediction.result.forces)
    assert tissue.volume > 0.0


def test_a_plot_is_the_picture_of_view(prediction, tmp_path):
    pytest.importorskip("pyvista", reason="needs PyVista")
    prediction.plot(tmp_path / "face.png")
    assert (tmp_path / "face.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(CaseInputError, match=r"written as \.png"):
        prediction.plot(tmp_path / "face.jpg")


def test_a_notebook_shows_lines_and_picture(prediction):
    pytest.importorskip("pyvista", reason="needs PyVista")
    shown = prediction._repr_html_()
    assert "&#x27;demo&#x27;" in shown
    picture = re.search('base64,([^"]+)', shown)
    assert base64.b64decode(picture[1]).startswith(b"\x89PNG")


def test_a_notebook_without_opengl_shows_the_lines(prediction, monkeypatch):
    def refuse(*_, **__):
        raise CaseInputError("OpenGL does not work")

    monkeypatch.setattr(pictures.canvas, "draw", refuse)
    shown = prediction._repr_html_()
    assert shown.startswith("<pre>Prediction of M")
    assert "<img" not in shown
